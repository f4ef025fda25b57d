"""LSTR against the published weights, the reference's numbers and gradients, and the ten real TuSimple frames."""

import json
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case, numbered, options
from tests.golden_compare import assert_outputs_close, compare
from tests.shared import shared_path, shared_root
from tests.slow import with_slow
from tflane_jax.convert.lstr import convert_lstr
from tflane_jax.datasets.tusimple import TuSimpleConfig, TuSimpleDataset
from tflane_jax.evaluation.lane_shapes import detected, detections_of_curves
from tflane_jax.layers.batch_norm import BATCH_AXIS
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.losses.lane_shape import (
    LaneShapeLossConfig,
    LaneShapeTargets,
    lane_shape_loss,
    lane_weights,
    matching_cost,
)
from tflane_jax.matching import match
from tflane_jax.metrics.tusimple import TuSimpleMetrics
from tflane_jax.models.lstr import LstrConfig, TransformerEncoderConfig, normalise
from tflane_jax.scene import CurvePrediction, stack_examples

PUBLISHED = LstrConfig(backbone=ResNetConfig(frozen_stem_norm=True))
pytestmark = pytest.mark.golden


def of_kind(kind):
    return [path for path in golden_modules("lstr_*") if path.stem.startswith(f"lstr_{kind}")]


def tiny_config(case):
    sizes = options(case, "attn", "dec", "dims", "enc", "hidden", "heads", "layers", "q")
    layer = TransformerConfig(sizes.heads, sizes.hidden, dropout=0.0)
    backbone = ResNetConfig(tuple(sizes.layers), tuple(sizes.dims), stem_channels=sizes.dims[0], frozen_stem_norm=True)
    encoder = TransformerEncoderConfig(sizes.enc, layer)
    return LstrConfig(backbone, sizes.attn, encoder, sizes.dec, layer, sizes.q)


@pytest.mark.parametrize("path", with_slow(of_kind("tiny"), quick=["lstr_tiny_train"]), ids=case_id)
def test_network_matches_the_reference(path):
    check_network(load_module_case(path))


def check_network(case):
    train = options(case, mode="eval").mode == "train"
    model = tiny_config(case).build()

    def outputs(torch_params, inputs):
        variables = convert_lstr(torch_params).variables

        def one(image, padded):
            arguments = (image.transpose(1, 2, 0), padded[0] == 0)
            return model.apply(
                variables,
                *arguments,
                train=train,
                mutable=["batch_stats", "intermediates"],
                rngs={"dropout": jax.random.key(0)},
            )

        images = jnp.asarray(inputs["images"])
        masks = inputs.get("masks", np.zeros(case.inputs["images"][:, :1].shape, np.float32))
        prediction, state = jax.vmap(one, axis_name=BATCH_AXIS)(images, masks)
        layers = state["intermediates"]["encoder"]
        last = max(layers, key=lambda name: int(name.rpartition("_")[-1]))
        attention = layers[last]["self_attention"]["probabilities"][0].mean(1)
        return named(prediction) | {"enc_attn": attention}, state["batch_stats"]

    after = {name.removeprefix("bn_after/"): v for name, v in case.outputs.items() if name.startswith("bn_after/")}
    statistics = dict(compare(case, outputs, ignore={f"bn_after/{name}" for name in after})["backbone"])
    statistics.pop("bn1")
    wanted = convert_lstr(after).variables["batch_stats"]
    assert bool(after) <= train
    for place, value in jax.tree.leaves_with_path(statistics) if after else []:
        expected = wanted["backbone"]
        for key in place:
            expected = expected[key.key]
        np.testing.assert_allclose(value[0], expected, rtol=2e-5, atol=2e-5, err_msg=str(place))


def named(prediction):
    """Return a batch of predictions by the reference's names."""
    names = [*(f"aux{i}." for i in range(prediction.logits.shape[1] - 1)), ""]
    return {
        f"{name}pred_{part}": getattr(prediction, part)[:, i]
        for i, name in enumerate(names)
        for part in ("logits", "curves")
    }


@cache
def published_weights():
    path = shared_root() / "golden" / "modules" / "lstr_pretrained_weights.npz"
    return convert_lstr(load_module_case(path).params).variables


@partial(jax.jit, static_argnums=0)
def predict(config, variables, images, valid):
    return jax.vmap(lambda image, v: config.build().apply(variables, image, v))(images, valid)


OF_PUBLISHED = [path for path in of_kind("pretrained") if "weights" not in path.stem]


@pytest.mark.parametrize("path", with_slow(OF_PUBLISHED, quick=["lstr_pretrained_road"]), ids=case_id)
def test_published_weights_match_the_reference(path):
    case = load_module_case(path)
    if "images_x4_i8" in case.inputs:
        images = jnp.asarray(case.inputs["images_x4_i8"].astype(np.float32) / 4).transpose(0, 2, 3, 1)
        valid = jnp.asarray(case.inputs["masks_u8"][:, 0] == 0)
    else:
        rgb = jnp.asarray(case.inputs["resized_bgr_u8"][None, ..., ::-1])
        valid = jnp.ones(rgb.shape[:3], bool)
        images = normalise(rgb, valid)
        steps = (n // m for n, m in zip(images.shape[1:3], case.inputs["images_s"].shape[2:], strict=True))
        strided = np.asarray(images).transpose(0, 3, 1, 2)[
            (slice(None), slice(None), *(slice(None, None, s) for s in steps))
        ]
        np.testing.assert_allclose(strided, case.inputs["images_s"], rtol=1e-6, atol=1e-6)
    prediction = predict(PUBLISHED, published_weights(), images, valid)
    outs = named(prediction)
    assert_outputs_close(outs, {name: case.outputs[name] for name in outs})

    for b in range(len(images)):
        one = jax.tree.map(lambda leaf, b=b: np.asarray(leaf)[b, -1], prediction)
        found = detected(one)
        np.testing.assert_array_equal(found, case.outputs["results"][b, :, 0] == 1)
        for name in numbered(case.inputs, r"h_samples_(\d+)"):
            heights, rows = name.removeprefix("h_samples_"), case.inputs[name]
            ours = detections_of_curves(one, rows, height=720, width=1280).x
            expected = case.outputs[f"b{b}.tusimple_x_h{heights}"]
            np.testing.assert_array_equal(ours == -2, expected == -2)
            np.testing.assert_allclose(ours, expected, atol=0.05)  # pixels


@pytest.mark.parametrize("path", of_kind("matcher"), ids=case_id)
def test_costs_assignments_and_losses_match_the_reference(path):
    check_losses(load_module_case(path))


def check_losses(case):
    weights = {name: case.meta["weight_dict"][f"loss_{name}"] for name in ("ce", "curves", "lowers")}
    config = LaneShapeLossConfig(weights["ce"], weights["curves"], weights["lowers"], shared_horizon=False)
    targets = stacked_targets([case.inputs[name] for name in numbered(case.inputs, r"targets\.(\d+)")])
    earlier = (name.removesuffix(".pred_logits") for name in numbered(case.inputs, r"aux(\d+)\.pred_logits"))
    layers = (*earlier, "main")
    prediction = CurvePrediction(
        *(jnp.stack([case.inputs[f"{layer}.pred_{part}"] for layer in layers], 1) for part in ("logits", "curves"))
    )
    lane_weight = lane_weights(targets, targets.valid)
    cost = jax.jit(jax.vmap(lambda p, t, w: matching_cost(p, t, w, config)))(prediction, targets, lane_weight)
    assignment = match(cost, targets.valid[:, None])
    for b, count in enumerate(np.asarray(targets.valid).sum(1).tolist()):
        for i, layer in enumerate(layers):
            expected = case.outputs[f"{layer}.cost.{b}"]
            np.testing.assert_allclose(cost[b, i, :, :count], expected, rtol=1e-4, atol=1e-4)
            by_target = np.argsort(case.outputs[f"{layer}.match_tgt.{b}"])
            source = case.outputs[f"{layer}.match_src.{b}"][by_target]
            np.testing.assert_array_equal(assignment.query[b, i, :count], source)

    total, terms = jax.jit(lane_shape_loss, static_argnums=2)(prediction, targets, config)
    names = ("ce", "curves", "lowers", "uppers")
    scale = {name: case.meta["weight_dict"][f"loss_{name}"] for name in names}
    wanted = {name: scale[name] * case.outputs[f"loss_{name}"] for name in names}
    np.testing.assert_allclose(terms["class"], wanted["ce"], rtol=2e-5)
    np.testing.assert_allclose(terms["curve"], wanted["curves"], rtol=2e-5)
    np.testing.assert_allclose(terms["extent"], wanted["lowers"] + wanted["uppers"], rtol=2e-5)
    np.testing.assert_allclose(total, case.outputs["total"], rtol=2e-5)


def stacked_targets(images):
    """Return the reference's target rows, [1, lower, upper, xs, ys] with -1e5 for no point, as a padded batch."""
    most, points = max(map(len, images)), (images[0].shape[1] - 3) // 2
    rows = np.full((len(images), most, 3 + 2 * points), np.nan, np.float32)
    for b, image in enumerate(images):
        rows[b, : len(image)] = image
    columns, heights = rows[..., 3 : 3 + points], rows[..., 3 + points :]
    point_valid = columns >= 0
    columns, heights = (np.where(point_valid, x, 0) for x in (columns, heights))
    valid = ~np.isnan(rows[..., 0])
    extent = np.where(valid[..., None], rows[..., 1:3], 0)
    return LaneShapeTargets(*map(jnp.asarray, (columns, heights, point_valid, extent, valid)))


def test_every_published_tensor_is_accounted_for():
    with np.load(shared_path("data/lstr/LSTR_500000.npz")) as file:
        state = {name: file[name] for name in file.files}
    converted = convert_lstr(state)
    assert [row["tensor"] for row in converted.table] == list(state)
    model = PUBLISHED.build()
    fresh = jax.eval_shape(model.init, jax.random.key(0), jnp.zeros((360, 640, 3)), jnp.ones((360, 640), bool))
    shapes = lambda tree: jax.tree.map(lambda leaf: leaf.shape, tree)  # noqa: E731
    assert shapes(converted.variables) == shapes(fresh)
    assert sum(leaf.size for leaf in jax.tree.leaves(fresh["params"])) == 765_754
    assert json.dumps(converted.table)


def test_the_ten_real_frames_give_the_originals_points():
    """Photo to points, through our own decoding, resizing, weights and network."""
    pytest.importorskip("cv2")
    with np.load(shared_path("data/lstr/reference_outputs_train.npz")) as file:
        reference = {name: file[name] for name in file.files}
    dataset = TuSimpleDataset(TuSimpleConfig(str(shared_path("data/tusimple/LaneDetection"))))
    assert [dataset.raw_file(i) for i in range(len(dataset))] == reference["raw_file"].tolist()
    examples = stack_examples([dataset.example(i) for i in range(len(dataset))])
    images = normalise(examples.image, examples.image_valid)
    first = np.asarray(images[0]).transpose(2, 0, 1)
    np.testing.assert_allclose(first, reference["input_first_image"], rtol=1e-6, atol=1e-6)
    prediction = jax.device_get(predict(PUBLISHED, published_weights(), images, jnp.asarray(examples.image_valid)))
    metrics = TuSimpleMetrics()
    for i in range(len(dataset)):
        ours = jax.tree.map(lambda leaf, i=i: leaf[i, -1], prediction)
        theirs = CurvePrediction(reference["pred_logits"][i], reference["pred_curves"][i])
        truth = dataset.truth(i)
        found, expected = (detections_of_curves(one, truth.rows, height=720, width=1280) for one in (ours, theirs))
        np.testing.assert_array_equal(found.x == -2, expected.x == -2)
        np.testing.assert_allclose(found.x, expected.x, atol=0.5)  # pixels
        metrics.update(found, truth)
    expected = dict(zip(("Accuracy", "FP", "FN"), reference["metric"].mean(0), strict=True))
    computed = metrics.compute()
    for name, value in expected.items():
        np.testing.assert_allclose(computed[name], value, atol=1e-9, err_msg=name)

"""LaneSegNet: its forms in training and evaluation, initial values, sizes that do not fit, proposals and denoising."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import CAMERA, ELEMENTS, SEGMENTS, SMALL_SEGMENTS, make_bucket_example, make_segment_example
from tests.parameters import random_params, zero_params
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.models import host
from tflane_jax.models.area_decoder import AreaDecoderConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_queries import LaneProposalConfig
from tflane_jax.models.lane_segments import SegmentHeads, regions
from tflane_jax.models.lanesegnet import LaneSegNet
from tflane_jax.models.parameters import with_xavier_layers
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

BEV = jax.random.normal(jax.random.key(0), (4, 6, 16))


@pytest.fixture(scope="module")
def params():
    module = SEGMENTS.build()
    return random_params(lambda key: module.init(key, BEV, method=LaneSegNet.decode)["params"])


def decode(params, *, config=SEGMENTS, **options):
    module = config.build()
    run = jax.jit(lambda p: module.apply({"params": p}, BEV, method=LaneSegNet.decode, **options).segments)
    return run(params)


@pytest.mark.slow
def test_masks_are_predicted_in_training_only_and_nothing_else_changes(params):
    training, evaluation = decode(params, deterministic=False), decode(params)
    assert training.mask_logits.shape == (2, 6, 4, 6)
    assert evaluation.mask_logits is None
    for one, other in zip(
        jax.tree.leaves(training.replace(mask_logits=None)), jax.tree.leaves(evaluation), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_published_evaluation_moves_only_the_last_layer_and_only_outside_training(params):
    twice = replace(SEGMENTS, last_step="twice")
    once, published = decode(params), decode(params, config=twice)
    np.testing.assert_allclose(once.points[0], published.points[0], rtol=1e-5, atol=1e-5)
    assert np.abs(once.points[1] - published.points[1]).max() > 0.1
    # Offsets and classes depend on the queries alone.
    np.testing.assert_allclose(once.left - once.points, published.left - published.points, atol=1e-4)
    np.testing.assert_allclose(once.logits, published.logits, atol=1e-5)
    trained = decode(params, config=twice, deterministic=False)
    np.testing.assert_allclose(trained.points, once.points, rtol=1e-4, atol=1e-3)


def test_boundaries_mirror_each_other_at_the_centerline(params):
    found = decode(params)
    np.testing.assert_allclose((found.left + found.right) / 2, found.points, atol=1e-4)


def test_published_layers_start_xavier_uniform_and_the_rest_as_it_is():
    """`init` calls the function under test where the configuration says so; it sees the parameters as zeros here."""
    key = jax.random.key(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "with_xavier_layers", lambda variables, key: {**variables, "drawn": key})
        for initial, drawn in (("lecun", False), ("xavier", True)):
            module = replace(SEGMENTS, initial=initial).build()
            shapes = jax.eval_shape(lambda m=module: m.init(key, BEV, method=LaneSegNet.decode))
            assert ("drawn" in shapes) == drawn
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, np.float32), shapes["params"])
    params = with_xavier_layers({"params": zeros}, key)["params"]
    flat = {jax.tree_util.keystr(k, simple=True, separator="/"): v for k, v in jax.tree.leaves_with_path(params)}
    attention = [f"self_attention/{name}" for name in ("query", "key", "value", "output")]
    names = [*attention, "bev_attention/value_proj", "bev_attention/output_proj"]
    names += ["feed_forward/expand", "feed_forward/contract"]
    redrawn = {f"layer_{i}/{name}/kernel" for i in range(2) for name in names}
    assert {name for name, leaf in flat.items() if np.any(leaf)} == redrawn
    for name in redrawn:
        inputs, outputs = flat[name].shape
        packed = name.endswith(("query/kernel", "key/kernel", "value/kernel"))  # one matrix in PyTorch
        bound = np.sqrt(6.0 / (inputs + outputs * (3 if packed else 1)))
        assert 0.9 * bound < np.abs(flat[name]).max() <= bound, name
    assert not np.array_equal(flat["layer_0/feed_forward/expand/kernel"], flat["layer_1/feed_forward/expand/kernel"])


@pytest.mark.slow
def test_heads_start_as_copies_of_one_another():
    module = replace(SEGMENTS, decoder=replace(SEGMENTS.decoder, layers=2)).build()
    params = jax.jit(lambda key: module.init(key, BEV, method=LaneSegNet.decode))(jax.random.key(1))["params"]
    jax.tree.map(np.testing.assert_array_equal, params["heads_0"], params["heads_1"])
    assert np.abs(params["layer_0"]["feed_forward"]["expand"]["kernel"]).max() > 0
    assert not np.array_equal(
        params["layer_0"]["feed_forward"]["expand"]["kernel"], params["layer_1"]["feed_forward"]["expand"]["kernel"]
    )
    # PyTorch's linear layers: uniform within 1 / sqrt(inputs).
    kernel = np.asarray(params["heads_0"]["points"]["linear_0"]["kernel"])
    assert 0.2 < np.abs(kernel).max() <= 0.25
    assert not np.array_equal(
        params["heads_0"]["points"]["linear_0"]["kernel"], params["heads_0"]["offset"]["linear_0"]["kernel"]
    )


def test_heads_of_areas_start_as_copies_too(monkeypatch):
    """MapTR's head makes its branches by copies as well; layers and queries keep their own values."""
    drawn = {"heads_0": 1.0, "heads_1": 2.0, "layer_0": 3.0, "layer_1": 4.0}
    areas = {"heads_0": 5.0, "heads_1": 6.0, "layer_1": 7.0, "queries": 8.0}
    monkeypatch.setattr(host.Host, "init", lambda *_: {"params": drawn | {"areas": areas}, "intermediates": 9.0})
    found = BUCKET.build().init(jax.random.key(0))
    assert found["params"] == drawn | {"heads_1": 1.0, "areas": areas | {"heads_1": 5.0}}
    assert found["intermediates"] == 9.0


def test_half_of_the_heads_look_at_each_boundary():
    decoder = replace(SEGMENTS.decoder, heads=8, points=10)
    left, right = np.arange(10.0)[None, :, None] + np.zeros((1, 10, 3)), np.full((1, 10, 3), -1.0)
    around = regions(jnp.asarray(left), jnp.asarray(right), decoder)
    np.testing.assert_array_equal(around[0, :, 0], [0, 3, 6, 9, -1, -1, -1, -1])


def test_boundaries_of_the_small_form_start_beside_the_lane_and_end_at_the_border():
    """A lane along y near the upper end of x, with heads that are all zero."""
    box = PerceptionRange((-50.0, 50.0), (-25.0, 25.0))
    heads = SegmentHeads(SMALL_SEGMENTS.decoder, box)
    line = np.stack([np.full(11, 0.99), np.linspace(0.2, 0.8, 11), np.full(11, 0.5)], -1)[None]
    line = np.concatenate([line, line - [0.3, 0, 0]]).astype(np.float32)
    queries = jnp.zeros((2, 16))
    params = zero_params(heads.init, queries, line, BEV)
    found = jax.jit(lambda p: heads.apply(p, queries, line, BEV))(params)
    # Heading along +y, the left side is at smaller x.
    np.testing.assert_allclose(found.points[..., 0], np.array([[49.0], [19.0]]) + np.zeros((2, 11)), atol=1e-4)
    np.testing.assert_allclose(found.left[:, :, 0], found.points[..., 0] - 1.75, atol=1e-4)
    np.testing.assert_allclose(found.right[1, :, 0], 20.75, atol=1e-4)
    np.testing.assert_allclose(found.right[0, :, 0], 50.0, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"decoder": replace(SEGMENTS.decoder, heads=1)}, r"decoder\.heads is 1: it must be even"),
        ({"decoder": replace(SEGMENTS.decoder, sampling_points=12)}, "multiple of 8"),
        ({"elements": ELEMENTS}, "encoder of cameras"),
        (
            {"encoder": CAMERA, "elements": replace(ELEMENTS, layers=3)},
            r"elements\.layers is 3: .*decoder\.layers",
        ),
        ({"areas": AreaDecoderConfig()}, r"decoder\.classes is 2: it must be 1 with areas"),
        ({"decoder": replace(SEGMENTS.decoder, classes=1)}, "2 without"),
    ],
)
def test_sizes_that_do_not_fit_are_named(change, message):
    with pytest.raises(UserError, match=message):
        replace(SEGMENTS, **change).build()


@pytest.mark.slow
def test_it_trains_with_proposals_and_denoising_and_all_their_parameters_learn():
    decoder = replace(SMALL_SEGMENTS.decoder, proposals=LaneProposalConfig(count=4, hidden=8))
    model = replace(SMALL_SEGMENTS, decoder=decoder, denoising=DenoisingConfig(copies=1))
    task = LaneGraphTask(model, LaneSegNetLossConfig(class_target="quality"))
    example = make_segment_example()
    params = random_params(task.init, example)
    batch = stack_examples([example, make_segment_example(1, lanes=0, crossings=0)])
    _, report = (found := jax.jit(jax.value_and_grad(task.loss, has_aux=True))(params, batch, jax.random.key(1)))[0]
    gradient = found[1]
    assert {"denoised_class", "denoised_mask", "denoised_successor", "proposal_heat", "proposal_points"} <= set(report)
    assert {"class", "points", "mask", "dice", "line_type", "successor", "matching/segments"} <= set(report)
    assert float(report["matching/segments"]) == 2.5  # four lanes and a crossing, and nothing
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    silent = [
        f"{part}/{name}"
        for part in ("proposals", "noised", "heads_0", "heads_1", "successor")
        for name, leaf in gradient[part].items()
        if not any(np.any(x) for x in jax.tree.leaves(leaf))
    ]
    assert not silent


AREAS = AreaDecoderConfig(dim=16, heads=2, layers=2, queries=4, points=22, sampling_points=2, hidden=16)
BUCKET = replace(SEGMENTS, decoder=replace(SEGMENTS.decoder, classes=1), areas=AREAS)
"""The map-element-bucket variant on BEV evidence; with cameras it has traffic elements as well."""


@pytest.mark.slow
def test_areas_are_predicted_apart_and_segments_have_one_class():
    module = BUCKET.build()
    params = random_params(lambda key: module.init(key, BEV, method=LaneSegNet.decode)["params"])
    found = jax.jit(lambda p: module.apply({"params": p}, BEV, method=LaneSegNet.decode))(params)
    assert found.segments.logits.shape == (2, 6, 1)
    assert found.segments.areas.points.shape == (2, 4, 22, 3)
    assert found.segments.areas.logits.shape == (2, 4, 2)


@pytest.mark.slow
def test_the_published_fault_of_the_areas_changes_their_points_alone():
    """Points are the raw change scaled to the range; references, and with them all else, are refined as meant."""
    meant, raw = (replace(BUCKET, areas=replace(AREAS, output=output)).build() for output in ("sigmoid", "raw"))
    params = random_params(lambda key: meant.init(key, BEV, method=LaneSegNet.decode)["params"])
    right, wrong = (
        jax.jit(lambda p, m=module: m.apply({"params": p}, BEV, method=LaneSegNet.decode).segments)(params)
        for module in (meant, raw)
    )
    np.testing.assert_allclose(right.areas.logits, wrong.areas.logits, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(right.points, wrong.points, rtol=1e-5, atol=1e-5)
    box = BUCKET.spec.bev_range
    unit, change = box.normalise(right.areas.points), box.normalise(wrong.areas.points)
    logit = jnp.log(unit / (1 - unit))
    # The second layer starts from the first one's points: logits differ by the change.
    np.testing.assert_allclose(logit[1] - logit[0], change[1], rtol=1e-2, atol=1e-3)


@pytest.mark.slow
def test_areas_train_and_all_their_parameters_learn():
    task = LaneGraphTask(BUCKET, LaneSegNetLossConfig())
    example = make_segment_example()
    params = random_params(task.init, example)
    run = jax.jit(jax.value_and_grad(task.loss, has_aux=True))
    (_, report), gradient = run(params, stack_examples([example]), jax.random.key(1))
    assert {"area_class", "area_points", "area_direction"} <= set(report)
    assert (float(report["matching/areas"]), float(report["matching/segments"])) == (2.0, 4.0)
    assert all(np.any(leaf) for leaf in jax.tree.leaves(gradient["areas"]["heads_1"]))


@pytest.mark.slow
def test_the_bucket_trains_on_areas_and_elements_and_all_their_parameters_learn():
    model = replace(BUCKET, encoder=CAMERA, elements=ELEMENTS)
    task = LaneGraphTask(model, LaneSegNetLossConfig(cell_weight=0.0))
    examples = [make_bucket_example(0), make_bucket_example(1, elements=0)]
    params = random_params(task.init, examples[0])
    run = jax.jit(jax.value_and_grad(task.loss, has_aux=True))
    (_, report), gradient = run(params, stack_examples(examples), jax.random.key(1))
    names = {"area_class", "area_points", "area_direction", "element_class", "element_box", "element_lane"}
    assert names <= set(report)
    assert float(report["matching/areas"]) == 2.0  # a crossing and a boundary
    assert float(report["matching/elements"]) == 1.0
    assert float(report["matching/segments"]) == 4.0  # no crossing among them
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    silent = [
        f"{part}/{name}"
        for part in ("areas", "elements", "element_lane", "successor")
        for name, leaf in gradient[part].items()
        if not any(np.any(x) for x in jax.tree.leaves(leaf))
    ]
    assert not silent

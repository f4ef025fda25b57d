"""The traffic-element head against the reference's numbers, and independence of padding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case, numbered, options
from tests.golden_compare import compare
from tests.models.golden_lanes import by_layer
from tests.parameters import random_params
from tflane_jax.convert.toponet import ELEMENTS
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.losses.traffic_elements import element_cost, element_losses
from tflane_jax.matching import match
from tflane_jax.models.element_decoder import ElementDecoder, ElementDecoderConfig
from tflane_jax.scene import ElementPrediction, TrafficElements, stack_examples


def reference_config(case):
    sizes = options(case, "dim", "heads", "levels", "enc", "dec", "queries", "points", "hidden")
    return ElementDecoderConfig(
        dim=sizes.dim,
        heads=sizes.heads,
        levels=sizes.levels,
        encoder_layers=sizes.enc,
        layers=sizes.dec,
        queries=sizes.queries,
        sampling_points=sizes.points,
        hidden=sizes.hidden,
    )


def reference_truth(case, image, capacity):
    """Return the elements of one image of the fixture, padded."""
    boxes, labels = case.inputs[f"gt_bboxes.{image}"], case.inputs[f"gt_labels.{image}"]
    elements, count = TrafficElements.empty(capacity, 1), len(boxes)
    elements.box[:count], elements.attribute[:count] = boxes.reshape(-1, 2, 2), labels
    elements.box[count:], elements.valid[:count] = np.nan, True
    return elements


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("toponet_te_head*"), ids=case_id)
def test_matches_the_reference(path):
    check(load_module_case(path))


def check(case):
    config = reference_config(case)
    decoder = ElementDecoder(config, classes=len(case.params["cls_branches.0.bias"]))
    padded = tuple(int(n) for n in case.inputs["batch_hw"])
    sizes = case.inputs["img_hw"][:, ::-1].astype(np.int32)
    # One more than the fullest image has, so that every image has padding.
    capacity = 1 + max(len(case.inputs[name]) for name in numbered(case.inputs, r"gt_bboxes\.(\d+)"))
    elements = stack_examples([reference_truth(case, image, capacity) for image in range(len(sizes))])
    weights = TopoNetLossConfig()
    levels = numbered(case.inputs, r"feat(\d+)")

    def outputs(torch_params, inputs):
        params = converted_params(torch_params, ELEMENTS)

        def one(size, *levels):
            levels = [level.transpose(1, 2, 0) for level in levels]
            return decoder.apply({"params": params}, levels, size, padded)

        found = jax.vmap(one)(sizes, *(jnp.asarray(inputs[name]) for name in levels))
        prediction = ElementPrediction(found.box, found.logits, jnp.zeros((*found.box.shape[:3], 1)))
        clear = elements.replace(box=jnp.where(elements.valid[..., None, None], elements.box, 0.0))
        cost = jax.vmap(lambda p, e, s: element_cost(p, e, s, weights.elements))(prediction, clear, sizes)
        terms = element_losses(prediction, match(cost, elements.valid[:, None]), clear, sizes, weights.elements)
        box = found.box / sizes[:, None, None, None].astype(np.float32)
        box = jnp.concatenate([box.mean(-2), box[..., 1, :] - box[..., 0, :]], -1)
        # The reference puts the layers before the batch.
        out = {"all_cls_scores": found.logits, "all_bbox_preds": box, "history_states": found.queries}
        out = {name: value.swapaxes(0, 1) for name, value in out.items()}
        for name, term in {"loss_cls": "class", "loss_bbox": "box", "loss_iou": "iou"}.items():
            out |= by_layer(name, terms[f"element_{term}"])
        return out, cost

    matching = {name for name in case.outputs if name.startswith(("cost.", "pos_inds.", "pos_assigned_gt_inds."))}
    cost = compare(case, outputs, ignore=matching | {"grad_scalar"})
    for name in (name for name in case.outputs if name.startswith("cost.")):
        layer, image = (int(part) for part in name.split(".")[1:])
        expected = case.outputs[name]
        np.testing.assert_allclose(cost[image, layer, :, : expected.shape[1]], expected, rtol=1e-4, atol=1e-4)
        count = expected.shape[1]
        query = match(cost[image, layer], elements.valid[image]).query[:count]
        by_query = np.argsort(query)
        np.testing.assert_array_equal(np.asarray(query)[by_query], case.outputs[f"pos_inds.{layer}.{image}"])
        np.testing.assert_array_equal(by_query, case.outputs[f"pos_assigned_gt_inds.{layer}.{image}"])


@pytest.mark.slow
def test_features_of_padding_change_nothing():
    config = ElementDecoderConfig(dim=16, heads=2, levels=2, encoder_layers=1, layers=2, queries=3, hidden=16)
    rng = np.random.default_rng(0)
    levels = [rng.normal(size=(h, w, 16)).astype(np.float32) for h, w in ((8, 12), (4, 6))]
    # An image of 64 x 40 in an array of 96 x 64 pixels covers 5 rows and 8 columns of the first level.
    size = np.array([64, 40], np.int32)
    module = ElementDecoder(config)
    # Off the start, where boxes do not depend on anything.
    params = random_params(lambda key: module.init(key, levels, size, (64, 96)))

    @jax.jit
    def step(params, levels):
        def scalar(params, levels):
            out = module.apply(params, levels, size, (64, 96))
            return (out.box**2).sum() * 1e-3 + (out.logits**2).sum(), out

        return jax.value_and_grad(scalar, argnums=(0, 1), has_aux=True)(params, levels)

    dirty = [level.copy() for level in levels]
    dirty[0][5:], dirty[0][:, 8:], dirty[1][3:], dirty[1][:, 4:] = (np.nan,) * 4
    clean, soiled = step(params, levels), step(params, dirty)
    jax.tree.map(np.testing.assert_array_equal, clean, soiled)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(clean))
    other = [levels[0] + 0.5, levels[1]]
    assert not np.array_equal(clean[0][1].box, step(params, other)[0][1].box)

"""The fixtures of lane heads (toponet_head, olv2_lc_head) as arguments of our modules and losses."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.golden import assert_gradients_close, assert_outputs_close, named_gradients
from tflane_jax.geometry import PerceptionRange
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.scene import LaneGraph, stack_examples


def decoder_config(sizes, points):
    low_x, low_y, low_z, high_x, high_y, high_z = sizes["pc_range"]
    return LaneDecoderConfig(
        dim=sizes["C"],
        heads=sizes["heads"],
        layers=sizes["layers"],
        queries=sizes["num_query"],
        points=points,
        hidden=sizes["ffn"],
        relation=128,
        refine="fixed",
        range=PerceptionRange((low_x, high_x), (low_y, high_y), (low_z, high_z)),
    )


def truth(case, points, capacity=4):
    """Return the lanes of the fixture's images, padded and stacked."""
    graphs = []
    for image in range(len(case.inputs["bev_feats"])):
        lanes, graph = case.inputs[f"gt_lanes.{image}"], LaneGraph.empty(capacity, points)
        count = len(lanes)
        graph.points[:count], graph.valid[:count] = lanes.reshape(count, points, 3), True
        if f"gt_lclc.{image}" in case.inputs:
            graph.successor[:count, :count] = case.inputs[f"gt_lclc.{image}"]
        graphs.append(graph)
    return stack_examples(graphs)


def bev_maps(case, features):
    """Return the BEV features with rows and columns."""
    return features.reshape(len(features), *case.meta["config"]["bev"], -1)


def queries_of(state):
    """Return the queries of every layer (D, Q, C) that a module has stored."""
    return jnp.stack(state["intermediates"]["layer_queries"])


def layers_first(out):
    """Return (B, D, ...) outputs as the reference has them, (D, B, ...), lanes as one vector each."""
    out = {name: value.swapaxes(0, 1) for name, value in out.items()}
    return out | {"all_lanes_preds": out["all_lanes_preds"].reshape(*out["all_lanes_preds"].shape[:3], -1)}


def check(case, outputs, inputs):
    """Compare a function (torch params, inputs) -> (outputs by name, anything) with the reference; return the latter.

    Lanes are in metres, so that the reference's own float32 noise there is some 5e-5 (specs section 1).
    """

    def scalar(torch_params, inputs):
        out, beside = outputs(torch_params, inputs)
        return sum((out[name] * weight).sum() for name, weight in case.weights.items()), (out, beside)

    step = jax.jit(jax.value_and_grad(scalar, argnums=(0, 1), has_aux=True))
    weights = {name: value for name, value in case.params.items() if name != "code_weights"}
    (_, (out, beside)), (by_param, by_input) = step(weights, inputs)
    expected = {name: case.outputs[name] for name in case.weights}
    assert_outputs_close(out, {"all_lanes_preds": expected.pop("all_lanes_preds")}, tolerance=5e-5)
    assert_outputs_close(out, expected)
    assert_gradients_close(named_gradients(by_param, by_input), case.gradients)
    return beside


def check_matching(case, cost, assignment):
    """Compare costs (B, D, Q, N) and assignments with those of the reference."""
    for name in (name for name in case.outputs if name.startswith("cost.")):
        layer, image = (int(part) for part in name.split(".")[1:])
        expected = case.outputs[name]
        count = expected.shape[1]
        np.testing.assert_allclose(cost[image, layer, :, :count], expected, rtol=1e-4, atol=1e-4, err_msg=name)
        rows, columns = (case.outputs[f"match_{side}.{layer}.{image}"] for side in ("row", "col"))
        query = np.asarray(assignment.query[image, layer])
        np.testing.assert_array_equal(query[columns], rows, err_msg=name)
        np.testing.assert_array_equal(np.asarray(assignment.matched[image, layer]), np.arange(query.size) < count)

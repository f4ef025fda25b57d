"""The fixtures of lane heads (toponet_head, olv2_lc_head) as arguments of our modules and losses."""

import jax.numpy as jnp
import numpy as np

from tests.golden import numbered, options
from tests.golden_compare import compare
from tflane_jax.geometry import PerceptionRange
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.scene import LaneGraph, stack_examples


def decoder_config(case):
    sizes = options(case, "dim", "heads", "layers", "queries", "lane_points", "hidden", points=4)
    # Channels of a relationship head's sides; the baseline's fixture has no such head.
    hidden = numbered(case.params, r"lclc_branches\.0\.MLP_o1\.layers\.(\d+)\.bias")
    return LaneDecoderConfig(
        dim=sizes.dim,
        heads=sizes.heads,
        layers=sizes.layers,
        queries=sizes.queries,
        points=sizes.lane_points,
        sampling_points=sizes.points,
        hidden=sizes.hidden,
        relation=len(case.params[hidden[-1]]) if hidden else 128,
        refine="fixed",
    )


def encoder_config(case):
    """Return an encoder whose BEV features cover the fixture's range; nothing else of it is used."""
    low_x, low_y, low_z, high_x, high_y, high_z = options(case, "pc_range").pc_range
    return EvidenceEncoderConfig(range=PerceptionRange((low_x, high_x), (low_y, high_y), (low_z, high_z)))


def truth(case):
    """Return the lanes of the fixture's images, padded and stacked."""
    graphs, points = [], options(case, "lane_points").lane_points
    every = [case.inputs[name] for name in numbered(case.inputs, r"gt_lanes\.(\d+)")]
    # One more than the fullest image has, so that every image has padding.
    capacity = 1 + max(map(len, every))
    for image, lanes in enumerate(every):
        graph, count = LaneGraph.empty(capacity, points), len(lanes)
        graph.points[:count], graph.valid[:count] = lanes.reshape(count, points, 3), True
        if f"gt_lclc.{image}" in case.inputs:
            graph.successor[:count, :count] = case.inputs[f"gt_lclc.{image}"]
        graphs.append(graph)
    return stack_examples(graphs)


def bev_maps(case, features):
    """Return the BEV features with rows and columns."""
    return features.reshape(len(features), *options(case, "bev").bev, features.shape[-1])


def queries_of(state):
    """Return the queries of every layer (D, Q, C) that a module has stored."""
    return jnp.stack(state["intermediates"]["layer_queries"])


def layers_first(out):
    """Return (B, D, ...) outputs as the reference has them, (D, B, ...), lanes as one vector each."""
    out = {name: value.swapaxes(0, 1) for name, value in out.items()}
    return out | {"all_lanes_preds": out["all_lanes_preds"].reshape(*out["all_lanes_preds"].shape[:3], -1)}


def by_layer(name, term):
    """Return a loss of every decoder layer (D,) by the reference's names: `loss.d0.<name>`, ..., `loss.<name>`."""
    return {f"loss.d{i}.{name}": term[i] for i in range(len(term) - 1)} | {f"loss.{name}": term[-1]}


def check(case, outputs):
    """Compare a function (torch params, inputs) -> (outputs by name, anything) with the reference; return the latter.

    Lanes are in metres, so the reference's own float32 noise there is some 5e-5.
    """
    weights = {name: value for name, value in case.params.items() if name != "code_weights"}
    later = {name for name in case.outputs if name.startswith(("cost.", "match_", "decoded."))}
    return compare(case, outputs, params=weights, ignore=later, tolerances={"all_lanes_preds": 5e-5})


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

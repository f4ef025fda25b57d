"""Auxiliary losses of the lane hosts: denoised lanes, BEV cells, lane proposals. None of the lane papers has them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.losses.common import Report, Terms, declared_outputs, last_layer, without_loss
from tflane_jax.losses.lane_cells import lane_cell_loss, used_lanes
from tflane_jax.losses.lane_proposals import lane_proposal_sums
from tflane_jax.losses.lane_weights import LaneWeights
from tflane_jax.matching import Assignment
from tflane_jax.models.auxiliary import AuxiliaryName, AuxiliaryOutputs
from tflane_jax.scene import CenterlinePrediction, LaneGraph, LinePrediction, SegmentPrediction

T = TypeVar("T", CenterlinePrediction, SegmentPrediction, LinePrediction)


def auxiliary_losses(
    outputs: AuxiliaryOutputs,
    names: Sequence[AuxiliaryName],
    lanes: LaneGraph,
    *,
    weights: LaneWeights,
    bev_range: PerceptionRange,
    denoising: Callable[[Any, LaneGraph], Terms],
    cell_lanes: LaneGraph | None = None,
) -> tuple[list[Float[Array, ""]], Report]:
    """Return the weighted auxiliary losses of a batch, to be summed in this order, and the numbers to record.

    Args:
        outputs: auxiliary outputs, leading axis batch.
        names: the auxiliary outputs that the host declares.
        lanes: ground truth, leading axis batch; padding may hold anything.
        weights: `cell_weight` of BEV cells; `proposal_weight` and `points_weight` of the heat map and of the shapes of
            proposed lanes. `denoising` has its own.
        bev_range: the box that the BEV features cover, metres.
        denoising: from predictions of denoised lanes and the ground truth to weighted losses per layer.
        cell_lanes: ground truth of the BEV cells, where it is not `lanes`.

    Raises:
        ValueError: a declared auxiliary output is missing, or has no loss here.
    """
    losses, report = [], {}
    for name, output in declared_outputs(outputs, names):
        if name == "denoised":
            terms = denoising(output, lanes)
            losses.append(sum(term.sum() for term in terms.values()))
            report |= {f"denoised_{key}": value for key, value in last_layer(terms).items()}
        elif name == "lane_cells":
            each = jax.vmap(lane_cell_loss, in_axes=(0, 0, None, None))
            inside = lanes if cell_lanes is None else cell_lanes
            used = used_lanes(inside.valid)
            report["cells"] = weights.cell_weight * each(output, inside, bev_range, used).mean()
            losses.append(report["cells"])
        elif name == "lane_proposals":
            each = jax.vmap(partial(lane_proposal_sums, range_=bev_range))
            count = jnp.maximum(lanes.valid.sum(), 1).astype(jnp.float32)
            heat, shapes = each(output, lanes)
            report["proposal_heat"] = weights.proposal_weight * heat.sum() / count
            report["proposal_points"] = weights.points_weight * shapes.sum() / count
            losses += [report["proposal_heat"], report["proposal_points"]]
        else:
            raise without_loss(name, "auxiliary_losses")
    return losses, report


def denoising_pairs(prediction: T, truth: Any, valid: Bool[Array, "b n"]) -> tuple[T, Assignment, Any]:
    """Return predictions of noised lanes, their assignment and ground truth, with every copy as a separate example.

    Query i belongs to lane i; lanes beyond the number of queries are left out.

    Args:
        prediction: centerlines, segments or map lines, leading axes (batch, copy, layer).
        truth: pytree of the ground truth, leading axis batch.
        valid: which lanes exist.
    """
    batch, copies, layers, queries = prediction.logits.shape[:4]
    capacity = valid.shape[1]
    own = jnp.arange(capacity)
    there = valid & (own < queries)[None]
    assignment = Assignment(
        query=jnp.broadcast_to(jnp.where(there, own[None], 0)[:, None, None], (batch, copies, layers, capacity)),
        matched=jnp.broadcast_to(there[:, None, None], (batch, copies, layers, capacity)),
    )
    prediction, assignment = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (prediction, assignment))
    return prediction, assignment, jax.tree.map(lambda leaf: jnp.repeat(leaf, copies, 0), truth)

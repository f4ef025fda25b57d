"""TopoNet's loss of lane graphs and traffic elements, with deep supervision (Li et al. 2023).

Per decoder layer: focal loss on the lane class, L1 on matched centerlines in metres, focal loss on every entry of the
predicted adjacencies, and the losses of traffic elements (`losses.traffic_elements`). Lanes are directed: a target has
one orientation only. Weights and conventions: docs/reference/toponet.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry.bezier import bezier_fit
from tflane_jax.losses.auxiliary import auxiliary_losses, denoising_pairs
from tflane_jax.losses.common import (
    HostLossConfig,
    Report,
    Terms,
    class_losses,
    edge_loss,
    last_layer,
    last_layers,
    matched,
    over_matched,
    total,
)
from tflane_jax.losses.costs import focal_cost, pairwise_l1
from tflane_jax.losses.lane_weights import LaneWeights
from tflane_jax.losses.traffic_elements import (
    assign_elements,
    clear_padding,
    element_losses,
    true_elements,
)
from tflane_jax.matching import Assignment, match
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.scene import (
    CenterlinePrediction,
    ElementPrediction,
    Example,
    LaneGraph,
    Prediction,
    TrafficElements,
)


@dataclass(frozen=True)
class TopoNetLossConfig(LaneWeights, HostLossConfig):
    """Weights, see `LaneWeights`; the defaults are TopoNet's. Topology losses are means over all pairs of queries."""

    def loss(
        self, outputs: Prediction, auxiliary: AuxiliaryOutputs, batch: Example, host: Any
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of a batch and the numbers to record, see `HostLossConfig.loss`."""
        return lane_graph_host_loss(self, outputs, auxiliary, batch, host, None)


def lane_graph_host_loss(
    config: TopoNetLossConfig,
    outputs: Prediction,
    auxiliary: AuxiliaryOutputs,
    batch: Example,
    host: Any,
    control_points: int | None,
) -> tuple[Float[Array, ""], Report]:
    """Return the loss of a lane-graph host: lanes, traffic elements if it predicts them, and auxiliary losses.

    Args:
        config: weights.
        outputs, auxiliary, batch, host: see `HostLossConfig.loss`.
        control_points: see `matching_cost`.

    Raises:
        UserError: elements are predicted, but the data have none.
    """
    elements, sizes = (None, None) if outputs.elements is None else true_elements(batch)
    loss, report = lane_graph_loss(outputs, batch.lanes, config, elements, sizes, control_points)
    further, more = auxiliary_losses(
        auxiliary,
        host.auxiliary,
        batch.lanes,
        weights=config,
        bev_range=host.bev_range,
        denoising=partial(lane_denoising_losses, config=config, control_points=control_points),
    )
    for term in further:
        loss += term
    return loss, report | more


def lane_graph_loss(
    prediction: Prediction,
    lanes: LaneGraph,
    config: TopoNetLossConfig,
    elements: TrafficElements | None = None,
    size: Int[Array, "b 2"] | None = None,
    control_points: int | None = None,
) -> tuple[Float[Array, ""], Report]:
    """Return the loss of a batch and its terms; lanes and elements take one call of `match` each.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer). A topology may have the last layers
            only.
        lanes: ground truth, leading axis batch.
        config: weights.
        elements: ground truth, required if the prediction has elements.
        size: width and height of the front images, pixels; required likewise.
        control_points: see `matching_cost`.

    Returns:
        The sum over layers of all weighted terms, and the terms of the last layer under `class`, `points`, `successor`,
        `element_class`, `element_box`, `element_iou`, `element_lane`; and `matching/lanes` and `matching/elements`,
        the mean numbers of matched lanes and elements per example.

    Raises:
        ValueError: the prediction has no centerlines, or elements without ground truth; this is not a batch.
    """
    if prediction.centerlines is None:
        raise ValueError("a lane-graph loss needs predicted centerlines")
    if lanes.valid.ndim != 2:
        raise ValueError(f"expected a batch (lanes.valid of shape (batch, n)), but it is of shape {lanes.valid.shape}")
    # Padding may hold NaN; clear it, so that 0 * padding is 0.
    lanes = lanes.replace(points=jnp.where(lanes.valid[..., None, None], lanes.points, 0.0))  # pyright: ignore
    cost = jax.vmap(lambda p, g: matching_cost(p, g, config, control_points))(prediction.centerlines, lanes)
    assignment = match(cost, lanes.valid[:, None], config.matcher)  # (B, D, N): one call of `match`
    terms = lane_losses(prediction.centerlines, assignment, lanes, config, control_points)
    report = {"matching/lanes": matched(assignment)}
    if prediction.elements is not None:
        if elements is None or size is None:
            raise ValueError("a loss of predicted traffic elements needs the true ones and the size of their images")
        elements = clear_padding(elements)
        found = assign_elements(prediction.elements, elements, size, config.elements, config.matcher)
        terms |= element_losses(prediction.elements, found, elements, size, config.elements)
        terms["element_lane"] = element_lane_loss(prediction.elements, assignment, found, lanes, elements, config)
        report["matching/elements"] = matched(found)
    return total(terms), last_layer(terms) | report


def matching_cost(
    prediction: CenterlinePrediction, lanes: LaneGraph, config: TopoNetLossConfig, control_points: int | None = None
) -> Float[Array, "layers q n"]:
    """Return the cost of matching each lane with each query, for one example; columns of padding are arbitrary.

    Lanes are compared by `control_points` Bezier control points fitted to them; by their points if it is None.
    """
    cost_class = focal_cost(prediction.logits, config.alpha, config.gamma)  # (D, Q, 1), broadcast over lanes
    cost_points = pairwise_l1(_lines(prediction.points, control_points), _lines(lanes.points, control_points)[None])
    return config.class_weight * cost_class + config.points_weight * cost_points


def lane_losses(
    prediction: CenterlinePrediction,
    assignment: Assignment,
    lanes: LaneGraph,
    config: TopoNetLossConfig,
    control_points: int | None = None,
) -> Terms:
    """Return the weighted losses `class`, `points` and `successor` of every layer of a batch; `lanes` has no NaN."""
    layer = jax.vmap(
        jax.vmap(partial(_lane_sums, config=config, control_points=control_points), in_axes=(0, 0, 0, None)),
        in_axes=(0, 0, 0, 0),
    )
    classes, points = layer(prediction.points, prediction.logits, assignment, lanes)  # each (B, D)
    edges = lanes.successor & lanes.valid[:, :, None] & lanes.valid[:, None, :]
    if prediction.successor_logits is None:
        raise ValueError("this loss needs a host that predicts topology (successor_logits)")
    related = last_layers(assignment, prediction.successor_logits.shape[1])
    successors = edge_loss(prediction.successor_logits, related, related, edges, config.alpha, config.gamma)
    return {
        "class": over_matched(config.class_weight, classes, assignment, config.class_mean),
        "points": over_matched(config.points_weight, points, assignment, "batch"),
        "successor": config.successor_weight * successors,
    }


def lane_denoising_losses(
    prediction: CenterlinePrediction, lanes: LaneGraph, config: TopoNetLossConfig, control_points: int | None = None
) -> Terms:
    """Return the `lane_losses` of noised lanes without matching: query i belongs to lane i.

    Args:
        prediction: leading axes (batch, copy, layer); see `models.lane_denoising`.
        lanes: ground truth; lanes beyond the number of queries are left out, padding may hold anything.
        config: weights.
        control_points: see `matching_cost`.
    """
    lanes = lanes.replace(points=jnp.where(lanes.valid[..., None, None], lanes.points, 0.0))  # pyright: ignore
    prediction, assignment, lanes = denoising_pairs(prediction, lanes, lanes.valid)
    return lane_losses(prediction, assignment, lanes, config, control_points)


def element_lane_loss(
    prediction: ElementPrediction,
    lane_assignment: Assignment,
    element_assignment: Assignment,
    lanes: LaneGraph,
    elements: TrafficElements,
    config: TopoNetLossConfig,
) -> Float[Array, " layers"]:
    """Return the weighted loss of the lane-element topology of every layer of a batch that predicts it."""
    if prediction.lane_logits is None:
        raise ValueError("this loss needs a host that predicts lane-element topology (lane_logits)")
    if elements.lane is None:
        raise UserError(
            "this loss needs traffic elements that govern centerlines: set data.example.elements_of to centerlines "
            "(built-in world), or the flavour of OpenLane-V2 (data.flavour)"
        )
    layers = prediction.lane_logits.shape[1]
    edges = elements.lane & lanes.valid[:, :, None] & elements.valid[:, None, :]
    rows, columns = last_layers(lane_assignment, layers), last_layers(element_assignment, layers)
    return config.element_lane_weight * edge_loss(
        prediction.lane_logits, rows, columns, edges, config.alpha, config.gamma
    )


def _lane_sums(
    points: Float[Array, "q p 3"],
    logits: Float[Array, "q 1"],
    assignment: Assignment,
    lanes: LaneGraph,
    config: TopoNetLossConfig,
    control_points: int | None,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the sums of class losses and of point errors, for one layer of one example."""
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, len(logits))
    error = jnp.abs(_lines(points[assignment.query], control_points) - _lines(lanes.points, control_points)).sum(-1)
    quality = None if config.class_target == "one" else lane_quality(points[assignment.query], lanes.points)
    classes = class_losses(logits, query, 0, quality, config.alpha, config.gamma)
    return classes.sum(), jnp.where(assignment.matched, error, 0.0).sum()


def lane_quality(points: Float[Array, "n p 3"], truth: Float[Array, "n p 3"]) -> Float[Array, " n"]:
    """Return 1 / (1 + (d / 2 m)^2), where d is the largest distance between corresponding points, metres.

    d bounds the Frechet distance, which the metrics compare with 1, 2 and 3 m.
    """
    squared = ((points - truth) ** 2).sum(-1).max(-1)
    return 1.0 / (1.0 + squared / 4.0)


def _lines(points: Float[Array, "*b p 3"], control_points: int | None) -> Float[Array, "*b d"]:
    """Return the points or the control points of a centerline as one vector."""
    if control_points is not None:
        fit = bezier_fit(points.shape[-2], control_points).astype(points.dtype)
        points = jnp.einsum("kp,...pc->...kc", fit, points, precision="highest")
    return points.reshape(*points.shape[:-2], points.shape[-2] * points.shape[-1])  # -1 fails without lanes

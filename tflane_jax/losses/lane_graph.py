"""Loss of a lane graph with its traffic elements: TopoNet's, with deep supervision (specs/modules.md section 5).

Per decoder layer: focal loss on the lane class, L1 on the matched centerlines in metres, focal loss on every entry of
the predicted adjacency, and the same for traffic elements. Lanes are directed, so a target has one orientation only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.geometry.bezier import bezier_fit
from tflane_jax.losses.costs import focal_cost, pairwise_l1
from tflane_jax.losses.traffic_elements import ElementLossConfig, clear_padding, element_cost, element_terms
from tflane_jax.matching import Assignment, match
from tflane_jax.scene import ElementPrediction, LaneGraph, LanePrediction, Prediction, TrafficElements

Terms = dict[str, Float[Array, " layers"]]


@dataclass(frozen=True)
class LaneGraphLossConfig:
    """Weights of matching costs and loss terms; the defaults are TopoNet's.

    Attributes:
        class_weight, points_weight: of cost and loss alike; points are in metres, summed over coordinates.
        successor_weight, element_lane_weight: of the topologies' losses, means over all pairs of queries.
        alpha, gamma: of every focal term.
        matcher: backend of `matching.match`.
        control_points: compare Bezier control points fitted to the centerlines, so many, instead of their points
            (OpenLane-V2's baseline: 5).
        elements: weights of traffic elements.
        cell_weight: of the auxiliary loss on BEV cells, where the encoder has it (`losses.lane_cells`).
    """

    class_weight: float = 1.5
    points_weight: float = 0.025
    successor_weight: float = 5.0
    alpha: float = 0.25
    gamma: float = 2.0
    matcher: Literal["scipy", "jax"] = "scipy"
    element_lane_weight: float = 5.0
    control_points: int | None = None
    elements: ElementLossConfig = ElementLossConfig()
    cell_weight: float = 1.0


def lane_graph_loss(
    prediction: Prediction,
    lanes: LaneGraph,
    config: LaneGraphLossConfig,
    elements: TrafficElements | None = None,
    size: Int[Array, "b 2"] | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Return the loss of a batch and its terms; lanes and elements are matched by one host call each.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer). A topology may have fewer layers: the
            last ones.
        lanes: ground truth, leading axis batch.
        config: weights.
        elements: ground truth, needed where the prediction has elements.
        size: width and height of the front images, likewise.

    Returns:
        The sum over layers of all weighted terms, and the terms of the last layer under `class`, `points`, `successor`,
        `element_class`, `element_box`, `element_iou`, `element_lane`, beside `matching/lanes` and `matching/elements`,
        the mean numbers of matched lanes and elements.

    Raises:
        ValueError: a prediction without lanes, or with elements and nothing to compare them with.
    """
    if prediction.lanes is None:
        raise ValueError("a lane-graph loss needs predicted lanes")
    # Padding may hold anything; from here on it holds zeros, so that 0 * padding is 0.
    lanes = lanes.replace(points=jnp.where(lanes.valid[..., None, None], lanes.points, 0.0))  # pyright: ignore
    cost = jax.vmap(lambda p, g: matching_cost(p, g, config))(prediction.lanes, lanes)
    assignment = match(cost, lanes.valid[:, None], config.matcher)  # (B, D, N): one host call
    terms = lane_losses(prediction.lanes, assignment, lanes, config)
    report = {"matching/lanes": _matched(assignment)}
    if prediction.elements is not None:
        if elements is None or size is None:
            raise ValueError("a loss of predicted traffic elements needs the true ones and the size of their images")
        elements = clear_padding(elements)
        each = partial(element_cost, config=config.elements)
        found = match(jax.vmap(each)(prediction.elements, elements, size), elements.valid[:, None], config.matcher)
        terms |= element_losses(prediction.elements, found, elements, size, config)
        terms["element_lane"] = element_lane_loss(prediction.elements, assignment, found, lanes, elements, config)
        report["matching/elements"] = _matched(found)
    total = jnp.stack([term.sum() for term in terms.values()]).sum()
    return total, {name: term[-1] for name, term in terms.items()} | report


def matching_cost(
    prediction: LanePrediction, lanes: LaneGraph, config: LaneGraphLossConfig
) -> Float[Array, "layers q n"]:
    """Return the cost of giving each lane to each query, for one example; columns of padding are arbitrary."""
    cost_class = focal_cost(prediction.logits, config.alpha, config.gamma)  # (D, Q, 1), broadcast over lanes
    cost_points = pairwise_l1(_lines(prediction.points, config), _lines(lanes.points, config)[None])
    return config.class_weight * cost_class + config.points_weight * cost_points


def lane_losses(
    prediction: LanePrediction, assignment: Assignment, lanes: LaneGraph, config: LaneGraphLossConfig
) -> Terms:
    """Return the weighted losses `class`, `points` and `successor` of every layer of a batch; no NaN in `lanes`."""
    layer = jax.vmap(jax.vmap(partial(_lane_sums, config=config), in_axes=(0, 0, 0, None)), in_axes=(0, 0, 0, 0))
    classes, points = layer(prediction.points, prediction.logits, assignment, lanes)  # each (B, D)
    edges = lanes.successor & lanes.valid[:, :, None] & lanes.valid[:, None, :]
    related = _last(assignment, prediction.successor_logits.shape[1])
    successors = _edge_loss(prediction.successor_logits, related, related, edges, config)
    positives = _positives(assignment)
    return {
        "class": config.class_weight * classes.sum(0) / positives,
        "points": config.points_weight * points.sum(0) / positives,
        "successor": config.successor_weight * successors,
    }


def lane_denoising_losses(prediction: LanePrediction, lanes: LaneGraph, config: LaneGraphLossConfig) -> Terms:
    """Return what `lane_losses` does, for noised lanes: query i belongs to lane i, so nothing is matched.

    Args:
        prediction: leading axes (batch, copy, layer); see `models.lane_denoising`.
        lanes: truth of the batch; lanes beyond the number of queries are left out, padding may hold anything.
        config: weights.
    """
    lanes = lanes.replace(points=jnp.where(lanes.valid[..., None, None], lanes.points, 0.0))  # pyright: ignore
    batch, copies, layers, queries = prediction.logits.shape[:4]
    capacity = lanes.valid.shape[1]
    own = jnp.arange(capacity)
    there = lanes.valid & (own < queries)[None]
    assignment = Assignment(
        query=jnp.broadcast_to(jnp.where(there, own[None], 0)[:, None, None], (batch, copies, layers, capacity)),
        matched=jnp.broadcast_to(there[:, None, None], (batch, copies, layers, capacity)),
    )
    prediction, assignment = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (prediction, assignment))
    return lane_losses(prediction, assignment, jax.tree.map(lambda leaf: jnp.repeat(leaf, copies, 0), lanes), config)


def element_losses(
    prediction: ElementPrediction,
    assignment: Assignment,
    elements: TrafficElements,
    size: Int[Array, "b 2"],
    config: LaneGraphLossConfig,
) -> Terms:
    """Return the weighted losses `element_class`, `element_box` and `element_iou` of every layer of a batch."""
    weights = config.elements
    # The topology has layers of its own.
    prediction = prediction.replace(lane_logits=None)  # pyright: ignore[reportAttributeAccessIssue]
    each = jax.vmap(partial(element_terms, config=weights), in_axes=(0, 0, None, None))
    classes, boxes, apart = jax.vmap(each)(prediction, assignment, elements, size)  # each (B, D)
    positives = _positives(assignment)
    return {
        "element_class": weights.class_weight * classes.sum(0) / positives,
        "element_box": weights.box_weight * boxes.sum(0) / positives,
        "element_iou": weights.iou_weight * apart.sum(0) / positives,
    }


def element_lane_loss(
    prediction: ElementPrediction,
    lane_assignment: Assignment,
    element_assignment: Assignment,
    lanes: LaneGraph,
    elements: TrafficElements,
    config: LaneGraphLossConfig,
) -> Float[Array, " layers"]:
    """Return the weighted loss of the lane-element topology of every layer of a batch that predicts it."""
    layers = prediction.lane_logits.shape[1]
    edges = elements.lane & lanes.valid[:, :, None] & elements.valid[:, None, :]
    rows, columns = _last(lane_assignment, layers), _last(element_assignment, layers)
    return config.element_lane_weight * _edge_loss(prediction.lane_logits, rows, columns, edges, config)


def _lane_sums(
    points: Float[Array, "q p 3"],
    logits: Float[Array, "q 1"],
    assignment: Assignment,
    lanes: LaneGraph,
    config: LaneGraphLossConfig,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return class sum and points sum of one layer of one example."""
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, len(logits))
    is_lane = jnp.zeros(logits.shape).at[query, 0].set(1.0, mode="drop")
    error = jnp.abs(_lines(points[assignment.query], config) - _lines(lanes.points, config)).sum(-1)
    return _focal(logits, is_lane, config).sum(), jnp.where(assignment.matched, error, 0.0).sum()


def _edge_loss(
    logits: Float[Array, "b layers q r"],
    rows: Assignment,
    columns: Assignment,
    edges: Bool[Array, "b n m"],
    config: LaneGraphLossConfig,
) -> Float[Array, " layers"]:
    """Return the mean focal loss over all pairs of queries of a batch; pairs that are not matched are no edges."""

    def one(logits, rows, columns, edges):
        row, column = (
            jnp.where(side.matched, side.query, count)
            for side, count in zip((rows, columns), logits.shape, strict=True)
        )
        true = jnp.zeros(logits.shape).at[row[:, None], column[None, :]].set(edges.astype(jnp.float32), mode="drop")
        return _focal(logits, true, config).mean() if logits.size else jnp.zeros(())

    return jax.vmap(jax.vmap(one, in_axes=(0, 0, 0, None)))(logits, rows, columns, edges).mean(0)


def _focal(logits, target, config: LaneGraphLossConfig):
    return optax.losses.sigmoid_focal_loss(logits, target, alpha=config.alpha, gamma=config.gamma)


def _lines(points: Float[Array, "*b p 3"], config: LaneGraphLossConfig) -> Float[Array, "*b d"]:
    """Return what is compared of a centerline: its points or its control points, as one vector."""
    if config.control_points is not None:
        fit = bezier_fit(points.shape[-2], config.control_points).astype(points.dtype)
        points = jnp.einsum("kp,...pc->...kc", fit, points)
    return points.reshape(*points.shape[:-2], -1)


def _last(assignment: Assignment, layers: int) -> Assignment:
    """Return the assignments (B, D, N) of the last layers."""
    return jax.tree.map(lambda leaf: leaf[:, leaf.shape[1] - layers :], assignment)


def _positives(assignment: Assignment) -> Float[Array, " layers"]:
    """Return what sums over a batch are divided by in the reference: its number of positives, at least one."""
    return jnp.maximum(assignment.matched.sum((0, 2)).astype(jnp.float32), 1.0)


def _matched(assignment: Assignment) -> Float[Array, ""]:
    return assignment.matched[:, -1].sum(-1).astype(jnp.float32).mean()

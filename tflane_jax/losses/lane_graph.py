"""Loss of a lane graph: TopoNet's, with deep supervision (specs/modules.md section 5).

Per decoder layer: focal loss on the lane class, L1 on the matched centerlines in metres, focal loss on every entry of
the predicted adjacency. Lanes are directed, so a target has one orientation only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from tflane_jax.losses.costs import focal_cost, pairwise_l1
from tflane_jax.matching import Assignment, match
from tflane_jax.scene import LaneGraph, LanePrediction


@dataclass(frozen=True)
class LaneGraphLossConfig:
    """Weights of matching costs and loss terms; the defaults are TopoNet's.

    Attributes:
        class_weight, points_weight: of cost and loss alike; points are in metres, summed over coordinates.
        successor_weight: of the adjacency loss, a mean over all pairs of queries.
        alpha, gamma: of every focal term.
        matcher: backend of `matching.match`.
    """

    class_weight: float = 1.5
    points_weight: float = 0.025
    successor_weight: float = 5.0
    alpha: float = 0.25
    gamma: float = 2.0
    matcher: Literal["scipy", "jax"] = "scipy"


def matching_cost(
    prediction: LanePrediction, lanes: LaneGraph, config: LaneGraphLossConfig
) -> Float[Array, "layers q n"]:
    """Return the cost of giving each lane to each query, for one example; columns of padding are arbitrary."""
    layers, queries = prediction.points.shape[:2]
    cost_class = focal_cost(prediction.logits, config.alpha, config.gamma)  # (D, Q, 1), broadcast over lanes
    target = lanes.points.reshape(1, lanes.points.shape[0], -1)
    cost_points = pairwise_l1(prediction.points.reshape(layers, queries, -1), target)
    return config.class_weight * cost_class + config.points_weight * cost_points


def lane_graph_loss(
    prediction: LanePrediction, lanes: LaneGraph, config: LaneGraphLossConfig
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Return the loss of a batch and its terms.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer).
        lanes: ground truth, leading axis batch.
        config: weights.

    Returns:
        The sum over layers of all weighted terms, and the terms of the last layer under `class`, `points`, `successor`
        beside `matching/lanes`, the mean number of matched lanes.
    """
    # Padding may hold anything; from here on it holds zeros, so that 0 * padding is 0.
    lanes = lanes.replace(points=jnp.where(lanes.valid[..., None, None], lanes.points, 0.0))  # pyright: ignore
    cost = jax.vmap(lambda p, g: matching_cost(p, g, config))(prediction, lanes)
    assignment = match(cost, lanes.valid[:, None], config.matcher)  # (B, D, N): one host call
    per_layer = jax.vmap(jax.vmap(lambda p, a, g: _terms(p, a, g, config), in_axes=(0, 0, None)))
    classes, points, successors = per_layer(prediction, assignment, lanes)  # each (B, D)

    # Reference reduction: sums over the batch divided by its number of positives, at least one.
    positives = jnp.maximum(assignment.matched.sum((0, 2)).astype(jnp.float32), 1.0)
    terms = {
        "class": config.class_weight * classes.sum(0) / positives,
        "points": config.points_weight * points.sum(0) / positives,
        "successor": config.successor_weight * successors.mean(0),
    }
    total = jnp.stack(list(terms.values())).sum()
    report = {name: value[-1] for name, value in terms.items()}
    report["matching/lanes"] = assignment.matched[:, -1].sum(-1).astype(jnp.float32).mean()
    return total, report


def _terms(
    prediction: LanePrediction, assignment: Assignment, lanes: LaneGraph, config: LaneGraphLossConfig
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return class sum, points sum and mean adjacency loss of one layer of one example."""
    focal = partial(optax.losses.sigmoid_focal_loss, alpha=config.alpha, gamma=config.gamma)
    queries = prediction.points.shape[0]
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, queries)

    is_lane = jnp.zeros((queries, 1)).at[query, 0].set(1.0, mode="drop")
    class_loss = focal(prediction.logits, is_lane).sum()

    error = jnp.abs(prediction.points[assignment.query] - lanes.points).sum((-2, -1))
    points_loss = jnp.where(assignment.matched, error, 0.0).sum()

    edges = lanes.successor & lanes.valid[:, None] & lanes.valid[None, :]
    adjacency = jnp.zeros((queries, queries)).at[query[:, None], query[None, :]].set(
        edges.astype(jnp.float32), mode="drop"
    )
    successor_loss = focal(prediction.successor_logits, adjacency).mean()
    return class_loss, points_loss, successor_loss

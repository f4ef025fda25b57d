"""LaneSegNet's loss of lane segments, with deep supervision (Li et al. 2024).

Per decoder layer: focal loss on the classes, L1 on centerline and boundaries in metres, cross-entropy and dice on the
masks, cross-entropy on the line types. For the last layer: focal loss on the topology of matched segments. Segments are
directed. Weights and conventions: docs/reference/lanesegnet.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from tflane_jax.errors import UserError
from tflane_jax.limits import PositiveOrZero
from tflane_jax.losses.areas import AreaLossConfig, area_loss
from tflane_jax.losses.auxiliary import auxiliary_losses, denoising_pairs
from tflane_jax.losses.common import (
    ClassMean,
    HostLossConfig,
    Report,
    Terms,
    class_losses,
    last_layer,
    matched,
    matched_edge_sums,
    over_matched,
    total,
)
from tflane_jax.losses.costs import dice_cost, focal_cost, mask_cost, pairwise_l1
from tflane_jax.losses.lane_weights import LaneWeights
from tflane_jax.losses.segment_masks import Raster, segment_masks
from tflane_jax.losses.toponet import lane_quality
from tflane_jax.losses.traffic_elements import (
    assign_elements,
    clear_padding,
    element_losses,
    true_elements,
)
from tflane_jax.matching import Assignment, match
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.models.segment_truth import (
    LANE,
    SegmentTargets,
    governed_rows,
    ordered_targets,
    target_lanes,
    target_lines,
)
from tflane_jax.scene import ElementPrediction, Example, Prediction, SegmentPrediction


@dataclass(frozen=True)
class LaneSegNetLossConfig(LaneWeights, HostLossConfig):
    """Weights of matching costs and loss terms; the defaults are LaneSegNet's.

    Attributes:
        mask_weight, dice_weight: weights of both cost and loss of masks.
        type_weight: weight of the line types of either boundary.
        dice_cost: the dice cost takes the masks' "logits", as the published configuration does, or their
            "probabilities", as the dice loss does.
        raster: how the mask targets are drawn.
        areas: weights of areas, where the model predicts them.
        others: see `LaneWeights`. Points are those of all three lines. The loss of both topologies is that of the
            published code; `class_mean` holds for line types, and for the pairs of both topologies, too.
    """

    mask_weight: PositiveOrZero = 3.0
    dice_weight: PositiveOrZero = 3.0
    type_weight: PositiveOrZero = 0.1
    dice_cost: Literal["logits", "probabilities"] = "logits"
    raster: Raster = "cells"
    areas: AreaLossConfig = AreaLossConfig()

    def loss(
        self, outputs: Prediction, auxiliary: AuxiliaryOutputs, batch: Example, host: Any
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of a batch and the numbers to record, see `HostLossConfig.loss`."""
        segments = outputs.segments
        if segments is None or segments.mask_logits is None or segments.successor_logits is None:
            raise ValueError("LaneSegNet's loss needs predicted segments with masks and topology")
        bev_range, shape = host.bev_range, segments.mask_logits.shape[-2:]
        classes = host.decoder.classes
        targets = jax.vmap(partial(ordered_targets, center=host.center, classes=classes))(batch.segments, batch.areas)
        masks = jax.vmap(partial(target_masks, shape=shape, range_=bev_range, raster=self.raster))(targets)
        assignment = assign_segments(segments, targets, masks, self)
        loss, report = segment_loss(segments, targets, masks, self, assignment)
        if segments.areas is not None:
            of_areas, terms = area_loss(segments.areas, batch.areas, self.areas, self.matcher)
            loss, report = loss + of_areas, report | terms
        if outputs.elements is not None:
            of_elements, terms = self._element_loss(outputs.elements, _last(assignment), targets, batch)
            loss, report = loss + of_elements, report | terms

        def denoising(found, _):
            return segment_denoising_losses(found, targets, masks, self)

        further, more = auxiliary_losses(
            auxiliary,
            host.auxiliary,
            target_lanes(targets),
            weights=self,
            bev_range=bev_range,
            denoising=denoising,
            cell_lanes=batch.segments,
        )
        for term in further:
            loss += term
        return loss, report | more

    def _element_loss(
        self, prediction: ElementPrediction, segments: Assignment, targets: SegmentTargets, batch: Example
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of traffic elements and of their topology with the segments, and its terms."""
        elements, size = true_elements(batch)
        if elements.segment is None:
            raise UserError(
                "this loss needs traffic elements that govern segments: set data.example.elements_of to segments "
                "(built-in world), or the flavour of OpenLane-V2 (data.flavour)"
            )
        elements = clear_padding(elements)
        found = assign_elements(prediction, elements, size, self.elements, self.matcher)
        terms = element_losses(prediction, found, elements, size, self.elements)
        edges = jax.vmap(partial(governed_rows, rows=segments.query.shape[-1]))(batch.segments, elements.segment)
        losses, counts = matched_edge_sums(
            jnp.asarray(prediction.lane_logits)[:, -1],
            _of_lanes(segments, targets),
            _last(found),
            edges,
            (self.alpha, self.gamma),
        )
        terms["element_lane"] = _pair_mean(self.element_lane_weight, losses, counts, self.class_mean)[None]
        return total(terms), last_layer(terms) | {"matching/elements": matched(found)}


def target_masks(targets: SegmentTargets, shape: tuple[int, int], range_: Any, raster: Raster) -> Float[Array, "n h w"]:
    """Return the masks of one example's targets, 0 for padding."""
    masks = segment_masks(targets.left, targets.right, shape, range_, raster)  # pyright: ignore[reportArgumentType]
    return (masks & targets.valid[:, None, None]).astype(jnp.float32)


def segment_loss(
    prediction: SegmentPrediction,
    targets: SegmentTargets,
    masks: Float[Array, "b n h w"],
    config: LaneSegNetLossConfig,
    assignment: Assignment | None = None,
) -> tuple[Float[Array, ""], Report]:
    """Return the loss of a batch and its terms.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer); the topology has the last layer only.
        targets: ground truth, leading axis batch.
        masks: of the targets.
        config: weights.
        assignment: of `assign_segments`, if known.

    Returns:
        The sum over layers of all weighted terms, and the terms of the last layer under `class`, `points`, `mask`,
        `dice`, `line_type`, `successor`; and `matching/segments`, the mean number of matched segments per example.
    """
    if assignment is None:
        assignment = assign_segments(prediction, targets, masks, config)
    terms = segment_losses(prediction, assignment, targets, masks, config)
    return total(terms), last_layer(terms) | {"matching/segments": matched(assignment)}


def assign_segments(
    prediction: SegmentPrediction,
    targets: SegmentTargets,
    masks: Float[Array, "b n h w"],
    config: LaneSegNetLossConfig,
) -> Assignment:
    """Return the assignment (B, D, N) of a batch."""
    layers = replace(prediction, successor_logits=None, areas=None)
    each = jax.vmap(partial(matching_cost, config=config), in_axes=(0, None, None))
    cost = jax.vmap(each)(layers, targets, masks)
    return match(cost, targets.valid[:, None], config.matcher)


def matching_cost(
    prediction: SegmentPrediction, targets: SegmentTargets, masks: Float[Array, "n h w"], config: LaneSegNetLossConfig
) -> Float[Array, "q n"]:
    """Return the cost of matching each query of one layer with each target; columns of padding are arbitrary."""
    by_class = focal_cost(prediction.logits, config.alpha, config.gamma)[:, targets.category]
    flat = lambda rows: rows.reshape(len(rows), math.prod(rows.shape[1:]))  # noqa: E731
    apart = pairwise_l1(flat(_lines(prediction)), flat(target_lines(targets)))
    logits, cells = flat(prediction.mask_logits), flat(masks)
    overlap = dice_cost(logits if config.dice_cost == "logits" else jax.nn.sigmoid(logits), cells)
    return (
        config.class_weight * by_class
        + config.points_weight * apart
        + config.mask_weight * mask_cost(logits, cells)
        + config.dice_weight * overlap
    )


def segment_losses(
    prediction: SegmentPrediction,
    assignment: Assignment,
    targets: SegmentTargets,
    masks: Float[Array, "b n h w"],
    config: LaneSegNetLossConfig,
) -> Terms:
    """Return the weighted losses of every layer of a batch; of the topology, those of the last layer."""
    layers = replace(prediction, successor_logits=None, areas=None)
    each = jax.vmap(partial(_layer_sums, config=config), in_axes=(0, 0, None, None))
    sums = jax.vmap(each)(layers, assignment, targets, masks)  # each (B, D)
    weights = {
        "class": config.class_weight,
        "points": config.points_weight,
        "mask": config.mask_weight,
        "dice": config.dice_weight,
        "line_type": config.type_weight,
    }
    by: dict[str, ClassMean] = {"class": config.class_mean, "line_type": config.class_mean}
    terms = {
        name: over_matched(weight, sums[name], assignment, by.get(name, "batch")) for name, weight in weights.items()
    }
    edges = jnp.asarray(prediction.successor_logits)[:, -1]
    return terms | {"successor": successor_loss(edges, _last(assignment), targets, config)[None]}


def _layer_sums(
    prediction: SegmentPrediction,
    assignment: Assignment,
    targets: SegmentTargets,
    masks: Float[Array, "n h w"],
    config: LaneSegNetLossConfig,
) -> dict[str, Float[Array, ""]]:
    """Return the sums of losses over the queries of one layer of one example."""
    logits, true = jnp.asarray(prediction.logits), target_lines(targets)
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, len(logits))
    lines = _lines(prediction)[assignment.query]
    quality = None if config.class_target == "one" else segment_quality(lines, true)
    classes = class_losses(logits, query, targets.category, quality, config.alpha, config.gamma)
    cells = jnp.asarray(prediction.mask_logits)[assignment.query]
    sides = (prediction.left_type_logits, targets.left_type), (prediction.right_type_logits, targets.right_type)
    each = {
        "points": jnp.abs(lines - true).sum((1, 2, 3)),
        "mask": optax.losses.sigmoid_binary_cross_entropy(cells, masks).mean((1, 2)),
        "dice": dice_loss(jax.nn.sigmoid(cells), masks),
    }
    return {
        "class": classes.sum(),
        **{name: jnp.where(assignment.matched, value, 0.0).sum() for name, value in each.items()},
        "line_type": sum((_type_loss(found, query, types) for found, types in sides), jnp.zeros(())),
    }


def _type_loss(logits, query, types) -> Float[Array, ""]:
    """Return the sum of cross-entropies of one boundary's type; an unmatched query has no type at all."""
    target = jnp.zeros(logits.shape).at[query, types].set(1.0, mode="drop")
    return optax.losses.sigmoid_binary_cross_entropy(logits, target).sum()


def dice_loss(p: Float[Array, "n h w"], masks: Float[Array, "n h w"]) -> Float[Array, " n"]:
    """Return 1 - (2 sum p t + 1) / (sum p + sum t + 1)."""
    return 1.0 - (2.0 * (p * masks).sum((1, 2)) + 1.0) / (p.sum((1, 2)) + masks.sum((1, 2)) + 1.0)


def successor_loss(
    logits: Float[Array, "b q q"], assignment: Assignment, targets: SegmentTargets, config: LaneSegNetLossConfig
) -> Float[Array, ""]:
    """Return the weighted focal loss on the edges between matched lane segments of a batch; 0 without any.

    Pairs with an unmatched query or a crossing do not count.
    """
    lanes = _of_lanes(assignment, targets)
    losses, counts = matched_edge_sums(logits, lanes, lanes, targets.successor, (config.alpha, config.gamma))
    return _pair_mean(config.successor_weight, losses, counts, config.class_mean)


def _pair_mean(
    weight: float, losses: Float[Array, " b"], counts: Float[Array, " b"], mean: ClassMean
) -> Float[Array, ""]:
    """Return the weighted sums of `matched_edge_sums`, divided by the counts of the batch or of each frame."""
    if mean == "batch":
        return weight * losses.sum() / jnp.maximum(counts.sum(), 1.0)
    return weight * (losses / jnp.maximum(counts, 1.0)).mean()


def _last(assignment: Assignment) -> Assignment:
    """Return the assignment (B, N) of the last layer."""
    return jax.tree.map(lambda leaf: leaf[:, -1], assignment)


def _of_lanes(assignment: Assignment, targets: SegmentTargets) -> Assignment:
    """Return an assignment (B, N) in which only lane segments are matched."""
    return replace(assignment, matched=assignment.matched & (targets.category == LANE))


def segment_quality(lines: Float[Array, "n 3 p 3"], truth: Float[Array, "n 3 p 3"]) -> Float[Array, " n"]:
    """Return the mean `lane_quality` of the centerline and of the two boundaries, which count half each."""
    each = jax.vmap(lane_quality, in_axes=1, out_axes=1)(lines, truth)
    return each @ jnp.array([0.5, 0.25, 0.25])


def segment_denoising_losses(
    prediction: SegmentPrediction,
    targets: SegmentTargets,
    masks: Float[Array, "b n h w"],
    config: LaneSegNetLossConfig,
) -> Terms:
    """Return the `segment_losses` of noised segments without matching: query i belongs to target i.

    Args:
        prediction: leading axes (batch, copy, layer); see `models.lane_denoising`.
        targets: ground truth; rows beyond the number of queries are left out.
        masks: of the targets.
        config: weights.
    """
    prediction, assignment, (targets, masks) = denoising_pairs(prediction, (targets, masks), targets.valid)
    return segment_losses(prediction, assignment, targets, masks, config)


def _lines(prediction: SegmentPrediction) -> Float[Array, "q 3 p 3"]:
    """Return centerlines, left and right boundaries, metres."""
    return jnp.stack([jnp.asarray(line) for line in (prediction.points, prediction.left, prediction.right)], 1)

"""Weights that the losses of the lane hosts share: TopoNet, BEVFormer-DETR and LaneSegNet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tflane_jax.limits import Fraction, PositiveOrZero
from tflane_jax.losses.common import ClassMean
from tflane_jax.losses.traffic_elements import ElementLossConfig


@dataclass(frozen=True)
class LaneWeights:
    """Weights of matching costs and loss terms; a loss derives from this and from `HostLossConfig`.

    Attributes:
        class_weight, points_weight: weights of both cost and loss; points in metres, summed over coordinates.
        successor_weight, element_lane_weight: weights of the topology of lanes, and of that with traffic elements.
        alpha, gamma: parameters of the focal terms of lanes. Traffic elements have their own; those of areas (0.25, 2)
            and of the heat map of proposals (2) are fixed.
        matcher: backend of `matching.match`.
        elements: weights of traffic elements, where the model predicts them.
        class_target: of a query matched with a lane: "one", or "quality", which falls with its distance from the lane
            (`losses.toponet.lane_quality`, `losses.lanesegnet.segment_quality`), so that scores rank lanes by their
            precision (Li et al. 2020, quality focal loss).
        class_mean: the class losses are divided by the matched lanes of each "frame", as in the published training, or
            of the "batch", see `losses.common.over_matched`.
        proposal_weight: weight of the heat map of lane proposals; their shapes have `points_weight`.
        cell_weight: of the auxiliary loss on BEV cells, if the host has it (`losses.lane_cells`).
    """

    class_weight: PositiveOrZero = 1.5
    points_weight: PositiveOrZero = 0.025
    successor_weight: PositiveOrZero = 5.0
    element_lane_weight: PositiveOrZero = 5.0
    alpha: Fraction = 0.25
    gamma: PositiveOrZero = 2.0
    matcher: Literal["scipy", "jax"] = "jax"
    elements: ElementLossConfig = ElementLossConfig()
    class_target: Literal["one", "quality"] = "one"
    class_mean: ClassMean = "batch"
    proposal_weight: PositiveOrZero = 1.5
    cell_weight: PositiveOrZero = 1.0

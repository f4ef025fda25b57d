"""Examples and predictions as inputs of the OpenLane-V2 centerline metrics (host, numpy, one frame)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy.special import expit

from tflane_jax.evaluation.geometric_topology import Topology, edge_confidences
from tflane_jax.metrics.frames import ElementDetections, ElementTruth, LaneDetections, LaneTruth
from tflane_jax.scene import CenterlinePrediction, ElementPrediction, LaneGraph, TrafficElements


def truth_of_centerlines(lanes: LaneGraph, elements: TrafficElements | None = None) -> LaneTruth:
    """Return the valid lanes (and traffic elements) of one example.

    Raises ValueError if only segments are known to be governed by the elements.
    """
    keep = np.flatnonzero(np.asarray(lanes.valid))
    truth = None
    if elements is not None:
        if elements.lane is None:
            raise ValueError("these traffic elements govern segments, see ExampleConfig.elements_of")
        shown = np.flatnonzero(np.asarray(elements.valid))
        truth = ElementTruth(
            boxes=np.asarray(elements.box)[shown],
            attributes=np.asarray(elements.attribute)[shown],
            lane=np.asarray(elements.lane)[np.ix_(keep, shown)],
        )
    return LaneTruth(
        points=np.asarray(lanes.points)[keep],
        successor=np.asarray(lanes.successor)[np.ix_(keep, keep)],
        visibility=np.asarray(lanes.visibility)[keep],
        elements=truth,
    )


def detections_of_centerlines(
    prediction: CenterlinePrediction, elements: ElementPrediction | None = None, topology: Topology = "learned"
) -> LaneDetections:
    """Return the lanes (and traffic elements) of all queries of ONE example's last layer, best score first.

    All queries are kept, whatever their score. Without predicted topology, all edges have confidence 0, and otherwise
    that of `geometric_topology.edge_confidences`. A traffic element gets the attribute with the highest score.
    """
    scores = expit(np.asarray(prediction.logits)).max(-1)
    order = np.argsort(-scores, kind="stable")
    edges = edge_confidences(np.asarray(prediction.points), prediction.successor_logits, topology)
    return LaneDetections(
        points=np.asarray(prediction.points)[order],
        scores=scores[order],
        successor=edges[np.ix_(order, order)],
        elements=None if elements is None else detections_of_elements(elements, order),
    )


def detections_of_elements(
    elements: ElementPrediction, lanes: Int[np.ndarray, " p"] | None = None
) -> ElementDetections:
    """Return the traffic elements, best score first, with lanes in the given order (None: query order).

    Raises ValueError if the prediction has no lane-element topology.
    """
    if elements.lane_logits is None:
        raise ValueError("the metrics of traffic elements need the lane-element topology (lane_logits)")
    edges = np.asarray(elements.lane_logits)
    lanes = np.arange(len(edges)) if lanes is None else lanes
    confidence = expit(np.asarray(elements.logits))
    scores = confidence.max(-1)
    order = np.argsort(-scores, kind="stable")
    return ElementDetections(
        boxes=np.asarray(elements.box)[order],
        attributes=confidence.argmax(-1)[order],
        scores=scores[order],
        lane=expit(edges[np.ix_(lanes, order)]),
    )

"""Examples and predictions as inputs of the OpenLane-V2 lane-segment metrics (host, numpy, one frame)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit

from tflane_jax.evaluation.centerlines import detections_of_elements
from tflane_jax.evaluation.geometric_topology import Topology, edge_confidences
from tflane_jax.metrics.frames import ElementDetections, ElementTruth, LaneDetections, LaneTruth
from tflane_jax.metrics.segment_matching import CROSSING, AreaDetections, AreaTruth, SegmentDetections, SegmentTruth
from tflane_jax.scene import (
    AreaPrediction,
    Areas,
    AreaType,
    ElementPrediction,
    LaneGraph,
    SegmentPrediction,
    TrafficElements,
)
from tflane_jax.scene.lane_segments import governed_segments

SEGMENT_CLASSES = ("lane_segment", "ped_crossing")
"""Classes of LaneSegNet's queries."""


def truth_of_segments(
    segments: LaneGraph, areas: Areas, elements: TrafficElements | None = None, lanes: LaneGraph | None = None
) -> SegmentTruth:
    """Return the valid lane segments, areas and traffic elements of one example.

    Crossings are as in the example: closed rings, or with `ExampleConfig.crossings = "sides"` the two long sides, which
    LaneSegNet measures.

    Args:
        segments: lane segments.
        areas: crossings and road boundaries.
        elements: traffic elements; None leaves them out.
        lanes: centerlines. Where the elements tell only these (`TrafficElements.lane`), a segment is governed by the
            elements of the centerlines on which it lies.

    Raises:
        ValueError: the elements tell only centerlines, and there are no `lanes`.
    """
    keep = np.flatnonzero(np.asarray(segments.valid))
    governed = None
    if elements is not None:
        governed = _element_truth(segments, elements, lanes, keep)
    kept_areas = np.asarray(areas.valid)
    return SegmentTruth(
        lanes=LaneTruth(
            points=np.asarray(segments.points)[keep],
            successor=np.asarray(segments.successor)[np.ix_(keep, keep)],
            visibility=np.asarray(segments.visibility)[keep],
            elements=governed,
        ),
        left=np.asarray(segments.left)[keep],
        right=np.asarray(segments.right)[keep],
        areas=AreaTruth(np.asarray(areas.points)[kept_areas], np.asarray(areas.category)[kept_areas]),
        left_type=np.asarray(segments.left_type)[keep],
        right_type=np.asarray(segments.right_type)[keep],
    )


def segment_detections(
    center: Float[np.ndarray, "q p 3"],
    left: Float[np.ndarray, "q p 3"],
    right: Float[np.ndarray, "q p 3"],
    classes: Int[np.ndarray, " q"],
    scores: Float[np.ndarray, " q"],
    successor: Float[np.ndarray, "q q"],
    valid: Bool[np.ndarray, " q"] | None = None,
    elements: ElementDetections | None = None,
    left_type: Int[np.ndarray, " q"] | None = None,
    right_type: Int[np.ndarray, " q"] | None = None,
) -> SegmentDetections:
    """Return the detections of Q queries, best score first, as lane segments and crossings.

    LaneSegNet's queries are of two classes, `SEGMENT_CLASSES`. The left and right lines of a crossing are its two long
    sides; the area is the left line followed by the reversed right line, 2 P points.

    Args:
        center, left, right: metres, ego frame, in driving direction.
        classes: index into `SEGMENT_CLASSES`.
        scores: confidence, 0 to 1.
        successor: [i, j] confidence that segment j continues segment i, 0 to 1.
        valid: queries to keep; None keeps all.
        elements: traffic elements, `lane` (Q, U) with a row for each query; None where the model predicts none.
        left_type, right_type: `LineType` of the boundaries; None where the model predicts none.
    """
    order = np.argsort(-np.asarray(scores), kind="stable")
    if valid is not None:
        order = order[np.asarray(valid)[order]]
    is_crossing = np.asarray(classes)[order] == SEGMENT_CLASSES.index("ped_crossing")
    rows, crossings = order[~is_crossing], order[is_crossing]
    if elements is not None:
        elements = ElementDetections(
            elements.boxes, elements.attributes, elements.scores, np.asarray(elements.lane)[rows]
        )
    center, left, right, scores = (np.asarray(array) for array in (center, left, right, scores))
    return SegmentDetections(
        lanes=LaneDetections(center[rows], scores[rows], np.asarray(successor)[np.ix_(rows, rows)], elements),
        left=left[rows],
        right=right[rows],
        areas=AreaDetections(
            np.concatenate([left[crossings], right[crossings][:, ::-1]], 1),
            np.full(len(crossings), CROSSING),
            scores[crossings],
        ),
        left_type=None if left_type is None else np.asarray(left_type)[rows],
        right_type=None if right_type is None else np.asarray(right_type)[rows],
    )


def detections_of_segments(
    segments: SegmentPrediction, elements: ElementPrediction | None = None, topology: Topology = "learned"
) -> SegmentDetections:
    """Return the last decoder layer's segments of one example, and its areas, see `segment_detections`.

    Confidences of edges are those of `geometric_topology.edge_confidences`.
    """
    confidence = expit(np.asarray(segments.logits))
    types = segments.left_type_logits, segments.right_type_logits
    left_type, right_type = (None if logits is None else np.asarray(logits).argmax(-1) for logits in types)
    detections = segment_detections(
        np.asarray(segments.points),
        np.asarray(segments.left),
        np.asarray(segments.right),
        confidence.argmax(-1),
        confidence.max(-1),
        edge_confidences(np.asarray(segments.points), segments.successor_logits, topology),
        elements=None if elements is None else detections_of_elements(elements),
        left_type=left_type,
        right_type=right_type,
    )
    return detections if segments.areas is None else replace(detections, areas=detections_of_areas(segments.areas))


def detections_of_areas(areas: AreaPrediction) -> AreaDetections:
    """Return the last decoder layer's areas of one example, best score first, each query with its best class."""
    confidence = expit(np.asarray(areas.logits))
    order = np.argsort(-confidence.max(-1), kind="stable")
    category = confidence.argmax(-1)[order] + int(AreaType.PEDESTRIAN_CROSSING)
    return AreaDetections(np.asarray(areas.points)[order], category, confidence.max(-1)[order])


def _element_truth(
    segments: LaneGraph, elements: TrafficElements, lanes: LaneGraph | None, keep: Int[np.ndarray, " g"]
) -> ElementTruth:
    if elements.segment is None and lanes is None:
        raise ValueError("these traffic elements govern centerlines: pass `lanes`")
    shown = np.flatnonzero(np.asarray(elements.valid))
    governs = governed_segments(elements, segments, segments if lanes is None else lanes)
    return ElementTruth(
        boxes=np.asarray(elements.box)[shown],
        attributes=np.asarray(elements.attribute)[shown],
        lane=governs[np.ix_(keep, shown)],
    )

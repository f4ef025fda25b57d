"""Examples and predictions as inputs of MapTR's metric (host, numpy, one frame)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit

from tflane_jax.geometry import line_distances, line_lengths
from tflane_jax.metrics.map_matching import CLASSES, Dims, MapDetections, MapTruth
from tflane_jax.scene import Areas, AreaType, LaneGraph, LinePrediction, LineType, MapLines

_DIVIDER, _CROSSING, _BOUNDARY = (CLASSES.index(name) for name in ("divider", "ped_crossing", "boundary"))
# Neighbouring segments both contain the line between them: lines closer than this along all points are one, metres.
_SAME_LINE = 0.2
# Published `max_num`, also of the variant with centerlines and its 70 queries.
_MOST_LINES = 50


def truth_of_segment_lines(segments: LaneGraph, areas: Areas) -> MapTruth:
    """Return the map lines of one example: `dividers` of its lane segments, crossings and road boundaries of its areas.

    Points are (x, y), metres, ego frame. Closed lines repeat their first vertex, as in `Areas`.
    """
    lines = dividers(segments)
    valid = np.asarray(areas.valid)
    category = np.asarray(areas.category)[valid]
    classes = np.where(category == AreaType.PEDESTRIAN_CROSSING, _CROSSING, _BOUNDARY)
    return MapTruth(
        points=[*lines, *np.asarray(areas.points)[valid][..., :2]],
        classes=np.concatenate([np.full(len(lines), _DIVIDER), classes]),
    )


def dividers(segments: LaneGraph) -> list[Float[np.ndarray, "p 2"]]:
    """Return the painted side lines of the valid lane segments, each line once.

    A line that lies on a longer one along its whole length, in either direction, is left out. Of equally long ones,
    the first is kept.
    """
    valid = np.asarray(segments.valid)
    sides = (segments.left, segments.left_type), (segments.right, segments.right_type)
    painted = [np.asarray(line)[valid & (np.asarray(kind) != LineType.NONE)] for line, kind in sides]
    lines = np.concatenate(painted)[..., :2].astype(np.float64)
    if len(lines) == 0:
        return []
    lengths = line_lengths(lines)
    covered = line_distances(lines[:, None], lines)[0].max(-1) < _SAME_LINE
    kept: list[int] = []
    for i in np.argsort(-lengths, kind="stable").tolist():
        if not covered[i, kept].any():
            kept.append(i)
    return [lines[i] for i in sorted(kept)]


def map_detections(
    points: Float[np.ndarray, "q p d"],
    classes: Int[np.ndarray, " q"],
    scores: Float[np.ndarray, " q"],
    valid: Bool[np.ndarray, " q"] | None = None,
    *,
    dims: Dims = 2,
) -> MapDetections:
    """Return the detected lines, best score first.

    Args:
        points: metres.
        classes: index into `metrics.map_matching.LINE_CLASSES`.
        scores: confidence, 0 to 1.
        valid: detections to keep; None keeps all.
        dims: coordinates of the points to keep.
    """
    order = np.argsort(-np.asarray(scores), kind="stable")
    if valid is not None:
        order = order[np.asarray(valid)[order]]
    return MapDetections(np.asarray(points)[order][..., :dims], np.asarray(classes)[order], np.asarray(scores)[order])


def truth_of_lines(lines: MapLines, found: LinePrediction) -> MapTruth:
    """Return the labelled lines of the classes that a model predicts, with as many coordinates.

    These are the lines as the source has them where the labels keep their dense form.
    """
    kept, dense = measured_lines(lines, found), lines.dense is not None
    visibility, identity = (
        None if known is None else np.asarray(known)[kept] for known in (lines.visibility, lines.identity)
    )
    return MapTruth(
        np.asarray(lines.dense if dense else lines.points)[kept][..., : found.points.shape[-1]],
        np.asarray(lines.category)[kept],
        visibility,
        identity,
        sampled=dense,
    )


def measured_lines(lines: MapLines, found: LinePrediction) -> Bool[np.ndarray, " l"]:
    """Return which labelled lines are valid and of a class that a model predicts: MapTR predicts no centerlines."""
    return np.asarray(lines.valid) & (np.asarray(lines.category) < found.logits.shape[-1])


def kept_pairs(queries: int) -> int:
    """Return how many of the best pairs of query and class are detections: one for each query, at most 50."""
    return min(queries, _MOST_LINES)


def detections_of_lines(lines: LinePrediction) -> MapDetections:
    """Return the last decoder layer's lines of one example: as in MapTR, the best of its Q x C pairs of query, class.

    These are `kept_pairs(Q)`. A query may therefore be two lines of different classes.
    """
    confidence = expit(np.asarray(lines.logits, np.float64))
    queries, classes = confidence.shape
    best = np.argsort(-confidence, axis=None, kind="stable")[: kept_pairs(queries)]
    points, dims = np.asarray(lines.points)[best // classes], 3 if lines.points.shape[-1] == 3 else 2
    return map_detections(points, best % classes, confidence.ravel()[best], dims=dims)

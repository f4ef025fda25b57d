"""Which true lanes a model finds, lane by lane, and the frames in which two models differ most.

A lane counts as found if a detection whose nearest lane it is lies within `WITHIN` of it, with a confidence of at least
the model's threshold. Distances are those of the metric (`metrics.centerline_matching.nearest_lanes`, or
`metrics.segment_matching.nearest_segments`), so without a threshold the fraction of found lanes is `recall@2.0`.
Lines of a vector map take the place of lanes, within `LINE_WITHIN` by MapTR's Chamfer distance to lines of their class.
Confidences of two models have different scales: the threshold of each is the one with its best F-score.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from tflane_jax.evaluation.vector_maps import detections_of_lines, kept_pairs, measured_lines, truth_of_lines
from tflane_jax.metrics.centerline_matching import nearest_lanes
from tflane_jax.metrics.map_matching import MAP_THRESHOLDS, match_map
from tflane_jax.metrics.segment_matching import nearest_segments
from tflane_jax.scene import CenterlinePrediction, LaneGraph, LinePrediction, MapLines, SegmentPrediction

WITHIN = 2.0  # metres
LINE_WITHIN = MAP_THRESHOLDS[-1]  # metres


def confidences_of(
    truth: LaneGraph | MapLines, found: CenterlinePrediction | SegmentPrediction | LinePrediction
) -> Float[np.ndarray, " n"]:
    """Return for each row of the padded truth the highest confidence of the detections that find it; else -inf.

    Args:
        truth: merged centerlines, segments where the detections are segments, or labelled lines.
        found: all detections of the frame; crossings find no lane.
    """
    if isinstance(found, LinePrediction):
        assert isinstance(truth, MapLines)
        return _line_confidences(truth, found)
    valid, names = np.asarray(truth.valid), ("points", "left", "right")
    true = [np.asarray(getattr(truth, name))[valid] for name in names]
    confidences, scores = np.full(len(valid), -np.inf), detection_scores(found)
    if isinstance(found, SegmentPrediction):
        lines = [np.asarray(getattr(found, name))[scores > 0.0] for name in names]
        confidences[valid] = segment_confidences(true, lines, scores[scores > 0.0])
    else:
        confidences[valid] = lane_confidences(true[0], np.asarray(found.points), scores)
    return confidences


def _line_confidences(truth: MapLines, found: LinePrediction) -> Float[np.ndarray, " n"]:
    kept = measured_lines(truth, found)
    dims = 3 if found.points.shape[-1] == 3 else 2
    matched = match_map(detections_of_lines(found), truth_of_lines(truth, found), dims=dims)
    confidences = np.full(len(kept), -np.inf)
    # Beyond the largest threshold the distance is inf.
    confidences[kept] = highest_confidences(matched.distance, matched.nearest, matched.scores, int(kept.sum()))
    return confidences


def detection_scores(found: CenterlinePrediction | SegmentPrediction | LinePrediction) -> Float[np.ndarray, "*b p"]:
    """Return the confidences of detected lanes, 0 for crossings; of lines those of the best pairs of query, class."""
    if isinstance(found, LinePrediction):
        every = expit(np.asarray(found.logits, np.float64))
        return -np.sort(-every.reshape(*every.shape[:-2], -1))[..., : kept_pairs(every.shape[-2])]
    scores = np.asarray(found.scores)
    if isinstance(found, SegmentPrediction):
        return np.where(np.asarray(found.logits).argmax(-1) == 0, scores, 0.0)
    return scores


def lane_confidences(
    truth: Float[np.ndarray, "g n 3"], points: Float[np.ndarray, "p m 3"], scores: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " g"]:
    """Return for each true lane the highest confidence of the detections that find it; -inf without one.

    Args:
        truth: valid lanes of one frame, metres.
        points, scores: all detections of the frame.
    """
    return highest_confidences(*nearest_lanes(np.asarray(truth), np.asarray(points)), scores, len(truth))


def segment_confidences(
    truth: Sequence[Float[np.ndarray, "g n 3"]],
    detected: Sequence[Float[np.ndarray, "p m 3"]],
    scores: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " g"]:
    """Return for each true segment the highest confidence of the detections that find it; -inf without one.

    Args:
        truth: centerlines, left and right boundaries of the valid segments of one frame, metres.
        detected: the same of all detections.
        scores: confidence of each detection.
    """
    return highest_confidences(*nearest_segments(list(truth), list(detected)), scores, len(truth[0]))


def highest_confidences(
    distance: Float[np.ndarray, " p"], nearest: Int[np.ndarray, " p"], scores: Float[np.ndarray, " p"], lanes: int
) -> Float[np.ndarray, " g"]:
    """Return for each of `lanes` true lanes the highest confidence of a detection that lies within `WITHIN` of it.

    A detection counts for its nearest lane alone; a lane without one has -inf.

    Args:
        distance: of each detection to its nearest lane, metres.
        nearest: index of that lane.
        scores: confidence of each detection.
        lanes: number of true lanes.
    """
    found, near = np.full(lanes, -np.inf), distance < WITHIN
    np.maximum.at(found, nearest[near], np.asarray(scores)[near])
    return found


def best_threshold(lanes: Sequence[Float[np.ndarray, " g"]], detections: Sequence[Float[np.ndarray, " p"]]) -> float:
    """Return the least confidence with the best F-score over all frames; of equally good ones the highest.

    Args:
        lanes: `lane_confidences` of each frame.
        detections: confidences of all detections of each frame.

    Returns:
        One of the lanes' confidences; inf if no lane is ever found.
    """
    true, every = (np.sort(np.concatenate([np.zeros(0), *frames])) for frames in (lanes, detections))
    levels = np.unique(true[np.isfinite(true)])[::-1]
    if len(levels) == 0:
        return np.inf
    found, kept = (len(values) - np.searchsorted(values, levels) for values in (true, every))
    return float(levels[(2.0 * found / (len(true) + kept)).argmax()])


def frames_of_difference(
    only_first: Int[np.ndarray, " f"], only_second: Int[np.ndarray, " f"], scene: Int[np.ndarray, " f"], count: int
) -> tuple[list[int], list[int]]:
    """Return the frames in which the first model is ahead the most, and those in which the second is.

    A model's lead is the number of lanes that only it finds, less those that only the other finds. The models share
    the `count` frames in the ratio of all lanes that only they find; a model that leads in any frame gets at least one.
    Of a scene, each list has only the frame of the largest lead.

    Args:
        only_first, only_second: numbers of lanes of each frame.
        scene: number of each frame's scene.
        count: of frames, at least 2; there may be fewer.
    """
    lead = np.asarray(only_second) - np.asarray(only_first)
    first, second = _leaders(-lead, scene), _leaders(lead, scene)
    alone = int(np.sum(only_first)), int(np.sum(only_second))
    # A model that leads anywhere gets a frame, and frames that one cannot fill go to the other.
    least, most = max(1, count - len(first)), min(len(second), count - min(len(first), 1))
    of_second = min(max(round(count * alone[1] / max(sum(alone), 1)), least), most)
    return first[: count - of_second], second[:of_second]


def _leaders(lead: Int[np.ndarray, " f"], scene: Int[np.ndarray, " f"]) -> list[int]:
    """Return the frames with a lead, largest first, one of each scene."""
    order = np.argsort(-lead, kind="stable")
    order = order[lead[order] > 0]
    return order[np.sort(np.unique(scene[order], return_index=True)[1])].tolist()

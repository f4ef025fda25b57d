"""Error types of true lanes and detections, by the fraction of their length that has a counterpart.

Recall and DET_l compare whole lanes, so a lane that is seen well, but cut elsewhere than the map cuts it, counts as a
miss and as a false detection. Here every true lane and every detection gets one of `OUTCOMES`:

| | true lane | detection |
|---|---|---|
| `found` | a detection finds it (`evaluation.found_lanes`) | it is the most confident one that finds its lane |
| `duplicate` | | it finds a lane that a more confident one finds |
| `wrong extent` | not found, `WHOLE` of it or more beside detections | finds none, `WHOLE` or more beside true lanes |
| `in part` | at least `HALF` of it | the same |
| `missed` | less | the same: a false detection |

Of a line, `SAMPLES` points count, equally spaced. A point is beside lines if one of them passes within `WITHIN` in the
plane, with a direction within `HEADING` of its own. Only detections count that have at least the confidence with the
best F-score over all frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.evaluation.found_lanes import WITHIN, best_threshold, detection_scores, highest_confidences
from tflane_jax.evaluation.lane_groups import HALF, HEADING, SAMPLES
from tflane_jax.evaluation.predict import Predictor, predicted_batches
from tflane_jax.geometry import resample_lines
from tflane_jax.metrics.centerline_matching import nearest_lanes
from tflane_jax.metrics.segment_matching import nearest_segments
from tflane_jax.models.parameters import Params
from tflane_jax.scene import CenterlinePrediction, LaneGraph, Prediction, SegmentPrediction

OUTCOMES: tuple[str, ...] = ("found", "duplicate", "wrong extent", "in part", "missed")
WHOLE = 0.9


class Frame(NamedTuple):
    """True lanes and detections of one frame.

    Attributes:
        truth: (G, n, 3) centerlines in driving direction, metres, ego frame.
        points: (P, m, 3) those of all detections.
        scores: (P,) confidences.
        distance, nearest: (P,) the metric's distance to the nearest true lane, metres, and which one that is.
    """

    truth: Float[np.ndarray, "g n 3"]
    points: Float[np.ndarray, "p m 3"]
    scores: Float[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    nearest: Int[np.ndarray, " p"]


@dataclass(frozen=True)
class LaneErrors:
    """How many true lanes and detections have which outcome.

    Attributes:
        threshold: least confidence of the detections that count; inf if no detection finds a lane.
        lanes, detections: numbers by `OUTCOMES`; no lane is found `duplicate`.
    """

    threshold: float
    lanes: Mapping[str, int]
    detections: Mapping[str, int]


def lane_errors(task: Predictor, params: Params, arrays: Any, batch_size: int = 16) -> LaneErrors:
    """Return the outcomes of all true lanes of a data set, and of the detections of a model.

    Centerlines are compared, or lane segments with their sides where the model predicts these.

    Args:
        task, params: the model.
        arrays: examples with ground truth, see `datasets.batches`.
        batch_size: examples predicted at a time; does not affect the result.

    Raises:
        UserError: the model predicts neither.
    """
    frames = []
    for indices, batch, answer in predicted_batches(task, params, arrays, batch_size):
        found, truth = _compared(answer, batch)
        for row in range(len(indices)):
            frames.append(frame_of(*jax.tree.map(lambda leaf, i=row: np.asarray(leaf[i]), (truth, found))))
    return count_errors(frames)


def _compared(answer: Prediction, batch: Any) -> tuple[CenterlinePrediction | SegmentPrediction, LaneGraph]:
    if answer.segments is not None:
        return answer.segments, batch.segments
    if answer.centerlines is None:
        raise UserError("errors of lanes need predicted centerlines or lane segments, which this model does not have")
    return answer.centerlines, batch.lanes


def frame_of(truth: LaneGraph, found: CenterlinePrediction | SegmentPrediction) -> Frame:
    """Return one frame; padding of the truth may hold anything, crossings among segments are left out."""
    valid, scores = np.asarray(truth.valid), detection_scores(found)
    center, left, right = (np.asarray(line)[valid] for line in (truth.points, truth.left, truth.right))
    if not isinstance(found, SegmentPrediction):
        points = np.asarray(found.points)
        return Frame(center, points, scores, *nearest_lanes(center, points))
    kept = scores > 0.0
    points, *sides = (np.asarray(line)[kept] for line in (found.points, found.left, found.right))
    return Frame(center, points, scores[kept], *nearest_segments([center, left, right], [points, *sides]))


def count_errors(frames: Sequence[Frame]) -> LaneErrors:
    """Return how many lanes and detections have which outcome."""
    confidences = [highest_confidences(one.distance, one.nearest, one.scores, len(one.truth)) for one in frames]
    threshold = best_threshold(confidences, [one.scores for one in frames])
    lanes, detections = dict.fromkeys(OUTCOMES, 0), dict.fromkeys(OUTCOMES, 0)
    for one, confidence in zip(frames, confidences, strict=True):
        kept = one.scores >= threshold
        points, distance, nearest, scores = (x[kept] for x in (one.points, one.distance, one.nearest, one.scores))
        finds = distance < WITHIN
        _count(lanes, covered_fraction(one.truth, points), found=confidence >= threshold)
        first = _first_of_lane(nearest, scores, finds)
        _count(detections, covered_fraction(points, one.truth), found=first, duplicate=finds & ~first)
    return LaneErrors(threshold, lanes, detections)


def _first_of_lane(
    nearest: Int[np.ndarray, " p"], scores: Float[np.ndarray, " p"], finds: Bool[np.ndarray, " p"]
) -> Bool[np.ndarray, " p"]:
    """Return which detections are the most confident of those that find their lane; of equal ones, the first."""
    order = np.argsort(-scores, kind="stable")
    order = order[finds[order]]
    first = np.zeros(len(nearest), bool)
    first[order[np.unique(nearest[order], return_index=True)[1]]] = True
    return first


def _count(numbers: dict[str, int], covered: Float[np.ndarray, " n"], **settled: Bool[np.ndarray, " n"]) -> None:
    """Add the outcomes of some lines: those that are settled, and for the others what their covered fraction says."""
    rest = np.ones(len(covered), bool)
    for outcome, members in settled.items():
        numbers[outcome] += int(members.sum())
        rest &= ~members
    numbers["wrong extent"] += int((rest & (covered >= WHOLE)).sum())
    numbers["in part"] += int((rest & (covered >= HALF) & (covered < WHOLE)).sum())
    numbers["missed"] += int((rest & (covered < HALF)).sum())


def covered_fraction(lines: Float[np.ndarray, "g n 3"], others: Float[np.ndarray, "p m 3"]) -> Float[np.ndarray, " g"]:
    """Return the fraction of each line's length beside which one of the other lines runs in the same direction."""
    if len(lines) == 0 or len(others) == 0:
        return np.zeros(len(lines))
    points = resample_lines(list(lines), SAMPLES)[..., :2]
    steps = np.gradient(points, axis=1)
    start = np.asarray(others, np.float64)[:, :-1, :2].reshape(-1, 2)
    step = np.diff(np.asarray(others, np.float64)[..., :2], axis=1).reshape(-1, 2)
    length = np.linalg.norm(step, axis=-1)
    away = points[:, :, None] - start
    along = np.clip((away * step).sum(-1) / np.where(length > 0.0, length, 1.0) ** 2, 0.0, 1.0)
    near = np.linalg.norm(away - along[..., None] * step, axis=-1) <= WITHIN
    size = np.linalg.norm(steps, axis=-1)[..., None] * length
    same = np.einsum("gsd,md->gsm", steps, step) >= np.cos(HEADING) * size
    # A piece without a length has no direction, on either side.
    return (near & same & (size > 0.0)).any(-1).mean(-1)

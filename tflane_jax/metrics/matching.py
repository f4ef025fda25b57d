"""Greedy nearest matching and the official average precisions (docs/reference/metrics.md, sections 1 and 4).

Sorting by confidence is stable: of equal confidences the earlier element goes first. The official program sorts
unstably, so its value is undefined where confidences tie; ours is one of its possible values.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def descending(values: Float[np.ndarray, "*b n"]) -> Int[np.ndarray, "*b n"]:
    """Return the stable order of the last axis from the highest to the lowest value."""
    values = np.asarray(values)
    if values.dtype.kind in "ub":  # the negative of an unsigned number is none
        values = values.astype(np.float64)
    return np.argsort(-values, axis=-1, kind="stable")


def nearest_truth(distance: Float[np.ndarray, "g p"]) -> tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return for each prediction the distance to its nearest truth and the index of that truth, the first of equals.

    Without truth the distances are inf.
    """
    if len(distance) == 0:
        return np.full(distance.shape[1], np.inf), np.zeros(distance.shape[1], np.int64)
    return distance.min(0), distance.argmin(0)


def greedy_match(
    near: Bool[np.ndarray, " p"], nearest: Int[np.ndarray, " p"], scores: Float[np.ndarray, " p"]
) -> Int[np.ndarray, " p"]:
    """Return for each prediction the truth that it takes, -1 for a false positive.

    Every prediction considers only its `nearest` truth. In order of descending confidence it takes that truth if it is
    `near` and free; there is no second choice.
    """
    order = descending(scores)
    order = order[near[order]]
    # Of several predictions the last one assigned keeps the truth, so the best comes last.
    winner = np.full(nearest.max(initial=-1) + 1, -1)
    winner[nearest[order[::-1]]] = order[::-1]
    winner = winner[winner >= 0]
    taken = np.full(len(nearest), -1)
    taken[winner] = nearest[winner]
    return taken


def pooled(detections: list[tuple[np.ndarray, ...]], *empty: tuple[int, ...]) -> list[np.ndarray]:
    """Concatenate scores and the other fields over frames; `empty` are the shapes of the others without frames."""
    if not detections:
        return [np.zeros(shape) for shape in ((0,), *empty)]
    return [np.concatenate(field, -1) for field in zip(*detections, strict=True)]


def ranked(scores: Float[np.ndarray, " p"], *fields: np.ndarray) -> list[np.ndarray]:
    """Return detections from the highest to the lowest score; another stable sort of them costs little.

    Args:
        scores: of the detections.
        fields: their other fields, detections along the last axis.
    """
    order = descending(scores)
    return [field[..., order] for field in (scores, *fields)]


def average_precision_11(scores: Float[np.ndarray, " p"], hits: Bool[np.ndarray, " p"], truths: int) -> float:
    """Return the mean over the recalls 0, 0.1, ..., 1 of the best precision at that recall or above.

    `hits` marks the true positives, pooled over all frames; `truths` is the number of true elements. Without truth and
    predictions the result is 1, with only one of the two 0.
    """
    if truths == 0 or len(scores) == 0:
        return float(truths == 0 and len(scores) == 0)
    found = np.cumsum(hits[descending(scores)])
    precision = found / np.arange(1, len(found) + 1)
    best_from = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    # Recall >= k/10 as 10 found >= k truths in integers: 0.7 and 0.9 have no exact float, and official values depend
    # on the test being exact.
    return float(best_from[np.searchsorted(10 * found, np.arange(11) * truths)].mean())


def average_precision_area(scores: Float[np.ndarray, " p"], hits: Bool[np.ndarray, " p"], truths: int) -> float:
    """Return the area under the precision-recall curve, precision taken as the best at that recall or above.

    Without ground truth or without predictions it is 0. Arguments as in `average_precision_11`.
    """
    if truths == 0 or len(scores) == 0:
        return 0.0
    hits = hits[descending(scores)]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    best_from = np.maximum.accumulate(precision[::-1])[::-1]
    return float(best_from[hits].sum() / truths)


def vertex_average_precision(
    edges: Bool[np.ndarray, "*b v n"], confidence: Float[np.ndarray, "*b v n"]
) -> Float[np.ndarray, "*b v"]:
    """Return for each vertex v the average precision of its n possible neighbours.

    Entries with confidence above 0.5 (strictly) are predicted neighbours; true neighbours that are not
    predicted contribute 0. No true and no predicted neighbour is 1.
    """
    edges = np.broadcast_to(edges, confidence.shape)
    predicted = confidence > 0.5
    # Hits are few: counting the entries before each one is faster than sorting.
    *vertex, neighbour = np.nonzero(edges & predicted)
    row, hit = confidence[*vertex], confidence[*vertex, neighbour][:, None]
    before = (row > hit) | ((row == hit) & (np.arange(row.shape[-1]) <= neighbour[:, None]))
    total = np.zeros(edges.shape[:-1])
    np.add.at(total, tuple(vertex), (before & edges[*vertex]).sum(-1) / before.sum(-1))
    truths = edges.sum(-1)
    return np.where((truths == 0) & ~predicted.any(-1), 1.0, total / np.maximum(truths, 1))

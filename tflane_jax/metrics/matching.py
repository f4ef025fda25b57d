"""Greedy nearest matching and the average precisions of OpenLane-V2 (shared specs/metrics.md section 1).

Everywhere "in descending confidence" is a stable order: of equal confidences the earlier element goes first. The
official program sorts unstably, so its value is undefined where confidences tie; ours is one of the possible ones.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def descending(values: Float[np.ndarray, "*b n"]) -> Int[np.ndarray, "*b n"]:
    """Return the stable order of the last axis from the highest to the lowest value."""
    return np.argsort(-values, axis=-1, kind="stable")


def greedy_match(
    distance: Float[np.ndarray, " p"],
    nearest: Int[np.ndarray, " p"],
    scores: Float[np.ndarray, " p"],
    threshold: float,
) -> Int[np.ndarray, " p"]:
    """Return for each prediction the truth that it takes, -1 for a false positive.

    Every prediction looks only at its nearest truth, decided before matching (`nearest`, at `distance`). In descending
    confidence it takes that truth if it is nearer than `threshold` (strictly) and free; there is no second choice.
    """
    order = descending(scores)
    near = order[distance[order] < threshold]
    _, first = np.unique(nearest[near], return_index=True)
    taken = np.full(len(nearest), -1)
    taken[near[first]] = nearest[near[first]]
    return taken


def average_precision_11(scores: Float[np.ndarray, " p"], hits: Bool[np.ndarray, " p"], truths: int) -> float:
    """Return the mean over the recalls 0, 0.1, ..., 1 of the best precision at that recall or above.

    `hits` tells true from false positives, pooled over all frames; `truths` counts the ground truth. Nothing to find
    and nothing predicted is 1; only one of the two empty is 0.
    """
    if truths == 0 or len(scores) == 0:
        return float(truths == 0 and len(scores) == 0)
    found = np.cumsum(hits[descending(scores)])
    precision = found / np.arange(1, len(found) + 1)
    best_from = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    # Recall >= k/10 as 10 found >= k truths in integers: 0.7 and 0.9 have no exact float, and official values depend
    # on the test being exact.
    return float(best_from[np.searchsorted(10 * found, np.arange(11) * truths)].mean())


def vertex_average_precision(
    edges: Bool[np.ndarray, "*b v n"], confidence: Float[np.ndarray, "*b v n"], threshold: float = 0.5
) -> Float[np.ndarray, "*b v"]:
    """Return for each vertex v the average precision of its n possible neighbours.

    Entries with confidence above `threshold` (strictly) are predicted neighbours; true neighbours that are not
    predicted contribute 0. No true and no predicted neighbour is 1.
    """
    order = descending(confidence)
    predicted = np.take_along_axis(confidence, order, -1) > threshold
    hits = np.take_along_axis(np.broadcast_to(edges, confidence.shape), order, -1) & predicted
    precision = np.cumsum(hits, -1) / np.arange(1, hits.shape[-1] + 1)
    truths = edges.sum(-1)
    average = (hits * precision).sum(-1) / np.maximum(truths, 1)
    return np.where((truths == 0) & ~predicted.any(-1), 1.0, average)

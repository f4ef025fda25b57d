"""Average precisions of many bootstrap samples at once.

A sample counts each frame some number of times, its weight. Frames are matched one by one, so a sample changes no
match: only the sums over ranked detections differ. The precisions of a sample are exactly those of a data set in which
frames are repeated as often as its weights say, up to the order of equal scores, which the official programs leave
open. In means over classes, those that the sample lacks do not count (`kept_in_sample`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from tflane_jax.errors import UserError
from tflane_jax.metrics.matching import descending

# Numbers of an array of samples that are in memory at a time.
_BLOCK = 2**22

Weights = Int[np.ndarray, "b f"]
"""How often each sample counts each frame."""


def frame_numbers(detections: Sequence[tuple[np.ndarray, ...]]) -> Int[np.ndarray, " p"]:
    """Return each detection's frame, pooled as by `metrics.matching.pooled`; a frame's first field is its scores."""
    return np.repeat(np.arange(len(detections)), [len(scores) for scores, *_ in detections])


def checked_weights(weights: Any, frames: int) -> Weights:
    """Return the weights of samples; raise UserError unless they are counts, one of each frame in each sample."""
    weights = np.asarray(weights)
    if weights.ndim != 2 or weights.shape[1] != frames:
        raise UserError(
            f"weights of samples have shape {weights.shape}, expected (samples, {frames}): one for each frame"
        )
    if not np.issubdtype(weights.dtype, np.integer) or (weights < 0).any():
        raise UserError("weights of samples are how often each counts a frame: give integers of 0 and more")
    return weights


def kept_in_sample(sample: Int[np.ndarray, "*b"], whole: Int[np.ndarray, "*#b"]) -> Bool[np.ndarray, "*b"]:
    """Return which classes count in the mean of a sample, given numbers of true elements.

    Those that the whole test set has and the sample lacks do not: officially, their AP is 0 where there are detections
    of them, which would be the luck of the draw.
    """
    return (sample > 0) | (whole == 0)


def bootstrap_mean(parts: Float[np.ndarray, "f 2"], weights: Weights) -> Float[np.ndarray, " b"]:
    """Return the ratio of two sums over frames in each sample; 0 where there is nothing to count."""
    weights = checked_weights(weights, len(parts))
    total, count = weights @ parts[:, 0], weights @ parts[:, 1]
    return total / np.where(count, count, 1.0)


def bootstrap_precisions(
    scores: Float[np.ndarray, " p"],
    hits: Shaped[np.ndarray, "k p"],
    frame: Int[np.ndarray, " p"],
    truths: Int[np.ndarray, " f"],
    weights: Weights,
) -> tuple[Float[np.ndarray, "b k"], Float[np.ndarray, "b k"]]:
    """Return `metrics.matching.average_precision_11` and `average_precision_area` of every sample, for K rows of hits.

    Args:
        scores: of the detections of all frames.
        hits: true positives, at each of K thresholds.
        frame: of each detection.
        truths: number of true elements of each frame.
        weights: of the frames in each sample.
    """
    weights, order = checked_weights(weights, len(truths)), descending(scores)
    hits, frame = hits[:, order].astype(bool), frame[order]
    true = weights @ truths
    nothing = (true == 0) & (weights @ np.bincount(frame, minlength=len(truths)) == 0)
    eleven = np.repeat(nothing[:, None].astype(float), len(hits), 1)
    area = np.zeros(eleven.shape)
    # Precision falls from one hit to the next, so that it matters at hits alone, and they are few.
    at = np.flatnonzero(hits.any(0))
    rows = [np.flatnonzero(row) for row in hits[:, at]]
    size = max(_BLOCK // max(len(at), 1), 1)
    for start in range(0, len(weights) if len(at) else 0, size):
        block = weights[start : start + size]
        counts, times = _counted(frame, at, block), block[:, frame[at]].astype(float)
        # Small arrays, which stay in the processor's cache, are faster than all samples at once.
        for b, (count, weight) in enumerate(zip(counts, times, strict=True), start):
            levels = -(-np.arange(11) * true[b] // 10)  # of truths, rounded up: recall is compared in integers
            for k, row in enumerate(rows if true[b] else ()):
                own = weight[row]
                found = np.cumsum(own)
                best_from = np.zeros(len(row) + 1)
                np.maximum.accumulate((found / count[row])[::-1], out=best_from[-2::-1])
                area[b, k] = own @ best_from[:-1] / true[b]
                eleven[b, k] = best_from[np.searchsorted(found, levels)].mean()
    return eleven, area


def _counted(frame: Int[np.ndarray, " p"], at: Int[np.ndarray, " h"], weights: Weights) -> Float[np.ndarray, "b h"]:
    """Return how many detections each sample has down to the ranks `at`, at least 1."""
    from scipy.sparse import csr_array

    last = at[-1] + 1
    next_hit = np.searchsorted(at, np.arange(last))
    between = csr_array((np.ones(last), (next_hit, frame[:last])), shape=(len(at), weights.shape[1]))
    counts = np.ascontiguousarray((between @ np.ascontiguousarray(weights.T, float)).T)
    return np.maximum(np.cumsum(counts, axis=1, out=counts), 1.0, out=counts)

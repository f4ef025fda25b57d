"""Discrete Fréchet distances of many pairs of polylines at once (numpy).

The recursion of Eiter & Mannila, Computing Discrete Frechet Distance (1994), advances along anti-diagonals here, which
takes a tenth of the steps, and a lower bound excludes most pairs of a frame.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

# Squared distances of vertices that are in memory at a time, several times over.
_BLOCK = 2**21


def end_distance(a: Float[np.ndarray, "a n d"], b: Float[np.ndarray, "b m d"]) -> Float[np.ndarray, "a b"]:
    """Return for all pairs the larger of the distances of first and of last vertices.

    It bounds the Fréchet distance from below.
    """
    # Differences, not |a|^2 + |b|^2 - 2ab: that form loses the distances that lie exactly on a threshold.
    squared = [
        sum(((a[:, None, end, axis] - b[:, end, axis]) ** 2 for axis in range(a.shape[-1])), start=np.zeros(()))
        for end in (0, -1)
    ]
    return np.sqrt(np.maximum(*squared))


def pair_frechet(
    a: Float[np.ndarray, "a n d"],
    b: Float[np.ndarray, "b m d"],
    i: Int[np.ndarray, " k"],
    j: Int[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Return the discrete Fréchet distance of line i of a and line j of b, metres.

    Directional; lines padded by repeating their last vertex keep their distances.
    """
    size = max(_BLOCK // (a.shape[1] * b.shape[1]), 1)
    if len(i) <= size:
        return _distances(a[i], b[j])
    starts = range(0, len(i), size)
    return np.concatenate([_distances(a[i[s : s + size]], b[j[s : s + size]]) for s in starts])


def _distances(a: Float[np.ndarray, "k n d"], b: Float[np.ndarray, "k m d"]) -> Float[np.ndarray, " k"]:
    """Return the distances of lines that are pairs."""
    pairs, n, m = len(a), a.shape[1], b.shape[1]
    cells = np.zeros((n, m, pairs))
    # Vertices come first, so that every step works on contiguous arrays over all pairs.
    coordinates = (np.ascontiguousarray(lines.transpose(2, 1, 0)) for lines in (a, b))
    for first, second in zip(*coordinates, strict=True):
        cells += (first[:, None] - second) ** 2
    cells = cells.reshape(n * m, pairs)
    if n == 1 or m == 1:
        return np.sqrt(cells.max(0))
    # The least cost to reach the cells (row, diagonal - row) of the last two diagonals, by row; inf where none was yet.
    before, last = (np.full((n + 1, pairs), np.inf) for _ in range(2))
    last[1] = cells[0]
    for diagonal in range(1, n + m - 1):
        low, high = max(0, diagonal - m + 1), min(diagonal, n - 1)
        start = low * m + diagonal - low
        here = cells[start : high * m + diagonal - high + 1 : m - 1]
        # Index r + 1 holds row r. A cell is reached from the left (same row), from above and diagonally (previous row).
        best = np.minimum(last[low + 1 : high + 2], last[low : high + 1])
        np.minimum(best, before[low : high + 1], out=best)
        np.maximum(best, here, out=before[low + 1 : high + 2])
        before, last = last, before
    return np.sqrt(last[n])

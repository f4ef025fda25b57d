"""Chamfer distances of many pairs of polylines, measured only where they can be small (numpy).

`tflane_jax.geometry.distances.chamfer` is the definition; here are ragged lines, and a lower bound that is a hundred
times cheaper than the distance and settles nearly all pairs of a frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.metrics.frames import Lines, checked_lines

# Rounding of bound and distance, far below any difference that could matter.
_SLACK = 1e-9
_PIECES = 10
# Squared distances measured at a time: they stay in the processor's cache.
_BLOCK = 2**16


@dataclass(frozen=True)
class PaddedLines:
    """Polylines of one frame in one array.

    Attributes:
        points: (L, n, d) metres; a line with fewer than n vertices repeats its last one (which changes no nearest
            vertex).
        counts: (L,) how many vertices count in means over a line.
    """

    points: Float[np.ndarray, "l n d"]
    counts: Int[np.ndarray, " l"]

    @classmethod
    def of(cls, lines: Lines, what: str, dims: int = 3) -> PaddedLines:
        """Return the given lines; raise UserError, which names them by `what`, for those that cannot be measured."""
        return cls(checked_lines(lines, what, dims), np.array([len(line) for line in lines], int))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, lines: Int[np.ndarray, " k"] | Bool[np.ndarray, " l"]) -> PaddedLines:
        """Return some of the lines."""
        return PaddedLines(self.points[lines], self.counts[lines])

    def open_ends(self) -> PaddedLines:
        """Return the lines without the last vertex where it equals the first: it counts once in means."""
        closed = (self.points[:, 0] == self.points[:, -1]).all(-1) & (self.counts > 1)
        return PaddedLines(self.points, self.counts - closed)

    def resampled(self, count: int) -> PaddedLines:
        """Return `count` points on each line, equally spaced in ground-plane arc length, both ends included.

        As `geometry.polylines.resample` does, and unlike `resample_lines` to the last bit: rounding does not depend on
        the other lines, so that twins remain equally near.
        """
        if len(self) == 0:
            return PaddedLines(np.zeros((0, count, self.points.shape[-1])), self.counts)
        step = np.diff(self.points[..., :2], axis=1)
        along = np.cumsum(np.hypot(step[..., 0], step[..., 1]), axis=1)
        along = np.concatenate([np.zeros((len(along), 1)), along], 1)
        distance = along[:, -1:] * np.linspace(0.0, 1.0, count)
        # The last segment that starts at or before the distance, never one of length zero.
        final = np.maximum((along < along[:, -1:]).sum(1) - 1, 0)
        start = np.minimum((along[:, None] <= distance[..., None]).sum(-1) - 1, final[:, None])
        line = np.arange(len(along))[:, None]
        stop = np.minimum(start + 1, along.shape[1] - 1)
        length = along[line, stop] - along[line, start]
        weight = ((distance - along[line, start]) / np.where(length > 0.0, length, 1.0))[..., None]
        a, b = self.points[line, start], self.points[line, stop]
        return PaddedLines(np.where(weight == 1.0, b, a + weight * (b - a)), np.full(len(self), count))

    def counted(self) -> Bool[np.ndarray, "l n"]:
        """Return which vertices count."""
        return np.arange(self.points.shape[1]) < self.counts[:, None]


def near_pairs(
    a: PaddedLines,
    b: PaddedLines,
    within: float | Float[np.ndarray, " a"],
    among: Bool[np.ndarray, "a b"] | None = None,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return all pairs (lines of a, lines of b) whose Chamfer distance can be at most `within` metres, and few others.

    Args:
        within: one for all, or one for each line of a.
        among: leave out the pairs that are false here.
    """
    within = np.broadcast_to(np.asarray(within) + _SLACK, len(a))
    boxes_a, boxes_b = _piece_boxes(a), _piece_boxes(b)
    # The box of the whole line first, it costs next to nothing.
    gap = _box_gap(boxes_a.whole[:, None], boxes_b.whole[None])
    possible = gap <= within[:, None]
    i, j = np.nonzero(possible if among is None else possible & among)
    gap = _box_gap(boxes_a.pieces[i][:, :, None], boxes_b.pieces[j][:, None])
    forth = (boxes_a.weights[i] * gap.min(2)).sum(-1)
    back = (boxes_b.weights[j] * gap.min(1)).sum(-1)
    keep = 0.5 * (forth + back) <= within[i]
    return i[keep], j[keep]


def pair_chamfer(
    a: PaddedLines, b: PaddedLines, i: Int[np.ndarray, " k"], j: Int[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the Chamfer distance of line i of a and line j of b, metres.

    Half the sum of the mean distances from each vertex to the nearest vertex of the other line; not squared, blind to
    direction (shared specs/metrics.md section 1).
    """
    distance = np.empty(len(i))
    counted_a, counted_b = a.counted(), b.counted()
    for block in _blocks(len(i), a.points.shape[1] * b.points.shape[1]):
        left, right = i[block], j[block]
        squared = _squared(a.points[left], b.points[right])
        forth = (np.sqrt(squared.min(2)) * counted_a[left]).sum(-1) / a.counts[left]
        back = (np.sqrt(squared.min(1)) * counted_b[right]).sum(-1) / b.counts[right]
        distance[block] = 0.5 * (forth + back)
    return distance


@dataclass(frozen=True)
class _Boxes:
    """Bounding boxes (low and high corner) of whole lines and of their pieces, and the pieces' share of the vertices.

    Cut into pieces, a vertex lies no nearer to the other line than their boxes do: the Chamfer distance of the boxes,
    weighted by vertices, bounds that of the lines from below.
    """

    whole: Float[np.ndarray, "l 2 d"]
    pieces: Float[np.ndarray, "l s 2 d"]
    weights: Float[np.ndarray, "l s"]


def _piece_boxes(lines: PaddedLines) -> _Boxes:
    n = lines.points.shape[1]
    starts = np.unique(np.linspace(0, n, min(n, _PIECES), endpoint=False).astype(int))
    low = np.minimum.reduceat(lines.points, starts, axis=1)
    high = np.maximum.reduceat(lines.points, starts, axis=1)
    pieces = np.stack([low, high], 2)
    whole = np.stack([low.min(1), high.max(1)], 1)
    share = np.add.reduceat(lines.counted(), starts, axis=1, dtype=np.float64) / lines.counts[:, None]
    return _Boxes(whole, pieces, share)


def _box_gap(a: Float[np.ndarray, "*b 2 d"], b: Float[np.ndarray, "*b 2 d"]) -> Float[np.ndarray, "*b"]:
    """Return the least distance between points of two boxes."""
    gaps = np.maximum(a[..., 0, :] - b[..., 1, :], b[..., 0, :] - a[..., 1, :])
    return np.sqrt((np.maximum(gaps, 0.0) ** 2).sum(-1))


def _squared(a: Float[np.ndarray, "k n d"], b: Float[np.ndarray, "k m d"]) -> Float[np.ndarray, "k n m"]:
    # In place and coordinate by coordinate: the passes over memory are what this costs.
    total = a[:, :, None, 0] - b[:, None, :, 0]
    total *= total
    for axis in range(1, a.shape[-1]):
        step = a[:, :, None, axis] - b[:, None, :, axis]
        step *= step
        total += step
    return total


def _blocks(pairs: int, entries: int) -> Iterator[slice]:
    size = max(1, _BLOCK // entries)
    return (slice(start, start + size) for start in range(0, pairs, size))

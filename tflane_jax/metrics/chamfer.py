"""Chamfer distances of many pairs of polylines, measured only where they can be small (numpy).

The distance is half the sum of the mean distances from each vertex to the nearest vertex of the other line: not
squared, blind to direction. Lines are ragged; a lower bound that is a hundred times cheaper excludes nearly all pairs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry.polylines import line_sizes
from tflane_jax.metrics.frames import Lines, checked_lines

# Allows for the rounding of bound and distance, metres.
_SLACK = 1e-9
# The bound cuts a line into at most _PIECES pieces of at least _PIECE vertices.
_PIECES, _PIECE = 10, 4
# Squared distances computed at a time, so that they fit into the processor's cache.
_BLOCK = 2**15


@dataclass(frozen=True)
class PaddedLines:
    """Polylines of one frame in one array.

    Attributes:
        points: (L, n, d) metres; a line with fewer than n vertices repeats its last one, which changes no nearest
            vertex.
        counts: (L,) number of vertices of each line, for means.
    """

    points: Float[np.ndarray, "l n d"]
    counts: Int[np.ndarray, " l"]

    @classmethod
    def of(cls, lines: Lines, what: str, dims: int = 3) -> PaddedLines:
        """Return the lines, padded; raise UserError, beginning with `what`, for lines without points or not finite."""
        return cls(checked_lines(lines, what, dims), line_sizes(lines))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, lines: Int[np.ndarray, " k"] | Bool[np.ndarray, " l"]) -> PaddedLines:
        """Return some of the lines."""
        return PaddedLines(self.points[lines], self.counts[lines])

    def open_ends(self) -> PaddedLines:
        """Return the lines without the last vertex of closed ones, so that it counts once in means."""
        closed = (self.points[:, 0] == self.points[:, -1]).all(-1) & (self.counts > 1)
        return PaddedLines(self.points, self.counts - closed)

    def resampled(self, count: int) -> PaddedLines:
        """Return `count` points on each line, equally spaced in ground-plane arc length, both ends included.

        The points of `geometry.polylines.resample` but for rounding (below 1e-12 m). A line's points do not depend on
        the other lines, not even in the last bit. Those of `resample_lines` do, so that two equal lines could have
        different distances.
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
        """Return which vertices are no padding."""
        return np.arange(self.points.shape[1]) < self.counts[:, None]


def near_pairs(
    a: PaddedLines,
    b: PaddedLines,
    within: float | Float[np.ndarray, " a"],
    among: Bool[np.ndarray, "a b"] | None = None,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return all pairs (lines of a, lines of b) with a Chamfer distance of at most `within` metres, and few others.

    Args:
        within: one number, or one for each line of a.
        among: pairs to consider; None considers all.
    """
    within = np.broadcast_to(np.asarray(within) + _SLACK, len(a))
    boxes_a, boxes_b = _Boxes.of(a), _Boxes.of(b)
    # First the cheap bound by the box of the whole line.
    low_a, high_a = boxes_a.low.min(1)[..., None], boxes_a.high.max(1)[..., None]
    low_b, high_b = boxes_b.low.min(1)[:, None], boxes_b.high.max(1)[:, None]
    possible = _gap(low_a, high_a, low_b, high_b) <= within[:, None]
    i, j = np.nonzero(possible if among is None else possible & among)
    pieces_a = boxes_a.low[:, :, None, i], boxes_a.high[:, :, None, i]
    pieces_b = boxes_b.low[:, None, :, j], boxes_b.high[:, None, :, j]
    gap = _gap(*pieces_a, *pieces_b)
    forth = (boxes_a.weights[:, i] * gap.min(1)).sum(0)
    back = (boxes_b.weights[:, j] * gap.min(0)).sum(0)
    keep = 0.5 * (forth + back) <= within[i]
    return i[keep], j[keep]


def pair_chamfer(
    a: PaddedLines, b: PaddedLines, i: Int[np.ndarray, " k"], j: Int[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the Chamfer distance of line i of a and line j of b, metres.

    Half the sum of the mean distances from each vertex to the nearest vertex of the other line; not squared, the same
    for a reversed line (docs/reference/metrics.md, section 1).
    """
    distance = np.empty(len(i))
    counted_a, counted_b = a.counted(), b.counted()
    for block in _blocks(len(i), a.points.shape[1] * b.points.shape[1]):
        left, right = i[block], j[block]
        squared = _squared(_coordinates(a, left), _coordinates(b, right))
        # Contiguous, so that the order of a sum does not depend on the number of pairs.
        forth = np.sqrt(np.ascontiguousarray(squared.min(2))) * counted_a[left]
        back = np.sqrt(np.ascontiguousarray(squared.min(1))) * counted_b[right]
        distance[block] = 0.5 * (forth.sum(-1) / a.counts[left] + back.sum(-1) / b.counts[right])
    return distance


@dataclass(frozen=True)
class _Boxes:
    """Bounding boxes of the pieces of lines, and each piece's fraction of the vertices; lines are the last axis.

    No vertex is nearer to the other line than the boxes of their pieces. So the Chamfer distance of the boxes, weighted
    by vertices, bounds that of the lines from below.
    """

    low: Float[np.ndarray, "d s l"]
    high: Float[np.ndarray, "d s l"]
    weights: Float[np.ndarray, "s l"]

    @classmethod
    def of(cls, lines: PaddedLines) -> _Boxes:
        n = lines.points.shape[1]
        pieces = np.clip(n // _PIECE, 1, _PIECES)
        starts = np.arange(pieces) * n // pieces
        points = np.ascontiguousarray(lines.points.transpose(2, 1, 0))
        fraction = np.add.reduceat(lines.counted().T, starts, dtype=np.float64) / lines.counts
        return cls(np.minimum.reduceat(points, starts, axis=1), np.maximum.reduceat(points, starts, axis=1), fraction)


def _gap(
    low_a: Float[np.ndarray, "d *k"],
    high_a: Float[np.ndarray, "d *k"],
    low_b: Float[np.ndarray, "d *m"],
    high_b: Float[np.ndarray, "d *m"],
) -> Float[np.ndarray, "*k"]:
    """Return the least distance between points of two boxes; leading axis: coordinates."""
    step = np.maximum(np.maximum(low_a - high_b, low_b - high_a), 0.0)
    step *= step
    return np.sqrt(step.sum(0))


def _coordinates(lines: PaddedLines, chosen: Int[np.ndarray, " k"]) -> Float[np.ndarray, "d k n"]:
    """Return the coordinates of some lines, in memory along the longer of the axes k and n: numpy's inner loop."""
    points = lines.points[chosen]
    if len(points) > points.shape[1]:
        return np.ascontiguousarray(points.transpose(2, 1, 0)).swapaxes(1, 2)
    return np.ascontiguousarray(points.transpose(2, 0, 1))


def _squared(a: Float[np.ndarray, "d k n"], b: Float[np.ndarray, "d k m"]) -> Float[np.ndarray, "k n m"]:
    # In place, one coordinate at a time: memory traffic dominates the time.
    total = a[0, :, :, None] - b[0, :, None]
    total *= total
    for first, second in zip(a[1:], b[1:], strict=True):
        step = first[:, :, None] - second[:, None]
        step *= step
        total += step
    return total


def _blocks(pairs: int, entries: int) -> Iterator[slice]:
    size = max(1, _BLOCK // entries)
    return (slice(start, start + size) for start in range(0, pairs, size))

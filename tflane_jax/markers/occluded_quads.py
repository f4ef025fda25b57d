"""Quads in an image that may be the black square of a marker, from pairs of edge fragments.

Step 1 to 3 of `occluded_search`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.files.images import opencv

# Segments and quads that are tried at most, the best ones.
_SEGMENTS, _QUADS = 3000, 60
# Least difference of brightness across an edge, of 255.
CONTRAST = 10.0
# Brightness of black and scattered light, of 255.
_DARK = 20.0
# Prolongations of an edge whose end is hidden, as fractions of the visible part.
_LONGER = (0.1, 0.2, 0.3, 0.45, 0.65)
# Least fraction of margin cells that are brighter than the border.
_RING = 0.55
# A cell is white or black if its brightness is in this range, in units of the difference between the levels.
WHITE, BLACK = (0.6, 1.7), (-0.7, 0.4)


class _Segments(NamedTuple):
    """Line segments with the unit normal towards their dark side, by descending length."""

    middle: Float[np.ndarray, "s 2"]
    along: Float[np.ndarray, "s 2"]
    dark: Float[np.ndarray, "s 2"]
    length: Float[np.ndarray, " s"]


def _segments(grey: UInt8[np.ndarray, "h w"], least: float) -> _Segments:
    cv2 = opencv()
    lines = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    ends = np.zeros((0, 2, 2)) if lines is None else np.asarray(lines, np.float64).reshape(-1, 2, 2) + 0.5
    step = ends[:, 1] - ends[:, 0]
    length = np.hypot(step[:, 0], step[:, 1])
    order = np.argsort(-length, kind="stable")[:_SEGMENTS]
    order = order[length[order] >= max(0.25 * least, 4.0)]
    ends, length = ends[order], length[order]
    along = (ends[:, 1] - ends[:, 0]) / length[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], -1)
    at = ends[:, :1] + np.linspace(0.15, 0.85, 5)[None, :, None] * (ends[:, 1:] - ends[:, :1])
    bright = [
        np.mean([_pixels(grey, at + (sign * off) * normal[:, None]) for off in (1.5, 2.5)], (0, 2)) for sign in (1, -1)
    ]
    difference = bright[1] - bright[0]
    kept = np.abs(difference) >= CONTRAST
    dark = normal * np.sign(difference)[:, None]
    return _Segments(ends.mean(1)[kept], along[kept], dark[kept], length[kept])


def _pixels(grey: UInt8[np.ndarray, "h w"], points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    """Return the brightness of the pixels at these points, those of the border outside."""
    column = np.clip(points[..., 0].astype(np.int32), 0, grey.shape[1] - 1)
    row = np.clip(points[..., 1].astype(np.int32), 0, grey.shape[0] - 1)
    return grey[row, column].astype(np.float32)


def square_quads(grey: UInt8[np.ndarray, "h w"], n: int, least: float) -> list[Float[np.ndarray, "4 2"]]:
    """Return quads that may be black squares in a white margin, the likeliest first; corners clockwise.

    Args:
        grey: image.
        n: cells across the black square.
        least: smallest distance of opposite sides, pixels.
    """
    cv2 = opencv()
    found = _segments(grey, least)
    smooth = cv2.GaussianBlur(grey, (3, 3), 0)
    quads, scores = [np.zeros((0, 4, 2))], [np.zeros(0)]
    for first in np.array_split(np.arange(len(found.length)), max(1, len(found.length) // 500)):
        some = _of_pairs(found, *_pairs(found, first, least, 0.6 * min(grey.shape)))
        score = _ring_score(smooth, some, n)
        kept = score >= _RING
        quads.append(some[kept])
        scores.append(score[kept])
    every = np.concatenate(quads)
    # A shadow spoils the second rank and not the first.
    return _distinct(every, (_cell_score(smooth, every, n), np.concatenate(scores)))


def _pairs(found: _Segments, first: np.ndarray, least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of segments (rows) that face each other with their dark sides and may be opposite sides."""
    dark = found.dark.astype(np.float32)
    i, j = np.nonzero(dark[first] @ dark.T < -0.94)
    i = first[i]
    once = i < j
    i, j = i[once], j[once]
    apart = found.middle[j] - found.middle[i]
    gap, aside = (apart * found.dark[i]).sum(-1), np.abs((apart * found.along[i]).sum(-1))
    longer, shorter = np.maximum(found.length[i], found.length[j]), np.minimum(found.length[i], found.length[j])
    fits = (gap >= least) & (gap <= most) & (longer >= 0.4 * gap) & (longer <= 3.3 * gap) & (shorter >= 0.2 * gap)
    fits &= aside <= 0.5 * (longer + shorter)
    return i[fits], j[fits]


class _Edge(NamedTuple):
    """One segment of each pair, measured along the common direction of the pair.

    Attributes:
        middle: (q, 2) of the segment, pixels.
        along: (q, 2) its unit direction, turned to the common one.
        place: (q,) of the middle along the common direction, pixels.
        half: (q,) half its length, pixels.
    """

    middle: Float[np.ndarray, "q 2"]
    along: Float[np.ndarray, "q 2"]
    place: Float[np.ndarray, " q"]
    half: Float[np.ndarray, " q"]

    def ends(self) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
        """Return the places of both ends."""
        return self.place - self.half, self.place + self.half

    def at(self, place: Float[np.ndarray, " q"]) -> Float[np.ndarray, "q 2"]:
        """Return the points at places on the edge, or on its prolongation."""
        return self.middle + (place - self.place)[:, None] * self.along


def _edge(
    found: _Segments, rows: np.ndarray, along: Float[np.ndarray, "q 2"], origin: Float[np.ndarray, "q 2"]
) -> _Edge:
    turned = found.along[rows] * np.sign((found.along[rows] * along).sum(-1))[:, None]
    place = ((found.middle[rows] - origin) * along).sum(-1)
    return _Edge(found.middle[rows], turned, place, 0.5 * found.length[rows])


def _of_pairs(found: _Segments, i: np.ndarray, j: np.ndarray) -> Float[np.ndarray, "q 4 2"]:
    """Return the quads of pairs of segments, corners clockwise in the image.

    A pair gives several quads: from the ends of both segments, of one of them, or of their union, also prolonged.
    """
    same_way = np.sign((found.along[i] * found.along[j]).sum(-1))[:, None]
    along = found.along[i] + same_way * found.along[j]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    origin = 0.5 * (found.middle[i] + found.middle[j])
    a, b = _edge(found, i, along, origin), _edge(found, j, along, origin)
    low, high = np.minimum(a.ends()[0], b.ends()[0]), np.maximum(a.ends()[1], b.ends()[1])
    union, length = (low, high), high - low
    # The places of the corners on a, and those on b.
    choices = [(a.ends(), b.ends()), (a.ends(), a.ends()), (b.ends(), b.ends()), (union, union)]
    for more in _LONGER:
        before, behind = (low - more * length, high), (low, high + more * length)
        choices += [(before, before), (behind, behind)]
    every = np.concatenate([np.stack([a.at(a0), a.at(a1), b.at(b1), b.at(b0)], 1) for (a0, a1), (b0, b1) in choices])
    one, two = every[:, 1] - every[:, 0], every[:, 3] - every[:, 0]
    turn = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    return np.where((turn > 0.0)[:, None, None], every, every[:, ::-1])


@lru_cache(maxsize=8)
def _ring_points(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where border and margin cells beside each other lie, (4 n, 2) each, as fractions of the square."""
    t, inner, outer = (np.arange(n) + 0.5) / n, 0.5 / n, -0.5 / n
    sides = [[(s, e) for s in t] for e in (inner, outer)]
    pairs = []
    for points in (np.array(side) for side in sides):
        flipped = points[:, ::-1]
        far = points * [1.0, -1.0] + [0.0, 1.0]
        pairs.append(np.concatenate([points, far, flipped, far[:, ::-1]]))
    return pairs[0], pairs[1]


def _ring_score(smooth: UInt8[np.ndarray, "h w"], quads: Float[np.ndarray, "q 4 2"], n: int) -> Float[np.ndarray, " q"]:
    """Return the fraction of margin cells that are brighter than the border beside them by a common contrast."""
    if not len(quads):
        return np.zeros(0)

    inner, outer = (_bilinear(smooth, quads, points) for points in _ring_points(n))
    difference = outer - inner
    score = np.zeros(len(quads))
    rows = np.flatnonzero((difference > CONTRAST).mean(-1) >= _RING)
    # Relative to the brightness, the contrast in a shadow is that in the light.
    some = np.sort(difference[rows] / (outer[rows] + inner[rows] + _DARK), -1)
    level = some[:, round(0.7 * some.shape[1])][:, None]
    score[rows] = ((some > 0.5 * level) & (some < 2.0 * level)).mean(-1)
    return score


def _cell_score(smooth: UInt8[np.ndarray, "h w"], quads: Float[np.ndarray, "q 4 2"], n: int) -> Float[np.ndarray, " q"]:
    """Return how well a quad's cells are those of any marker, 0 to 1: white margin, black border, and nothing grey."""
    m = n + 2
    at = (np.arange(m) - 0.5) / n
    t, s = (axis.ravel() for axis in np.meshgrid(at, at, indexing="ij"))
    seen = _bilinear(smooth, quads, np.stack([s, t], -1))
    margin, border = (ring.ravel() for ring in rings(m))
    white, black = np.median(seen[:, margin], -1), np.median(seen[:, border], -1)
    fraction = (seen - black[:, None]) / np.maximum(white - black, CONTRAST)[:, None]
    bright, dark = (fraction > WHITE[0]) & (fraction < WHITE[1]), (fraction > BLACK[0]) & (fraction < BLACK[1])
    inside = ~margin & ~border
    ring = 0.5 * (bright[:, margin].mean(-1) + dark[:, border].mean(-1))
    return 0.7 * ring + 0.3 * (bright | dark)[:, inside].mean(-1)


def _bilinear(
    smooth: UInt8[np.ndarray, "h w"], quads: Float[np.ndarray, "q 4 2"], fraction: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, "q p"]:
    """Return the brightness at points given as fractions of each quad."""
    s, t = fraction[:, :1], fraction[:, 1:]
    weight = np.concatenate([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], -1).astype(np.float32)
    corners = quads.astype(np.float32)
    places = (weight @ corners.transpose(1, 0, 2).reshape(4, -1)).reshape(len(fraction), len(quads), 2)
    return _pixels(smooth, places.transpose(1, 0, 2))


def _distinct(
    quads: Float[np.ndarray, "q 4 2"], ranks: tuple[Float[np.ndarray, " q"], ...]
) -> list[Float[np.ndarray, "4 2"]]:
    """Return the best quads by each rank in turn, one at a place."""
    if not len(quads):
        return []
    middle = quads.mean(1)
    one, two = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    side = np.sqrt(np.maximum(0.5 * np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]), 1.0))
    free, kept = np.ones(len(quads), bool), []
    orders = [np.argsort(-rank, kind="stable") for rank in ranks]
    while free.any() and len(kept) < _QUADS:
        order = orders[len(kept) % len(orders)]
        best = int(order[np.argmax(free[order])])
        kept.append(quads[best])
        near = np.abs(middle - middle[best]).sum(-1) < 0.08 * side[best]
        free &= ~(near & (np.abs(np.log(side / side[best])) < 0.08))
    return kept


@lru_cache(maxsize=8)
def rings(m: int) -> tuple[Bool[np.ndarray, "m m"], Bool[np.ndarray, "m m"]]:
    """Return which of m x m cells are the white margin, and which the black border."""
    index = np.arange(m)
    depth = np.minimum(np.minimum.outer(index, index), np.minimum.outer(m - 1 - index, m - 1 - index))
    return depth == 0, depth == 1

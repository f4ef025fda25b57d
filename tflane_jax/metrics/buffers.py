"""Whether the buffers of two polylines touch: radius r, flat ends, mitred bends (numpy, no shapely).

MapTR's evaluator compares only such pairs (docs/reference/metrics.md, section 4). A buffer is a union of convex pieces:
one rectangle for each segment, and on the outer side of each bend a kite up to the tip of the mitre, which is cut off
five radii away from the bend. Two buffers touch if two of their pieces do.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

_MITRE_LIMIT = 5.0
# Pairs of lines whose pieces are compared at a time.
_BLOCK = 64


def buffers_touch(
    a: Float[np.ndarray, "a n 2"],
    b: Float[np.ndarray, "b m 2"],
    i: Int[np.ndarray, " k"],
    j: Int[np.ndarray, " k"],
    radius: float,
) -> Bool[np.ndarray, " k"]:
    """Return whether the buffers of line i of a and line j of b have a point in common (touching counts).

    A line of length zero has an empty buffer and touches nothing. Repeated vertices change nothing, so ragged lines may
    be padded by them.
    """
    touch = _middle_inside(a, b, i, j, radius) | _middle_inside(b, a, j, i, radius)
    # Few pairs remain: of lines side by side, each contains the other's middle.
    left = np.flatnonzero(~touch & _has_length(a)[i] & _has_length(b)[j])
    for start in range(0, len(left), _BLOCK):
        block = left[start : start + _BLOCK]
        touch[block] = _any_pieces_touch(_convex_pieces(a[i[block]], radius), _convex_pieces(b[j[block]], radius))
    return touch


def _has_length(lines: Float[np.ndarray, "l n 2"]) -> Bool[np.ndarray, " l"]:
    return (lines[:, 1:] != lines[:, :-1]).any((1, 2))


def _middle_inside(
    a: Float[np.ndarray, "a n 2"],
    b: Float[np.ndarray, "b m 2"],
    i: Int[np.ndarray, " k"],
    j: Int[np.ndarray, " k"],
    radius: float,
) -> Bool[np.ndarray, " k"]:
    """Return whether the middle vertex of line i, a point of its buffer, lies in a rectangle of line j."""
    middle = a[i, a.shape[1] // 2]
    segment = np.diff(b, axis=1)
    length = np.hypot(segment[..., 0], segment[..., 1])
    along = segment / np.where(length > 0.0, length, np.inf)[..., None]
    from_start = middle[:, None] - b[j, :-1]
    unit = along[j]
    forward = (from_start * unit).sum(-1)
    aside = from_start[..., 0] * unit[..., 1] - from_start[..., 1] * unit[..., 0]
    inside = (forward >= 0.0) & (forward <= length[j]) & (np.abs(aside) <= radius) & (length[j] > 0.0)
    return inside.any(-1) & _has_length(a)[i]


def _convex_pieces(lines: Float[np.ndarray, "l n 2"], radius: float) -> Float[np.ndarray, "l s 5 2"]:
    """Return the corners of rectangles and bends, some twice; NaN for the pieces of segments of length zero."""
    lines = _without_repetitions(lines)
    segment = np.diff(lines, axis=1)
    length = np.hypot(segment[..., 0], segment[..., 1])[..., None]
    along = np.divide(segment, length, out=np.full_like(segment, np.nan), where=length > 0.0)
    normal = radius * np.stack([-along[..., 1], along[..., 0]], -1)
    start, end = lines[:, :-1], lines[:, 1:]
    rectangles = np.stack([start + normal, end + normal, end - normal, start - normal, start - normal], 2)

    before, after = along[:, :-1], along[:, 1:]
    left_turn = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0] > 0.0
    outward = np.where(left_turn, -1.0, 1.0)[..., None]
    bend, first, second = lines[:, 1:-1], outward * normal[:, :-1], outward * normal[:, 1:]
    cosine = (before * after).sum(-1, keepdims=True)
    # The tip lies at (first + second) / (1 + cosine), sqrt(2 / (1 + cosine)) radii from the bend.
    pointed = 1.0 + cosine >= 2.0 / _MITRE_LIMIT**2
    tip = (first + second) / np.where(pointed, 1.0 + cosine, 1.0)
    # Both sides of the kite come nearer to its axis by the cosine of half the turn for each metre along it.
    axis, across = before - after, first - second
    far = _MITRE_LIMIT * radius * axis / np.where(pointed, 1.0, np.linalg.norm(axis, axis=-1, keepdims=True))
    half = radius - _MITRE_LIMIT * radius * np.sqrt(np.maximum(1.0 + cosine, 0.0) / 2.0)
    half = half * across / np.where(pointed, 1.0, np.linalg.norm(across, axis=-1, keepdims=True))
    near_first, near_second = np.where(pointed, tip, far + half), np.where(pointed, tip, far - half)
    bends = np.stack([bend, bend + first, bend + near_first, bend + near_second, bend + second], 2)
    return np.concatenate([rectangles, bends], 1)


def _without_repetitions(lines: Float[np.ndarray, "l n 2"]) -> Float[np.ndarray, "l n 2"]:
    """Move vertices that repeat their predecessor to the end."""
    kept = np.concatenate([np.ones((len(lines), 1), bool), (lines[:, 1:] != lines[:, :-1]).any(-1)], 1)
    order = np.argsort(~kept, axis=1, kind="stable")
    order = np.where(np.take_along_axis(kept, order, 1), order, order[np.arange(len(order)), kept.sum(1) - 1][:, None])
    return np.take_along_axis(lines, order[..., None], 1)


def _any_pieces_touch(a: Float[np.ndarray, "k s c 2"], b: Float[np.ndarray, "k t c 2"]) -> Bool[np.ndarray, " k"]:
    """Return for each k whether one of a's pieces touches one of b's."""
    low_a, high_a, low_b, high_b = a.min(2), a.max(2), b.min(2), b.max(2)
    # Comparisons with NaN are false, which excludes absent pieces.
    boxes = (low_a[:, :, None] <= high_b[:, None]) & (low_b[:, None] <= high_a[:, :, None])
    pair, s, t = np.nonzero(boxes.all(-1))
    touch = np.zeros(len(a), bool)
    touch[pair[_polygons_touch(a[pair, s], b[pair, t])]] = True
    return touch


def _polygons_touch(a: Float[np.ndarray, "k c 2"], b: Float[np.ndarray, "k c 2"]) -> Bool[np.ndarray, " k"]:
    """Return whether convex polygons intersect: no normal of an edge separates them."""
    edges = np.concatenate([shape - np.roll(shape, 1, axis=1) for shape in (a, b)], 1)
    normals = np.stack([-edges[..., 1], edges[..., 0]], -1)
    on_a, on_b = (np.einsum("kec,kpc->kep", normals, shape) for shape in (a, b))
    apart = (on_a.max(-1) < on_b.min(-1)) | (on_b.max(-1) < on_a.min(-1))
    return ~apart.any(-1)

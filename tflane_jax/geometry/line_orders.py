"""Equivalent orders of a map line's points (MapTR, Liao et al. 2023, section 3.1).

A line can be drawn from either end, and a ring from any point and in either direction. The reference code has five
ways to list the orders of a ring (`gt_shift_pts_pattern` v0 to v4). v1 and v4 shift the points of the ring after
resampling: `point_orders`, which runs on the device. v2 and v3 start at each vertex of the original ring and resample
from there, for which the original ring is needed. v0 shifts the repeated point with the others, so that one step of
each shifted ring has no length; it is left out.

The loss uses `point_orders`, of rings that were resampled from their first corner (`geometry.rings`): it does not
depend on the vertex at which the source starts a ring, and the truth of a frame stays L x P points. The orders of v2
would have to be stored with every frame, P - 1 times as much, and of a ring with more vertices the reference draws a
random part.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry.namespace import ArrayT, namespace

Ways = Literal["one", "both"]
"""Directions in which a ring is listed."""


def order_indices(points: int, ways: Ways = "one") -> np.ndarray:
    """Return the indices (O, P) of a ring's orders: the points of order o are `ring[indices[o]]`.

    Each order ends where it starts.

    Args:
        points: P, with the first point repeated at the end.
        ways: "one": P - 1 orders, v1 of the reference; "both": 2 (P - 1) orders, v4.
    """
    ring = points - 1
    forward = np.arange(points)[None] - np.arange(ring)[:, None]
    return (forward if ways == "one" else np.concatenate([forward, ring - 1 - forward])) % ring


def point_orders(
    points: Float[ArrayT, "l p d"],
    closed: Bool[ArrayT, " l"],
    directed: Bool[ArrayT, " l"] | None = None,
    ways: Ways = "one",
) -> tuple[Float[ArrayT, "l o p d"], Bool[ArrayT, "l o"]]:
    """Return the equivalent orders of lines of P >= 2 points, and which of them exist; numpy or jax.

    An open line has two orders, a directed one (centerlines) has its own only. A ring has those of `order_indices`.

    Args:
        points: of the lines; a ring repeats its first point at the end.
        closed: the line is a ring.
        directed: the line has one order; None: no line.
        ways: see `order_indices`.
    """
    xp, (lines, count, _) = namespace(points, closed), points.shape
    rings = order_indices(count, ways)
    of_ring, number = len(rings), max(len(rings), 2)
    # An open line's two orders, then the first again, which do not count.
    either = np.zeros((number, count), np.int64) + np.arange(count)
    either[1] = either[1, ::-1]
    rings = rings[np.minimum(np.arange(number), of_ring - 1)]
    index = xp.where(closed[:, None, None], xp.asarray(rings)[None], xp.asarray(either)[None])
    found = xp.take_along_axis(points[:, None], index[..., None], 2)
    directed = xp.zeros(lines, bool) if directed is None else directed
    amount = xp.where(directed, 1, xp.where(closed, of_ring, 2))
    return found, xp.arange(number)[None] < amount[:, None]

"""Distances between polylines: discrete Frechet and Chamfer, over vertices as the lane metrics define them.

Leading axes broadcast, so one call serves aligned pairs (`f(a, b)`) and all pairs (`f(a[:, None], b[None])`); numpy
arrays in float64 on the host, jax arrays under jit. Source: docs/reference/metrics.md, section 1; Eiter & Mannila,
Computing Discrete Frechet Distance (1994), for the recursion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry.namespace import AnyArray, ArrayT, namespace


def pad_lines(
    lines: Sequence[Float[AnyArray, "_ d"]] | Float[AnyArray, "l n d"], dims: int = 3
) -> Float[np.ndarray, "l n d"]:
    """Stack ragged polylines into one float64 array by repeating each line's last vertex (numpy).

    The repetition changes neither the discrete Frechet distance nor the vertex nearest to a point. It does change means
    over vertices, so the Chamfer distance needs the true counts. Raises ValueError for a line without points.
    """
    if len(lines) == 0:
        return np.zeros((0, 1, dims))
    sizes = np.array([len(line) for line in lines])
    if sizes.min() == 0:
        raise ValueError(f"polyline {int(sizes.argmin())} has no points")
    if (sizes == sizes[0]).all():
        return np.asarray(lines, np.float64)
    first = np.cumsum(sizes) - sizes
    index = first[:, None] + np.minimum(np.arange(sizes.max()), sizes[:, None] - 1)
    return np.concatenate([np.asarray(line, np.float64) for line in lines])[index]


def vertex_distance(a: Float[ArrayT, "*b d"], b: Float[ArrayT, "*b d"]) -> Float[ArrayT, "*b"]:
    """Return the Euclidean distance between points; leading axes broadcast."""
    return _root(_squared(a, b))


def discrete_frechet(a: Float[ArrayT, "*b n d"], b: Float[ArrayT, "*b m d"]) -> Float[ArrayT, "*b"]:
    """Return the discrete Frechet distance between polylines, metres; n, m >= 1, leading axes broadcast.

    Directional: a reversed polyline is far away. Never less than the distance of the two first vertices nor of the
    two last ones.
    """
    xp = namespace(a, b)
    # The vertex axes come first: each step of the recursion then works on one contiguous array over all pairs.
    a, b = xp.moveaxis(xp.asarray(a), -2, 0), xp.moveaxis(xp.asarray(b), -2, 0)
    # Minimum and maximum commute with the square, so one root at the end is enough.
    recursion: Any = _frechet_jax if xp is jnp else _frechet_numpy
    return _root(recursion(a, b))


def chamfer(
    a: Float[ArrayT, "*b n d"],
    b: Float[ArrayT, "*b m d"],
    a_valid: Bool[ArrayT, "*b n"] | None = None,
    b_valid: Bool[ArrayT, "*b m"] | None = None,
) -> Float[ArrayT, "*b"]:
    """Return half the sum of the mean distances from each vertex to the nearest vertex of the other line, metres.

    Not squared, blind to direction. `a_valid` and `b_valid` leave vertices out of both the means and the search
    (None: all count); a line without valid vertices gives inf.
    """
    xp = namespace(a, b)
    a, b = xp.asarray(a), xp.asarray(b)
    rows = xp.ones(a.shape[:-1], bool) if a_valid is None else xp.asarray(a_valid)
    columns = xp.ones(b.shape[:-1], bool) if b_valid is None else xp.asarray(b_valid)
    squared = _squared(a[..., :, None, :], b[..., None, :, :])
    squared = xp.where(rows[..., :, None] & columns[..., None, :], squared, xp.inf)
    return 0.5 * (_valid_mean(squared.min(-1), rows) + _valid_mean(squared.min(-2), columns))


def _valid_mean(squared: Float[ArrayT, "*b n"], valid: Bool[ArrayT, "*b n"]) -> Float[ArrayT, "*b"]:
    xp = namespace(squared)
    count = valid.sum(-1)
    total = _root(xp.where(valid, squared, 0.0)).sum(-1)
    return xp.where(count > 0, total / xp.maximum(count, 1), xp.inf)


def _root(squared: Float[ArrayT, "*b"]) -> Float[ArrayT, "*b"]:
    """Return the square root, with a gradient of 0 at 0, where that of `jnp.sqrt` is NaN."""
    xp = namespace(squared)
    if xp is np:
        return xp.sqrt(squared)
    some = squared > 0.0
    return xp.where(some, xp.sqrt(xp.where(some, squared, 1.0)), squared)


def _squared(a: Float[ArrayT, "*b d"], b: Float[ArrayT, "*b d"]) -> Float[ArrayT, "*b"]:
    # Differences, not |a|^2 + |b|^2 - 2ab: that form loses the distances that lie exactly on a threshold. Summed
    # coordinate by coordinate, so that every caller rounds alike.
    total = (a[..., 0] - b[..., 0]) ** 2
    for axis in range(1, a.shape[-1]):
        total = total + (a[..., axis] - b[..., axis]) ** 2
    return total


def _frechet_numpy(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared distance; a (n, *B, d), b (m, *B, d)."""
    row: list[np.ndarray] = []
    for point in a:
        squared = _squared(point[None], b)
        above, row = row, []
        for j, here in enumerate(squared):
            # The least of the three cells from which a coupling can step here (fewer on the first row and column).
            best = row[j - 1] if j else None
            for before in above[max(j - 1, 0) : j + 1]:
                best = before if best is None else np.minimum(best, before)
            row.append(here if best is None else np.maximum(here, best))
    return row[-1]


def _frechet_jax(a: jax.Array, b: jax.Array) -> jax.Array:
    """Squared distance; a (n, *B, d), b (m, *B, d)."""

    def along(left: jax.Array, cell: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        here, before = cell
        out = jnp.maximum(here, jnp.minimum(left, before))
        return out, out

    def down(above: jax.Array, point: jax.Array) -> tuple[jax.Array, None]:
        squared = _squared(point[None], b)
        # Row cell j may be reached from above[j] and above[j - 1]; no cell lies left of the first.
        before = jnp.minimum(above, jnp.concatenate([jnp.full_like(above[:1], jnp.inf), above[:-1]]))
        return jax.lax.scan(along, jnp.full_like(squared[0], jnp.inf), (squared, before))[1], None

    first = jax.lax.cummax(_squared(a[:1], b), axis=0)
    return jax.lax.scan(down, first, a[1:])[0][-1]

"""Closed rings on the host: which way they run, and where they start (numpy)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry.namespace import AnyArray


def signed_area(ring: Float[AnyArray, "n d"]) -> float:
    """Return the area of a ring in the ground plane, square metres; negative if it runs clockwise.

    Args:
        ring: repeats its first point at the end.
    """
    x, y = (np.asarray(ring)[:, :2] - ring[0, :2]).T
    return float(0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def oriented(polygon: Sequence[Float[np.ndarray, "_ d"]]) -> list[np.ndarray]:
    """Return the rings of a polygon, the exterior first: it runs clockwise, the interiors counter-clockwise."""
    left = [signed_area(ring) > 0.0 for ring in polygon]
    return [ring[::-1] if left[i] == (i == 0) else ring for i, ring in enumerate(polygon)]


def from_first_corner(ring: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Return a ring that starts at its vertex of the smallest x; of several, at that of the smallest y.

    Points spaced equally along the result are the same for every start of the given ring. Coordinates count in
    millimetres, so that rounding does not choose the vertex.
    """
    x, y = ring[:-1, :2].round(3).T
    start = np.lexsort((y, x))[0]
    return np.concatenate([ring[start:-1], ring[: start + 1]])

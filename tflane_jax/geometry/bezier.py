"""Bezier curves fitted to polylines by constant matrices.

Reference: the centerline baseline of OpenLane-V2, which predicts 5 control points and fixes the end points. The points
of a polyline have equally spaced parameters on the curve.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float


def bezier_basis(points: int, controls: int) -> Float[np.ndarray, "p k"]:
    """Return the Bernstein matrix from `controls` control points to `points` points of the curve."""
    t, degree = np.linspace(0.0, 1.0, points)[:, None], controls - 1
    order = np.arange(controls)[None]
    ways = np.array([math.comb(degree, k) for k in range(controls)])[None]
    return ways * t**order * (1.0 - t) ** (degree - order)


def bezier_fit(points: int, controls: int) -> Float[np.ndarray, "k p"]:
    """Return the least-squares matrix from a polyline to control points; the first and the last are its ends.

    Raises:
        ValueError: fewer points than control points, or fewer than two control points.
    """
    if not 2 <= controls <= points:
        raise ValueError(f"{points} points do not determine {controls} control points")
    basis = bezier_basis(points, controls)
    fit = np.zeros((controls, points))
    fit[0, 0] = fit[-1, -1] = 1.0
    rest = np.eye(points)[1:-1] - basis[1:-1, :1] * np.eye(points)[:1] - basis[1:-1, -1:] * np.eye(points)[-1:]
    fit[1:-1] = np.linalg.pinv(basis[1:-1, 1:-1]) @ rest
    return fit

"""Bezier curves through a polyline, as constant matrices: OpenLane-V2's baseline describes centerlines so.

Reference: specs/modules.md section 13 ("5 Bezier control points, end points fixed"). The points of a polyline stand at
equal steps of the curve's parameter.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float


def bezier_basis(points: int, controls: int) -> Float[np.ndarray, "p k"]:
    """Return the matrix that makes `points` points of a curve from its `controls` control points (Bernstein)."""
    t, degree = np.linspace(0.0, 1.0, points)[:, None], controls - 1
    order = np.arange(controls)[None]
    ways = np.array([math.comb(degree, k) for k in range(controls)])[None]
    return ways * t**order * (1.0 - t) ** (degree - order)


def bezier_fit(points: int, controls: int) -> Float[np.ndarray, "k p"]:
    """Return the matrix that fits control points to a polyline: its ends stay, the others by least squares.

    Raises:
        ValueError: fewer points than control points, or fewer than two of those.
    """
    if not 2 <= controls <= points:
        raise ValueError(f"{points} points do not determine {controls} control points")
    basis = bezier_basis(points, controls)
    fit = np.zeros((controls, points))
    fit[0, 0] = fit[-1, -1] = 1.0
    rest = np.eye(points)[1:-1] - basis[1:-1, :1] * np.eye(points)[:1] - basis[1:-1, -1:] * np.eye(points)[-1:]
    fit[1:-1] = np.linalg.pinv(basis[1:-1, 1:-1]) @ rest
    return fit

"""The image of a lane line in the lane shape model of the LSTR family: GTN paper Eq. (7).

A cubic on flat ground, seen by a pitched camera, is a curve u(v), u to the right and v down, in pixels or in any other
unit:

    u = k'' / (v - f'')^2 + m'' / (v - f'') + n' + b'' v - b'''                                                 (7)

tests/geometry/ground_curves.py has the steps from Eq. (5) and (6).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.geometry.namespace import AnyArray, ArrayT, namespace


def curve_columns(
    curves: Float[ArrayT, "*b 6"], rows: Float[AnyArray, "*#b r"], least: float = 1e-6
) -> Float[ArrayT, "*b r"]:
    """Return u(v) of curves (k'', f'', m'', n', b'', b''') at rows v: Eq. (7).

    Args:
        curves: coefficients, last axis.
        rows: v, for each curve.
        least: rows nearer to the horizon f'' than this count as this far below it.
    """
    xp = namespace(curves)
    k, f, m, n, b, offset = (curves[..., i, None] for i in range(6))
    below = rows - f
    below = xp.where(xp.abs(below) < least, least, below)
    return k / below**2 + m / below + n + b * rows - offset  # Eq. (7)


def order_from_left(curves: Float[np.ndarray, "l 8"]) -> Int[np.ndarray, " l"]:
    """Return the order of lanes from left to right, all of them continued down to the lowest lower end.

    At their own lower ends they would not compare: of two lanes that leave the image at its side, the one farther out
    does so higher up.

    Args:
        curves: upper and lower row of each lane, then the coefficients of Eq. (7); numpy.
    """
    lowest = np.broadcast_to(curves[:, 1:2].max(initial=-np.inf), (len(curves), 1))
    return np.argsort(curve_columns(curves[:, 2:], lowest)[:, 0], kind="stable")

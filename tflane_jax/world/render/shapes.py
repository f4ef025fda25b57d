"""Building blocks of vehicles and roadside objects: boxes, frusta, panels and wheels made of flat polygons."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.world.render.camera import lift
from tflane_jax.world.render.polygons import Solid

Colour = tuple[float, float, float]
PAINTS: tuple[Colour, ...] = (
    (0.92, 0.92, 0.92),
    (0.9, 0.9, 0.88),
    (0.62, 0.64, 0.66),
    (0.42, 0.44, 0.46),
    (0.08, 0.08, 0.09),
    (0.13, 0.13, 0.15),
    (0.55, 0.08, 0.07),
    (0.1, 0.16, 0.4),
    (0.25, 0.36, 0.5),
    (0.5, 0.42, 0.3),
    (0.1, 0.25, 0.16),
)
GLASS: Colour = (0.1, 0.12, 0.14)
RUBBER: Colour = (0.06, 0.06, 0.06)
_HUB: Colour = (0.45, 0.45, 0.47)


def frustum(
    solid: Solid,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    half: tuple[float, float],
    colours: dict[str, Colour],
) -> dict[str, np.ndarray]:
    """Add the faces of a body that tapers from (x0, x1, z) at its bottom to (x0, x1, z) at its top.

    Args:
        solid: receives them.
        low, high: x of the rear, x of the front, and z, of bottom and top, metres.
        half: half the width of bottom and top, metres.
        colours: by face name: top, left, right, front, rear; "all" for the remaining faces.

    Returns:
        The corners (4, 3) of each face, from the one at its lower left as seen from outside, counter-clockwise.
    """
    (a0, a1, az), (b0, b1, bz), (ha, hb) = low, high, half
    faces = {
        "top": [(b0, -hb, bz), (b1, -hb, bz), (b1, hb, bz), (b0, hb, bz)],
        "left": [(a1, ha, az), (a0, ha, az), (b0, hb, bz), (b1, hb, bz)],
        "right": [(a0, -ha, az), (a1, -ha, az), (b1, -hb, bz), (b0, -hb, bz)],
        "front": [(a1, -ha, az), (a1, ha, az), (b1, hb, bz), (b1, -hb, bz)],
        "rear": [(a0, ha, az), (a0, -ha, az), (b0, -hb, bz), (b0, hb, bz)],
    }
    for name, corners in faces.items():
        solid.add(np.array(corners), colours.get(name, colours["all"]))
    return {name: np.array(corners) for name, corners in faces.items()}


def inset(
    face: Float[np.ndarray, "4 3"], across: tuple[float, float], up: tuple[float, float]
) -> Float[np.ndarray, "4 3"]:
    """Return the part of a face between two fractions of its width (from the left) and two of its height."""
    return insets(face, np.array([across]), np.array([up]))[0]


def insets(
    face: Float[np.ndarray, "4 3"], across: Float[np.ndarray, "n 2"], up: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 4 3"]:
    """Return `inset` for n pairs of fractions."""
    lower_left, lower_right, upper_right, upper_left = face
    u, v = across[:, [0, 1, 1, 0], None], up[:, [0, 0, 1, 1], None]
    return (1 - v) * ((1 - u) * lower_left + u * lower_right) + v * ((1 - u) * upper_left + u * upper_right)


def panel(
    solid: Solid,
    x: float,
    y: tuple[float, float],
    z: tuple[float, float],
    rear: bool,
    colour: Colour,
    light: float = 0.0,
) -> None:
    """Add an upright rectangle that faces backwards or forwards."""
    (y0, y1), (z0, z1) = y, z
    corners = [(x, y1, z0), (x, y0, z0), (x, y0, z1), (x, y1, z1)]
    solid.add(np.array(corners if rear else corners[::-1]), colour, light)


def wheels(solid: Solid, places: tuple[float, ...], half: float, radius: float) -> None:
    """Add the wheels as discs, seen from the sides."""
    angle = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    for x in places:
        for side in (-1.0, 1.0):
            hub = np.array([x, side * half, radius])
            ring = np.stack([np.cos(angle), np.zeros(8), side * -np.sin(angle)], -1)
            solid.add(hub + radius * ring, RUBBER)
            solid.add(hub + 0.55 * radius * ring, _HUB)


def box(solid: Solid, center: np.ndarray, heading: float, size: tuple[float, float], z: tuple[float, float], colour):
    """Add an upright box: length along the heading and width across it."""
    u = np.array([np.cos(heading), np.sin(heading)])
    v = np.array([-u[1], u[0]])
    a, b = 0.5 * size[0] * u, 0.5 * size[1] * v
    ring = np.array([center - a - b, center + a - b, center + a + b, center - a + b])
    low, high = lift(ring, z[0]), lift(ring, z[1])
    for i in range(4):
        j = (i + 1) % 4
        solid.add(np.stack([low[i], low[j], high[j], high[i]]), colour)
    solid.add(high, colour)
    solid.add(low[::-1], tuple(0.6 * c for c in colour))

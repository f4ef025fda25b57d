"""Polygon models of road users for the ring cameras, complete from every side, in the frame of their box."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import RoadUser
from tflane_jax.world.cameras.solids import Box
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import GLASS, PAINTS, RUBBER, Colour, box, frustum, inset, panel, wheels

_TRAILERS: tuple[Colour, ...] = (
    (0.88, 0.88, 0.87),
    (0.78, 0.79, 0.76),
    (0.2, 0.3, 0.5),
    (0.55, 0.2, 0.15),
    (0.3, 0.42, 0.34),
    (0.8, 0.62, 0.2),
)
_CLOTHES: tuple[Colour, ...] = (
    (0.12, 0.13, 0.18),
    (0.6, 0.12, 0.1),
    (0.15, 0.3, 0.55),
    (0.75, 0.73, 0.68),
    (0.3, 0.33, 0.3),
    (0.85, 0.6, 0.15),
    (0.2, 0.45, 0.3),
    (0.45, 0.3, 0.4),
)
_SKIN: tuple[Colour, ...] = ((0.85, 0.66, 0.54), (0.55, 0.38, 0.28), (0.75, 0.55, 0.42))
_WINDOW: Colour = (0.13, 0.16, 0.19)
_UNDER: Colour = (0.04, 0.04, 0.05)
_LAMP: Colour = (0.95, 0.95, 0.88)
_TAIL: Colour = (0.7, 0.06, 0.05)
Parts = list[tuple[Solid, Box]]


def road_user(
    category: int, size: Float[np.ndarray, "3"], look: Float[np.ndarray, "8"], night: float, pace: float = 0.0
) -> Parts:
    """Return the bodies of a road user at the origin that heads along x.

    Args:
        category: `RoadUser`.
        size: length, width, height, metres.
        look: random numbers from 0 to 1 that choose shape and colours.
        night: 0 to 1, brightness of its lamps.
        pace: phase of a walker's step, 0 to 1.
    """
    length, width, height = (float(value) for value in size)
    if category == RoadUser.TRUCK:
        return _truck(length, width, height, look, night)
    solid = Solid()
    if category == RoadUser.BUS:
        _bus(solid, length, width, height, look, night)
    elif category in (RoadUser.MOTORCYCLE, RoadUser.BICYCLE):
        _two_wheeler(solid, length, height, look, night, category == RoadUser.MOTORCYCLE)
    elif category == RoadUser.PEDESTRIAN:
        _pedestrian(solid, height, look, pace)
    else:
        _car(solid, length, width, height, look, night)
    return [(solid, (0.0, 0.0, length, width, 0.0, 0.0, height))]


def _pick(colours: tuple[Colour, ...], fraction: float) -> Colour:
    return colours[min(int(fraction * len(colours)), len(colours) - 1)]


def _shaded(colour: Colour, factor: float) -> Colour:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


def _car(solid: Solid, length: float, width: float, height: float, look: np.ndarray, night: float) -> None:
    paint = _pick(PAINTS, look[0])
    half, x0, x1 = 0.5 * width, -0.5 * length, 0.5 * length
    kind = 0 if look[1] < 0.4 else 1 if look[1] < 0.8 else 2  # saloon, hatchback, van
    sill, belt = 0.16 * height, (0.55, 0.56, 0.52)[kind] * height
    bonnet = (0.27, 0.24, 0.12)[kind] * length
    boot = (0.15, 0.02, 0.0)[kind] * length
    nose = 0.86 * belt
    # Underneath, then the lower body with a bonnet that falls towards the nose.
    under = x0 + 0.15, x1 - 0.15
    frustum(solid, (*under, 0.08), (*under, sill), (half * 0.9, half * 0.9), {"all": _UNDER})
    lower = frustum(solid, (x0, x1, sill), (x0 + 0.03, x1 - 0.06, nose), (half, half * 0.97), {"all": paint})
    shoulder = (x0 + 0.06, x1 - 0.5 * bonnet, belt)
    frustum(solid, (x0 + 0.03, x1 - 0.06, nose), shoulder, (half * 0.97, half * 0.93), {"all": paint})
    for side, z in (("left", 0.12), ("right", 0.12)):
        solid.add(inset(lower[side], (0.02, 0.98), (0.0, z)), _shaded(paint, 0.45))
    axles = (x0 + 0.19 * length, x1 - 0.18 * length)
    radius = float(np.clip(0.215 * height, 0.29, 0.37))
    wheels(solid, axles, half * 1.003, radius)
    for x, rear in ((x0 + 0.19 * length - radius, True), (x1 - 0.18 * length + radius, False)):
        for low, high in ((-0.94 * half, -0.7 * half), (0.7 * half, 0.94 * half)):
            panel(solid, x, (low, high), (0.0, sill), rear, RUBBER)
    _ends(solid, x0, x1, half, sill, nose, paint, night, look)
    cabin = frustum(
        solid,
        (x0 + boot + 0.05, x1 - bonnet, belt),
        (x0 + boot + (0.5, 0.3, 0.1)[kind], x1 - bonnet - 0.62, height),
        (half * 0.9, half * 0.7),
        {"all": paint},
    )
    for side in ("left", "right"):
        middle = 0.5 if kind < 2 else 0.62
        first, second = (0.06, middle - 0.02), (middle + 0.02, 0.94)
        solid.add(inset(cabin[side], first, (0.1, 0.86)), _WINDOW)
        if kind < 2 or look[5] < 0.5:
            solid.add(inset(cabin[side], second, (0.1, 0.86)), _WINDOW)
    solid.add(inset(cabin["front"], (0.06, 0.94), (0.06, 0.92)), GLASS)
    solid.add(inset(cabin["rear"], (0.1, 0.9), (0.18, 0.88)), GLASS)


def _ends(
    solid: Solid,
    x0: float,
    x1: float,
    half: float,
    sill: float,
    nose: float,
    paint: Colour,
    night: float,
    look: np.ndarray,
) -> None:
    """Add bumpers, plates and lamps."""
    rise = nose - sill
    dark = _shaded(paint, 0.5)
    panel(solid, x0 - 0.01, (-0.97 * half, 0.97 * half), (sill, sill + 0.28 * rise), True, dark)
    panel(solid, x0 - 0.02, (-0.26, 0.26), (sill + 0.45 * rise, sill + 0.62 * rise), True, (0.82, 0.82, 0.76))
    panel(solid, x1 + 0.01, (-0.65 * half, 0.65 * half), (sill + 0.05 * rise, sill + 0.5 * rise), False, _UNDER)
    panel(solid, x1 + 0.02, (-0.26, 0.26), (sill + 0.2 * rise, sill + 0.36 * rise), False, (0.82, 0.82, 0.76))
    braking = look[3] < 0.3
    shine = max(0.85 * min(1.0, 2.0 * night), 0.95 * braking)
    tail = (0.95, 0.12, 0.08) if braking else _TAIL
    for side in (-1.0, 1.0):
        inner, outer = 0.62 * side * half, 0.96 * side * half
        y = (min(inner, outer), max(inner, outer))
        panel(solid, x0 - 0.02, y, (sill + 0.6 * rise, sill + 0.92 * rise), True, tail, shine)
        panel(solid, x1 + 0.02, y, (sill + 0.6 * rise, sill + 0.85 * rise), False, _LAMP, min(1.0, 2.0 * night))


def _truck(length: float, width: float, height: float, look: np.ndarray, night: float) -> Parts:
    half, x0, x1 = 0.5 * width, -0.5 * length, 0.5 * length
    split, floor = x1 - 2.0, 0.95
    load, cab = Solid(), Solid()
    trailer, paint = _pick(_TRAILERS, look[0]), _pick(PAINTS, look[1])
    frustum(load, (x0 + 0.2, split, 0.45), (x0 + 0.2, split, floor), (half * 0.7, half * 0.7), {"all": _UNDER})
    wheels(load, (x0 + 1.1, x0 + 2.15), half * 0.98, 0.5)
    for low, high in ((-half, -half + 0.5), (half - 0.5, half)):
        panel(load, x0 + 0.6, (low, high), (0.0, floor), True, RUBBER)
    faces = frustum(load, (x0, split, floor), (x0, split, height), (half, half), {"all": trailer})
    for side in ("left", "right"):
        load.add(inset(faces[side], (0.0, 1.0), (0.0, 0.05)), _shaded(trailer, 0.55))
        if look[2] < 0.6:
            load.add(inset(faces[side], (0.15, 0.85), (0.35, 0.7)), _pick(_TRAILERS, look[4]))
    load.add(inset(faces["rear"], (0.49, 0.51), (0.0, 1.0)), _shaded(trailer, 0.5))
    load.add(inset(faces["rear"], (0.0, 1.0), (0.0, 0.04)), (0.25, 0.25, 0.26))
    _lamps(load, x0 - 0.01, half, (floor - 0.25, floor - 0.08), True, night)
    top = 0.82 * height if look[5] < 0.6 else 0.95 * height
    wheels(cab, (x1 - 1.0,), half * 0.97, 0.5)
    front = frustum(
        cab, (split + 0.15, x1, 0.4), (split + 0.15, x1 - 0.12, top), (half * 0.97, half * 0.94), {"all": paint}
    )
    cab.add(inset(front["front"], (0.05, 0.95), (0.55, 0.88)), GLASS)
    cab.add(inset(front["front"], (0.15, 0.85), (0.1, 0.45)), _shaded(paint, 0.3))
    cab.add(inset(front["left"], (0.12, 0.55), (0.55, 0.86)), _WINDOW)
    cab.add(inset(front["right"], (0.45, 0.88), (0.55, 0.86)), _WINDOW)
    _lamps(cab, x1 + 0.01, half, (0.6, 0.85), False, night)
    behind = 0.5 * (x0 + split)
    ahead = 0.5 * (split + 0.1 + x1)
    return [
        (load, (behind, 0.0, split - x0, width, 0.0, 0.0, height)),
        (cab, (ahead, 0.0, x1 - split - 0.1, width, 0.0, 0.0, height)),
    ]


def _lamps(solid: Solid, x: float, half: float, z: tuple[float, float], rear: bool, night: float) -> None:
    for side in (-1.0, 1.0):
        y = sorted((0.93 * side * half, 0.7 * side * half))
        shine = min(1.0, 2.0 * night)
        panel(solid, x, (y[0], y[1]), z, rear, _TAIL if rear else _LAMP, shine)


def _bus(solid: Solid, length: float, width: float, height: float, look: np.ndarray, night: float) -> None:
    half, x0, x1 = 0.5 * width, -0.5 * length, 0.5 * length
    paint, band = _pick(_TRAILERS, look[0]), _pick(_TRAILERS, look[1])
    frustum(solid, (x0 + 0.3, x1 - 0.3, 0.1), (x0 + 0.3, x1 - 0.3, 0.35), (half * 0.9, half * 0.9), {"all": _UNDER})
    body = frustum(solid, (x0, x1, 0.3), (x0 + 0.03, x1 - 0.08, height), (half, half * 0.98), {"all": paint})
    lit = 0.55 * night
    for side in ("left", "right"):
        solid.add(inset(body[side], (0.0, 1.0), (0.12, 0.3)), band)
        for pane in np.linspace(0.03, 0.87, 8):
            solid.add(inset(body[side], (float(pane), float(pane) + 0.1), (0.42, 0.84)), _WINDOW, lit)
    solid.add(inset(body["right"], (0.83, 0.92), (0.02, 0.84)), GLASS)
    solid.add(inset(body["front"], (0.04, 0.96), (0.3, 0.82)), GLASS, lit)
    solid.add(inset(body["front"], (0.2, 0.8), (0.86, 0.96)), (0.85, 0.6, 0.1), max(lit, 0.5))
    solid.add(inset(body["rear"], (0.1, 0.9), (0.5, 0.84)), GLASS, lit)
    wheels(solid, (x0 + 2.6, x1 - 2.6), half * 1.003, 0.48)
    _lamps(solid, x0 - 0.01, half, (0.75, 1.05), True, night)
    _lamps(solid, x1 + 0.01, half, (0.55, 0.75), False, night)


def _two_wheeler(solid: Solid, length: float, height: float, look: np.ndarray, night: float, motor: bool) -> None:
    """Add a two-wheeler with its rider; each wheel is a disc seen from the side and a slat seen along the road."""
    x0, x1 = -0.5 * length, 0.5 * length
    paint, coat = _pick(PAINTS, look[0]), _pick(_CLOTHES, look[1])
    radius, thick = (0.31, 0.08) if motor else (0.34, 0.025)
    for x in (x0 + radius, x1 - radius):
        box(solid, np.array([x, 0.0]), 0.0, (0.3, 2.0 * thick), (0.0, 1.9 * radius), RUBBER)
    wheels(solid, (x0 + radius, x1 - radius), thick + 0.01, radius)
    seat = 0.52 * height
    if motor:
        low, high = (x0 + 0.35, x1 - 0.45, 0.35), (x0 + 0.25, x1 - 0.6, seat)
        frustum(solid, low, high, (0.17, 0.14), {"all": paint})
    else:
        box(solid, np.array([0.0, 0.0]), 0.0, (0.6 * length, 0.05), (radius + 0.12, radius + 0.2), paint)
    handle = x1 - 0.55
    box(solid, np.array([handle, 0.0]), 0.0, (0.06, 0.56), (seat + 0.08, seat + 0.14), _UNDER)
    panel(solid, x0 + 0.1, (-0.06, 0.06), (0.55, 0.67), True, _TAIL, min(1.0, 2.0 * night))
    panel(solid, x1 - 0.3, (-0.08, 0.08), (0.7, 0.86), False, _LAMP, min(1.0, 2.0 * night) * motor)
    for side in (-1.0, 1.0):
        box(solid, np.array([0.05, 0.15 * side]), 0.0, (0.34, 0.13), (0.25, seat + 0.05), _pick(_CLOTHES, look[2]))
    shoulder = height - 0.3
    frustum(solid, (-0.28, 0.05, seat), (-0.1, 0.18, shoulder), (0.17, 0.22), {"all": coat})
    for side in (-1.0, 1.0):
        box(
            solid,
            np.array([0.3 * (handle + 0.2), 0.24 * side]),
            0.0,
            (handle + 0.05, 0.09),
            (shoulder - 0.25, shoulder - 0.12),
            coat,
        )
    _head(solid, 0.08, shoulder + 0.02, height, look, helmet=True)


def _head(solid: Solid, x: float, low: float, high: float, look: np.ndarray, helmet: bool) -> None:
    skin, hair = _pick(_SKIN, look[6]), (0.1, 0.08, 0.06) if look[7] < 0.6 else (0.4, 0.28, 0.14)
    top = _pick(_CLOTHES, look[3]) if helmet else hair
    box(solid, np.array([x, 0.0]), 0.0, (0.2, 0.17), (low, low + 0.6 * (high - low)), skin)
    box(solid, np.array([x - 0.06, 0.0]), 0.0, (0.12, 0.18), (low + 0.3 * (high - low), high), top)
    box(solid, np.array([x, 0.0]), 0.0, (0.22, 0.18), (low + 0.6 * (high - low), high), top)


def _pedestrian(solid: Solid, height: float, look: np.ndarray, pace: float) -> None:
    trousers, coat = _pick(_CLOTHES, look[0]), _pick(_CLOTHES, look[1])
    hip, shoulder = 0.48 * height, 0.83 * height
    stride = 0.16 * np.sin(2.0 * np.pi * pace)
    for side in (-1.0, 1.0):
        foot = side * stride
        low, high = (foot - 0.09, foot + 0.09, 0.0), (-0.08, 0.09, hip)
        leg = Solid()
        frustum(leg, low, high, (0.07, 0.085), {"all": trousers})
        shift = np.array([0.0, 0.095 * side, 0.0])
        solid.corners += [ring + shift for ring in leg.corners]
        solid.colours += leg.colours
        solid.light += leg.light
    for side in (-1.0, 1.0):
        box(solid, np.array([-0.5 * side * stride, 0.25 * side]), 0.0, (0.1, 0.09), (hip - 0.02, shoulder - 0.04), coat)
    frustum(solid, (-0.12, 0.12, hip), (-0.11, 0.12, shoulder), (0.17, 0.21), {"all": coat})
    _head(solid, 0.02, shoulder + 0.02, height, look, helmet=False)

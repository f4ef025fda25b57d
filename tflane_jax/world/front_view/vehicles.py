"""Polygon models of cars, trucks, buses and motorcycles of a front view."""

from __future__ import annotations

import numpy as np

from tflane_jax.scene import RoadUser
from tflane_jax.world.front_view.traffic import FrontTraffic
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import GLASS, PAINTS, RUBBER, Colour, frustum, panel, wheels

_TRAILERS: tuple[Colour, ...] = (
    (0.9, 0.9, 0.9),
    (0.8, 0.8, 0.78),
    (0.2, 0.3, 0.55),
    (0.6, 0.2, 0.15),
    (0.35, 0.4, 0.36),
)
_DETAILED = 90.0


def vehicle_solids(traffic: FrontTraffic, night: float) -> list[Solid]:
    """Return one solid for each vehicle."""
    return [_solid(traffic, number, night) for number in range(len(traffic.xy))]


def _solid(traffic: FrontTraffic, number: int, night: float) -> Solid:
    xy, yaw, size, look = traffic.xy[number], traffic.yaw[number], traffic.size[number], traffic.look[number]
    distance = float(np.hypot(*xy))
    kind, local = traffic.category[number], Solid(distance)
    detailed = distance < _DETAILED
    if kind in (RoadUser.TRUCK, RoadUser.BUS):
        _large(local, size, look, kind == RoadUser.BUS, night, detailed)
    elif kind == RoadUser.MOTORCYCLE:
        _motorcycle(local, size, look, night)
    else:
        _car(local, size, look, night, detailed)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    local.corners = [corners @ turn + [*xy, 0.0] for corners in local.corners]
    return local


def _tyres(solid: Solid, places: tuple[float, ...], half: float, radius: float, width: float) -> None:
    """Add the tyres as seen from behind and from the front."""
    for x, rear in ((min(places) - radius, True), (max(places) + radius, False)):
        for low, high in ((-half, width - half), (half - width, half)):
            panel(solid, x, (low, high), (0.0, radius), rear, RUBBER)


def _lights(
    solid: Solid,
    x: tuple[float, float],
    half: float,
    z: float,
    size: tuple[float, float],
    night: float,
    brake: bool = False,
) -> None:
    """Add lamps at the rear (x[0]) and at the front (x[1])."""
    w, h = size
    shine = max(0.9 * min(1.0, 2.0 * night), 0.9 * brake)
    for side in (-1.0, 1.0):
        y = sorted((side * half * 0.96, side * (half * 0.96 - w)))
        panel(solid, x[0], (y[0], y[1]), (z, z + h), True, (0.75, 0.08, 0.06), shine)
        bright = min(1.0, 2.0 * night)
        panel(solid, x[1], (y[0], y[1]), (z - 0.1, z - 0.1 + 0.7 * h), False, (0.95, 0.95, 0.88), bright)


def _car(solid: Solid, size: np.ndarray, look: np.ndarray, night: float, detailed: bool) -> None:
    length, width, height = size
    body = PAINTS[int(look[0] * len(PAINTS))]
    dark: Colour = (0.5 * body[0] + 0.03, 0.5 * body[1] + 0.03, 0.5 * body[2] + 0.03)
    half, x0, x1 = 0.5 * width, -0.5 * length, 0.5 * length
    # Hatchbacks and vans end in their cabin, saloons in a boot.
    boot = 0.16 * length * (look[1] < 0.5)
    belt = (0.58 + 0.04 * look[2]) * height
    sill = 0.17 * height
    axles = (x0 + 0.18 * length, x1 - 0.18 * length)
    if detailed:
        _tyres(solid, axles, half * 0.97, 0.31, 0.2)
    panel(solid, x0 + 0.1, (-half * 0.9, half * 0.9), (0.12, sill + 0.05), True, (0.05, 0.05, 0.05))
    frustum(solid, (x0, x1, sill), (x0 + 0.04, x1 - 0.12, belt), (half, half * 0.96), {"all": body})
    roof0, roof1 = x0 + boot + 0.05 * length + 0.12, x1 - 0.42 * length
    cabin = {"all": GLASS, "top": body}
    frustum(
        solid, (x0 + boot + 0.02, x1 - 0.24 * length, belt), (roof0, roof1, height), (half * 0.94, half * 0.74), cabin
    )
    if not detailed:
        return
    wheels(solid, axles, half * 1.004, 0.31)
    # Bumper, plate, grille.
    panel(solid, x0 - 0.01, (-half * 0.97, half * 0.97), (sill, 0.3 * height), True, dark)
    panel(solid, x0 - 0.02, (-0.26, 0.26), (0.36 * height, 0.43 * height), True, (0.8, 0.8, 0.75))
    panel(solid, x1 + 0.01, (-half * 0.7, half * 0.7), (sill, 0.38 * height), False, (0.07, 0.07, 0.07))
    _lights(solid, (x0 - 0.02, x1 + 0.02), half, 0.45 * height, (0.34, 0.1 * height), night, look[3] < 0.25)


def _large(solid: Solid, size: np.ndarray, look: np.ndarray, bus: bool, night: float, detailed: bool) -> None:
    length, width, height = size
    body = _TRAILERS[int(look[0] * len(_TRAILERS))]
    half, x0, x1 = 0.5 * width, -0.5 * length, 0.5 * length
    floor = 0.35 if bus else 0.95
    axles = (x0 + 1.6, x1 - 1.5) if bus else (x0 + 1.1, x0 + 2.2, x1 - 1.2)
    _tyres(solid, axles, half * 0.98, 0.5, 0.5)
    wheels(solid, axles, half * 0.99, 0.5)
    if not bus:
        tail, nose = x0 + 0.3, x1 - 0.3
        frustum(solid, (tail, nose, 0.5), (tail, nose, floor), (half * 0.6, half * 0.6), {"all": RUBBER})
        panel(solid, x0 + 0.1, (-half * 0.95, half * 0.95), (0.45, 0.62), True, (0.2, 0.2, 0.2))
    cab = x1 if bus else x1 - 2.1
    frustum(solid, (x0, cab, floor), (x0, cab, height), (half, half), {"all": body})
    if not bus:
        paint = PAINTS[int(look[1] * len(PAINTS))]
        top = (cab + 0.2, x1 - 0.1, 0.85 * height)
        frustum(solid, (cab + 0.2, x1, 0.4), top, (half * 0.97, half * 0.95), {"all": paint})
    panel(solid, x1 + 0.01, (-half * 0.88, half * 0.88), (0.48 * height, 0.78 * height), False, GLASS)
    if bus:
        panel(solid, x0 - 0.01, (-half * 0.85, half * 0.85), (0.55 * height, 0.85 * height), True, GLASS)
        for side in (-1.0, 1.0):
            y, z0, z1 = side * half * 1.003, 0.45 * height, 0.78 * height
            band = np.array([(x0 + 0.4, y, z0), (x1 - 0.3, y, z0), (x1 - 0.3, y, z1), (x0 + 0.4, y, z1)])
            solid.add(band if side < 0 else band[::-1], GLASS)
    elif detailed:
        for y in (-0.02, half - 0.06, -half + 0.02):
            panel(solid, x0 - 0.01, (y, y + 0.04), (floor, height), True, (0.3, 0.3, 0.3))
    _lights(solid, (x0 - 0.02, x1 + 0.02), half, 0.7, (0.3, 0.16), night)


def _motorcycle(solid: Solid, size: np.ndarray, look: np.ndarray, night: float) -> None:
    length, _, height = size
    paint = PAINTS[int(look[0] * len(PAINTS))]
    x0, x1 = -0.5 * length, 0.5 * length
    frustum(solid, (x0, x1, 0.0), (x0 + 0.1, x1 - 0.1, 0.65), (0.08, 0.08), {"all": RUBBER})
    frustum(solid, (x0 + 0.3, x1 - 0.4, 0.5), (x0 + 0.3, x1 - 0.5, 0.9), (0.18, 0.14), {"all": paint})
    jacket = PAINTS[int(look[1] * len(PAINTS))]
    frustum(solid, (-0.3, 0.1, 0.8), (-0.1, 0.2, height - 0.28), (0.17, 0.24), {"all": jacket})
    frustum(solid, (-0.05, 0.2, height - 0.28), (-0.05, 0.2, height), (0.12, 0.12), {"all": (0.1, 0.1, 0.1)})
    panel(solid, x0 + 0.2, (-0.08, 0.08), (0.7, 0.82), True, (0.75, 0.08, 0.06), min(1.0, 2.0 * night))

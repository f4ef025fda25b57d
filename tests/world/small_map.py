"""A crossroads as a recorded map: four arms of 150 m, one lane in each direction, on the axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.world.presets import REAL_MAPS
from tflane_jax.world.roads.road_map import RoadMap

ARM, HALF, NEAR = 150.0, 1.75, 12.0
# Arms in the order east, north, west, south: the direction from the middle outwards.
OUT = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], float)
# A short scene on a recorded map, seen as it is.
ON_MAP = replace(
    REAL_MAPS,
    traffic=replace(REAL_MAPS.traffic, ego_passes_s=3.0, early_s=30.0, variety=0.0),
    duration_s=5.0,
    keyframes=2,
    mirrored=0.0,
)


def right_of(direction):
    return np.array([direction[1], -direction[0]])


def inward(arm):
    """Return the id of the lane that leads to the middle on an arm; `outward` that of the other one."""
    return 10 + arm


def outward(arm):
    return 20 + arm


def connector(arm, target):
    return 100 + 10 * arm + target


def curve(start, ahead, stop, after):
    """Return points of a cubic Bezier curve between two poses."""
    reach = 0.5 * np.linalg.norm(stop - start)
    t = np.linspace(0.0, 1.0, 12)[:, None]
    a, b, c, d = start, start + reach * ahead, stop - reach * after, stop
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d


def crossroads(*, arm=ARM, split=0.0):
    """Return the map; with `split`, the lanes that lead to the middle are two segments (ids 30 to 33 before)."""
    lanes = []
    for k, out in enumerate(OUT):
        side = HALF * right_of(out)
        far, near = arm * out - side, NEAR * out - side
        targets = [connector(k, j) for j in range(4) if j != k]
        if split:
            middle = far + split * (near - far)
            lanes.append(segment(30 + k, [far, 0.5 * (far + middle), middle], [inward(k)]))
            far = middle
        lanes.append(segment(inward(k), [far, 0.5 * (far + near), near], targets))
        lanes.append(segment(outward(k), [NEAR * out + side, 0.5 * (NEAR + arm) * out + side, arm * out + side]))
        for j, away in enumerate(OUT):
            if j != k:
                line = curve(near, -out, NEAR * away + HALF * right_of(away), away)
                lanes.append(segment(connector(k, j), line, [outward(j)], is_intersection=True))
    kerbs = []
    for k, out in enumerate(OUT):
        # Around the block between this arm and the next one, with the road on the right.
        away = OUT[(k + 1) % 4]
        kerbs.append(np.array([arm * out + 6 * away, 6 * out + 6 * away, 6 * out + arm * away]))
    crossing = np.array([[9.0, -6.0], [9.0, 6.0], [11.5, 6.0], [11.5, -6.0], [9.0, -6.0]])
    flat = [np.pad(line, ((0, 0), (0, 1))) for line in kerbs]
    vector_map = lane_map(*lanes, road_boundaries=tuple(flat), crossings=(np.pad(crossing, ((0, 0), (0, 1))),))
    places = np.stack([np.linspace(-40.0, 40.0, 41), np.zeros(41)], -1)
    return RoadMap("crossroads", "test", vector_map, places, complete=arm - 50.0)

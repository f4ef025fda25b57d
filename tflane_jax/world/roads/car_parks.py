"""Car parks: rows of vehicles on the plots beside a street. Their ways to the road are not part of the map.

Most vehicles that stand in recorded logs stand off the lanes, 4 to 20 m from the nearest centerline.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import wrap_angle
from tflane_jax.world.roads.config import RoadConfig
from tflane_jax.world.roads.curves import arc_length, cross, direction, points_at, right_of
from tflane_jax.world.roads.site import Site

# Number of places in a row, their width, and the distance of their middles from the kerb, metres.
_PLACES, _WIDTH, _BEHIND = (3, 10), 2.7, (6.0, 12.0)
# The middle of a place is no nearer than this to any kerb, and to the edge of a driveway, metres.
_CLEAR_OF_KERB, _CLEAR_OF_DRIVEWAY = 5.0, 4.5
# Kerbs are compared by points so far apart, metres.
_SPACING = 1.0


def draw_car_parks(rng: np.random.Generator, site: Site, config: RoadConfig) -> Float[np.ndarray, "p 3"]:
    """Return x, y and yaw of the places in rows behind the kerbs; those without room are left out.

    Args:
        rng: stream.
        site: with its kerbs and driveways.
        config: its `car_parks` is used.
    """
    from scipy.spatial import KDTree

    rows = [_rows(rng, kerb, config.car_parks) for kerb in site.kerbs]
    places = np.concatenate([np.zeros((0, 3)), *rows])
    lines = [points_at(kerb, np.arange(0.0, arc_length(kerb)[-1], _SPACING)) for kerb in site.kerbs]
    if not len(places):
        return places
    points = np.concatenate([line[:-1] for line in lines])
    steps = np.concatenate([np.diff(line, axis=0) for line in lines])
    distance, nearest = map(np.asarray, KDTree(points).query(places[:, :2]))
    # The road is on the left of every kerb: a place on its right is on a plot.
    free = (distance > _CLEAR_OF_KERB) & (cross(steps[nearest], places[:, :2] - points[nearest]) < 0.0)
    if site.driveways:
        edges = np.concatenate(
            [points_at(d.edge, np.arange(0.0, arc_length(d.edge)[-1], _SPACING)) for d in site.driveways]
        )
        free &= np.asarray(KDTree(edges).query(places[:, :2])[0]) > _CLEAR_OF_DRIVEWAY
    places = places[free]
    # Rows behind two kerbs of one corner may meet.
    close = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=-1) < 2.0 * _WIDTH
    other = np.abs(wrap_angle(2.0 * (places[:, None, 2] - places[None, :, 2]))) > 1e-6
    return places[~np.triu(close & other, 1).any(0)]


def _rows(rng: np.random.Generator, kerb: Float[np.ndarray, "n 2"], density: float) -> Float[np.ndarray, "p 3"]:
    """Return the places behind one kerb, `density` rows on 100 m of it; vehicles point to the kerb or away from it."""
    length = arc_length(kerb)[-1]
    found, last = [np.zeros((0, 3))], 0.0
    for start in np.sort(rng.uniform(0.0, length, rng.poisson(density * length / 100.0))).tolist():
        number, behind = int(rng.integers(*_PLACES, endpoint=True)), rng.uniform(*_BEHIND)
        turned = rng.random(number) < 0.5
        if start < last or start + number * _WIDTH > length:
            continue
        a, b = points_at(kerb, np.array([start, start + number * _WIDTH]))
        heading = float(np.arctan2(*(b - a)[::-1]))
        along = (np.arange(number)[:, None] + 0.5) * _WIDTH * direction(heading)
        yaw = wrap_angle(heading - 0.5 * np.pi + np.pi * turned)
        found.append(np.concatenate([a + along + behind * right_of(heading), yaw[:, None]], -1))
        last = start + number * _WIDTH
    return np.concatenate(found)

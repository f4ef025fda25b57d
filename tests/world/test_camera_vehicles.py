"""Bodies of road users: extent, variety, orientation of faces."""

import numpy as np
import pytest

from tflane_jax.scene import RoadUser
from tflane_jax.world.cameras.solids import pack
from tflane_jax.world.cameras.vehicles import road_user
from tflane_jax.world.traffic.vehicles import PROFILES


def drawn(category, seed=0, pace=0.0):
    profile, rng = PROFILES[category], np.random.default_rng(seed)
    size = np.array([rng.uniform(*getattr(profile, name)) for name in ("length", "width", "height")])
    return size, road_user(category, size, rng.random(8), 0.0, pace)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("category", list(RoadUser))
def test_bodies_fill_their_box_and_stay_within_it(category, seed):
    """The drawing order of bodies depends on their boxes, and the tracker reports the same boxes."""
    size, parts = drawn(category, seed, pace=0.25)
    for solid, (x, y, length, width, yaw, low, high) in parts:
        corners = np.concatenate(solid.corners)
        assert yaw == 0.0
        # Arms and handlebars of narrow road users reach out of the box a little.
        slack = 0.06 if category <= RoadUser.BUS else 0.25
        assert (np.abs(corners[:, :2] - [x, y]) <= np.array([length, width]) / 2 + slack).all()
        assert corners[:, 2].min() >= low - 1e-9
        assert corners[:, 2].max() <= high + 0.02
    whole = np.concatenate([np.concatenate(solid.corners) for solid, _ in parts])
    assert np.ptp(whole[:, 2]) > 0.9 * size[2]
    assert np.ptp(whole[:, 0]) > (0.9 if category <= RoadUser.BICYCLE else 0.4) * size[0]


@pytest.mark.parametrize("category", list(RoadUser))
def test_vehicles_of_one_kind_vary_in_colour(category):
    colours = [np.concatenate([solid.colours for solid, _ in drawn(category, seed)[1]]) for seed in range(6)]
    assert len({array.tobytes() for array in colours}) > 1


@pytest.mark.parametrize("category", list(RoadUser))
def test_outer_faces_look_outwards(category):
    """Polygons of a convex body face outwards: the body's middle lies behind each plane."""
    _, parts = drawn(category)
    for solid, box in parts:
        bodies = pack([solid], [box])
        starts = bodies.stops - np.diff(bodies.stops, prepend=0)
        a = bodies.corners[starts]
        normal = np.cross(bodies.corners[starts + 1] - a, bodies.corners[starts + 2] - a)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        middle = np.array([box[0], box[1], 0.5 * box[6]])
        outwards = ((middle - a) * normal).sum(-1) < 0.05
        assert outwards.mean() > (0.9 if category <= RoadUser.BUS else 0.5)

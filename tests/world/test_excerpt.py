"""Which part of a drive a scene shows, and where its key frames are."""

from dataclasses import replace

import numpy as np
import pytest

from tests.world.lane_following import fractions_on_lanes
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example
from tflane_jax.world import simulate as simulation
from tflane_jax.world.excerpt import excerpt, on_connector
from tflane_jax.world.presets import REAL_LIKE
from tflane_jax.world.roads.config import SceneKind
from tflane_jax.world.roads.networks import build_road_network
from tflane_jax.world.simulate import WorldConfig, simulate
from tflane_jax.world.traffic.signals import Signals
from tflane_jax.world.traffic.simulation import Traffic

FOUR_WAY = replace(WorldConfig().roads, kinds=((SceneKind.FOUR_WAY, 1.0),))
LONGER = replace(REAL_LIKE, mirrored=0.0)
HISTORY = 100


def drive(frames: int, positions: np.ndarray, on_route: int = 10_000) -> Traffic:
    """Two road users, one of them present in the first ten frames only, and an ego vehicle at given positions."""
    present = np.stack([np.ones(frames, bool), np.arange(frames) < 10], 1)
    xy = np.arange(frames * 4, dtype=float).reshape(frames, 2, 2)
    signals = Signals(np.array([[9.0, 12.0]]), np.array([2.0]))
    ego = np.pad(positions, ((0, 0), (0, 1)))
    return Traffic(
        xy, xy[..., 0], present, np.arange(6.0).reshape(2, 3), np.array([0, 5]), ego, on_route, signals, frames
    )


@pytest.fixture(scope="module")
def roads():
    return build_road_network(np.random.default_rng(3), FOUR_WAY).traffic_lanes


def through(roads, frames: int, first: int, last: int) -> np.ndarray:
    """Positions far away, but on a connector from frame `first` to `last`."""
    lane = next(s for s in roads.values() if s.is_intersection)
    xy = np.full((frames, 2), 1e4)
    xy[first : last + 1] = lane.centerline[len(lane.centerline) // 2, :2]
    return xy


def test_places_on_connectors(roads):
    lanes = list(roads.values())
    middles = np.stack([s.centerline[len(s.centerline) // 2, :2] for s in lanes])
    found = on_connector(roads, middles)
    assert found[[s.is_intersection for s in lanes]].mean() > 0.9  # connectors of bicycles and vehicles may cross
    assert not found[[not s.is_intersection for s in lanes]].any()
    assert on_connector(roads, np.zeros((0, 2))).shape == (0,)
    assert not on_connector({}, middles).any()


def test_an_excerpt_is_frames_in_a_row_and_lights_keep_their_time(roads):
    whole = drive(60, through(roads, 60, 40, 41))
    shown = excerpt(np.random.default_rng(0), roads, whole, frames=20, history=5, rate_hz=10.0)
    (start,) = (i for i in range(41) if np.array_equal(whole.ego[i : i + 20], shown.ego))
    assert start > 10
    np.testing.assert_array_equal(shown.xy, whole.xy[start : start + 20, :1])  # the other one has left
    assert (shown.category.tolist(), len(shown.size)) == ([0], 1)
    times = np.arange(20) / 10.0
    np.testing.assert_array_equal(shown.signals.shown(times), whole.signals.shown(times + start / 10.0))


def test_most_excerpts_show_the_vehicle_on_the_connector_after_their_history(roads):
    whole = drive(200, through(roads, 200, 120, 123))
    starts = []
    for seed in range(40):
        shown = excerpt(np.random.default_rng(seed), roads, whole, frames=60, history=20, rate_hz=10.0)
        starts.append(int(shown.xy[0, 0, 0]) // 4)
    inside = [start + 20 <= 123 and start + 60 > 120 for start in starts]
    assert 0.5 < np.mean(inside) < 1.0
    assert np.ptp(starts) > 20


@pytest.mark.parametrize(("first", "last", "on_route"), [(0, 19, 100), (1, 0, 100), (80, 90, 75), (30, 40, 50)])
def test_the_first_part_is_shown_where_the_route_crosses_nothing_after_the_history(roads, first, last, on_route):
    whole = drive(100, through(roads, 100, first, last), on_route)
    shown = excerpt(np.random.default_rng(1), roads, whole, frames=60, history=20, rate_hz=10.0)
    np.testing.assert_array_equal(shown.ego, whole.ego[:60])
    assert shown.on_route == min(on_route, 60)


def test_the_vehicle_stays_on_its_route(roads):
    whole = drive(200, through(roads, 200, 80, 100), on_route=103)
    shown = [excerpt(np.random.default_rng(s), roads, whole, frames=60, history=20, rate_hz=10.0) for s in range(20)]
    starts = [int(one.xy[0, 0, 0]) // 4 for one in shown]
    assert max(starts) == 43
    assert {one.on_route for one in shown} == {60}


def test_a_longer_drive_is_seen_inside_junctions_more_often():
    usual, longer = (
        [simulate(scene, world, HISTORY) for scene in range(5)] for world in (replace(LONGER, longer_s=0.0), LONGER)
    )
    fractions = []
    for logs in (usual, longer):
        places = [(log.map.segments, np.stack([k.global_from_ego[:2, 3] for k in log.keyframes])) for log in logs]
        fractions.append(np.mean([on_connector(*place).mean() for place in places]))
        assert {len(log.timestamps_ns) for log in logs} == {LONGER.frames}
        assert {log.keyframes[0].track_frame for log in logs} == {HISTORY}
    assert fractions[1] > fractions[0] + 0.1


@pytest.mark.parametrize("scene", [1, 9, 33])
def test_an_excerpt_shows_a_junction_and_no_border_of_the_roads(scene):
    """The map of these scenes has access roads near the end of the drive."""
    log = simulate(scene, LONGER, HISTORY)
    middle = np.stack([moment.global_from_ego[:2, 3] for moment in log.keyframes])
    assert np.hypot(*middle.T).max() < LONGER.roads.reach - 56.0


def test_an_excerpt_is_a_scene_like_any_other():
    log = simulate(6, LONGER, HISTORY)
    found = fractions_on_lanes(log)
    assert len(found) >= 3
    assert found.min() > 0.9
    make_example(log, 1, ExampleConfig()).validate()


@pytest.mark.parametrize("spacing", ["time", "distance"])
def test_spacing_of_key_frames(spacing):
    """Ten frames waiting, then eleven in motion, 1 m each."""
    xy = np.stack([np.concatenate([np.zeros(10), np.arange(11.0)]), np.zeros(21)], 1)
    found = simulation._spaced(xy, WorldConfig(keyframes=3, keyframe_spacing=spacing))
    assert found.tolist() == {"time": [0, 10, 20], "distance": [0, 15, 20]}[spacing]


@pytest.mark.parametrize("xy", [np.zeros((4, 2)), np.eye(4, 2) * 100, np.repeat([[0.0, 0.0], [50.0, 0.0]], 2, 0)])
def test_key_frames_are_different_and_in_order(xy):
    for count in range(1, 5):
        found = simulation._spaced(xy, WorldConfig(keyframes=count, keyframe_spacing="distance"))
        assert len(found) == count
        assert (np.diff(found) > 0).all()
        assert found.min() >= 0
        assert found.max() < 4

"""SD maps of the built-in world: places of lines, errors, and independence of the rest of a scene."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, log, segment, tracks
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.examples import make_example
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, arc_length, yaw_pose
from tflane_jax.scene import SdCategory, SdMap
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.networks import build_road_network
from tflane_jax.world.roads.sd_map import (
    SdMapConfig,
    gnss_error,
    make_sd_map,
    pack_lines,
    survey_error,
)

EXACT = SdMapConfig(tolerance=0.0, survey=0.0)


def network(kind, seed=0):
    return build_road_network(np.random.default_rng(seed), RoadConfig(kinds=((kind, 1.0),)))


def log_on(vector_map, pose, *, seed=5, frames=1):
    return log(
        vector_map, tracks(np.zeros((frames, 0, 3))), [pose] * frames, [(k, pose) for k in range(frames)], seed=seed
    )


def distance_to(points, line):
    """Return how far points (k, 2) are from a polyline (n, 2), by brute force over its segments."""
    a, b = line[:-1, None], line[1:, None]
    along = b - a
    fraction = ((points[None] - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
    return np.linalg.norm(points[None] - a - np.clip(fraction, 0, 1)[..., None] * along, axis=-1).min(0)


@pytest.mark.parametrize("kind", list(SceneKind))
@pytest.mark.parametrize("seed", [0, 1])
def test_roads_lie_among_their_lanes(kind, seed):
    """Midway between kerbs: never farther from the nearest lane than half a median and a lane or a turning lane."""
    map_ = network(kind, seed).map
    assert map_.roads
    lanes = [s.centerline[:, :2] for s in map_.segments.values()]
    for road in map_.roads:
        near = np.min([distance_to(road[:, :2], lane) for lane in lanes], axis=0)
        assert near.max() < 6.5
        assert (np.diff(arc_length(road)) > 0).all()


@pytest.mark.parametrize("kind", [SceneKind.FOUR_WAY, SceneKind.T_JUNCTION, SceneKind.TWO_JUNCTIONS])
def test_roads_that_meet_end_at_one_point(kind):
    roads = network(kind).map.roads
    ends, counts = np.unique(np.concatenate([road[[0, -1], :2] for road in roads]), axis=0, return_counts=True)
    assert (counts > 2).sum() == (2 if kind is SceneKind.TWO_JUNCTIONS else 1)
    assert set(counts[counts < 3]) == {1}
    assert len(ends) == len(counts)


def test_a_roundabout_is_a_closed_line_that_the_others_reach():
    *arms, ring = network(SceneKind.ROUNDABOUT).map.roads
    np.testing.assert_array_equal(ring[0], ring[-1])
    assert len(arms) >= 3
    assert max(distance_to(np.stack([arm[0, :2] for arm in arms]), ring[:, :2])) < 0.1


STRAIGHT = replace(
    lane_map(segment(0, [(900.0, -2000.0), (1100.0, -2000.0)])),
    roads=(np.array([[900.0, -2000.0, 0.0], [1100.0, -2000.0, 0.0]]),),
    crossings=(np.array([[1010, -2003, 0], [1010, -1997, 0], [1014, -1997, 0], [1014, -2003, 0], [1010, -2003, 0.0]]),),
)
POSE = yaw_pose(1000.0, -1999.0, 0.0)


def test_a_map_without_faults_is_the_road():
    sd_map, dropped = make_sd_map(log_on(STRAIGHT, POSE), 0, EXACT)
    sd_map.validate()
    assert dropped == 0
    assert sd_map.valid.tolist() == [True, True] + [False] * 22
    assert sd_map.category[:2].tolist() == [SdCategory.ROAD, SdCategory.CROSSWALK]
    assert sd_map.points.dtype == np.float32
    expected = np.stack([np.linspace(-51.2, 51.2, 11), np.full(11, -1.0)], -1)
    np.testing.assert_allclose(sd_map.points[0], expected, atol=1e-5)
    np.testing.assert_allclose(sd_map.points[1], np.stack([np.full(11, 12.0), np.linspace(-4, 2, 11)], -1), atol=1e-5)
    roads, _ = make_sd_map(log_on(STRAIGHT, POSE), 0, replace(EXACT, crossings="exclude"))
    assert roads.category[roads.valid].tolist() == [SdCategory.ROAD]


def test_an_error_of_the_receiver_moves_the_whole_map():
    """Two vehicles with one error see one shift in global axes, whatever their headings are."""
    config = replace(EXACT, translation=2.0, yaw_deg=3.0, range=PerceptionRange((-500, 500), (-500, 500)))
    dx, dy, turn = gnss_error(5, 0.0, config)
    assert min(abs(dx), abs(dy)) > 0.01
    for yaw in (0.0, 2.0):
        pose = yaw_pose(1000.0, -1999.0, yaw)
        sd_map, _ = make_sd_map(log_on(STRAIGHT, pose), 0, config)
        believed = yaw_pose(1000.0 + dx, -1999.0 + dy, yaw + turn)
        back = sd_map.points[0] @ believed[:2, :2].T + believed[:2, 3]
        np.testing.assert_allclose(back, np.stack([np.linspace(900, 1100, 11), np.full(11, -2000.0)], -1), atol=1e-3)


def test_errors_have_their_standard_deviations_at_all_times_and_drift_slowly():
    config = SdMapConfig(translation=3.0, yaw_deg=2.0, drift_s=30.0)
    sigma = np.array([3.0, 3.0, np.deg2rad(2.0)])
    now, soon, later = (np.array([gnss_error(seed, t, config) for seed in range(2000)]) for t in (0.0, 0.5, 30.0))
    for errors in (now, soon, later):
        np.testing.assert_allclose(errors.std(0), sigma, rtol=0.06)
        assert (np.abs(errors.mean(0)) < 0.1 * sigma).all()
    assert (np.abs(soon - now).std(0) < 0.05 * sigma).all()
    # After `drift_s` nothing of the first error is left.
    assert np.abs([np.corrcoef(now[:, i], later[:, i])[0, 1] for i in range(3)]).max() < 0.08
    assert not gnss_error(7, 3.0, SdMapConfig()).any()


def test_survey_errors_are_large_but_smooth():
    points = np.random.default_rng(0).uniform(-100, 100, (200, 2))
    errors = np.stack([survey_error(points, seed) for seed in range(200)])
    np.testing.assert_allclose(errors.std((0, 1)), 1.0, rtol=0.1)
    nearby = np.stack([survey_error(points + 0.7, seed) for seed in range(200)])
    assert (nearby - errors).std() < 0.1
    # The error of a place does not depend on the other places of the query.
    np.testing.assert_allclose(survey_error(points[:3], 4), survey_error(points, 4)[:3], atol=1e-12)


def test_same_seed_same_bits_another_seed_another_map():
    config = SdMapConfig(translation=1.0, yaw_deg=1.0)
    make = lambda seed, k: make_sd_map(log_on(STRAIGHT, POSE, seed=seed, frames=2), k, config)[0]  # noqa: E731
    later, first = make(5, 1), make(5, 0)
    jax.tree.map(np.testing.assert_array_equal, first, make(5, 0))
    jax.tree.map(np.testing.assert_array_equal, later, make(5, 1))
    assert 0 < np.abs(later.points - first.points).max() < 0.2
    assert np.abs(make(6, 0).points - first.points).max() > 0.2


def test_beyond_capacity_the_nearest_pieces_stay_in_order():
    range_ = PerceptionRange((-10, 10), (-10, 10))
    # The first line leaves the range and comes back.
    lines = [
        np.array([[-9, 9], [-9, 12], [-7, 12], [-7, 9.0]]),
        np.array([[-20, 20], [20, 20.0]]),
        np.array([[1, 0], [2, 0.0]]),
        np.array([[5, 0], [30, 0.0]]),
    ]
    sd_map, dropped = pack_lines(lines, [0, 1, 2, 3], capacity=3, points=2, range_=range_)
    assert dropped == 1
    assert sd_map.category.tolist() == [0, 2, 3]
    np.testing.assert_allclose(sd_map.points, [[[-7, 10], [-7, 9]], [[1, 0], [2, 0]], [[5, 0], [10, 0]]])
    empty, dropped = pack_lines(lines, [0, 1, 2, 3], capacity=0, points=2, range_=range_)
    assert (empty.points.shape, dropped) == ((0, 2, 2), 4)
    nothing, dropped = pack_lines([], [], capacity=2, points=2, range_=range_)
    jax.tree.map(np.testing.assert_array_equal, nothing, SdMap.empty(2, 2))
    assert dropped == 0


def test_the_nearest_piece_is_the_one_whose_line_passes_nearest():
    """Regression: its points decided, and those of a long road are far apart."""
    road, walk = np.array([[-45.0, 0.0], [40.0, 0.5]]), np.array([[-10.0, 2.0], [10.0, 2.0]])
    sd_map, dropped = pack_lines([road, walk], [0, 1], capacity=1, points=11, range_=PerceptionRange())
    assert (sd_map.category.tolist(), dropped) == ([0], 1)


def test_examples_have_the_map_and_are_otherwise_as_they_were():
    recording = log_on(STRAIGHT, POSE)
    config = ExampleConfig(sd_map=SdMapConfig(lines=3))
    with_map, without = make_example(recording, 0, config), make_example(recording, 0, ExampleConfig())
    with_map.validate()
    assert without.sd_map is None
    assert with_map.sd_map.valid.tolist() == [True, True, False]
    jax.tree.map(np.testing.assert_array_equal, with_map.replace(sd_map=None), without)
    with pytest.warns(TruncationWarning, match=r"ExampleConfig\.sd_map\.lines = 1"):
        make_example(recording, 0, ExampleConfig(sd_map=SdMapConfig(lines=1)))
    with pytest.raises(UserError, match="test small knows lanes but no roads"):
        make_example(log_on(replace(STRAIGHT, roads=()), POSE), 0, config)

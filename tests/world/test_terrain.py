"""Hilly ground: heights of the map, vehicles on the slope, and what cameras see of it."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.procedural import HILLS_EXAMPLE
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, pose_yaw, transform_points, yaw_pose
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.scene.terrain import Terrain
from tflane_jax.world.cameras.light import look
from tflane_jax.world.cameras.solids import pack
from tflane_jax.world.cameras.surface import Surface, surface_at
from tflane_jax.world.moving import with_vertices
from tflane_jax.world.render.camera import PinholeCamera, camera_pose
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.simulate import WorldConfig, simulate
from tflane_jax.world.terrain import TerrainConfig

# A hill of 4 m, 60 m wide, along x.
HILL = Terrain(np.array([[2 * np.pi / 60, 0.0]]), np.array([0.0]), np.array([2.0]))
FLAT = replace(HILL, amplitude=np.zeros(1))
WORLD = WorldConfig(duration_s=2.4, keyframes=2)
CAMERA = PinholeCamera(48, 32, np.array([[30.0, 0, 24], [0, 30, 14], [0, 0, 1]]), camera_pose(1.6, 0.05))


@pytest.fixture(scope="module")
def log():
    return simulate(5, replace(WORLD, terrain=TerrainConfig(grade=0.08)), history=20)


def test_the_slope_is_that_of_the_height():
    terrain = TerrainConfig(grade=0.06).draw(np.random.default_rng(0))
    xy = np.random.default_rng(1).uniform(-500, 500, (4000, 2))
    for axis, step in enumerate(np.eye(2) * 1e-3):
        change = (terrain.height(xy + step) - terrain.height(xy - step)) / 2e-3
        np.testing.assert_allclose(terrain.slope(xy)[:, axis], change, atol=1e-7)
    assert np.sqrt((terrain.slope(xy) ** 2).sum(-1).mean()) == pytest.approx(0.06, rel=0.15)


def test_a_vehicle_stands_on_the_ground_with_its_heading():
    xy, yaw = np.array([[3.0, 8.0], [20.0, -1.0]]), np.array([0.7, -2.0])
    pose = HILL.pose(xy, yaw)
    np.testing.assert_allclose(
        pose[:, :3, :3] @ pose[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (2, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(pose_yaw(pose), yaw)
    # A decimetre ahead and to the left, it is still on the ground.
    for ahead in ([0.1, 0, 0], [0, 0.1, 0]):
        there = transform_points(pose, np.array([[ahead]]))[:, 0]
        np.testing.assert_allclose(there[:, 2], HILL.height(there[:, :2]), atol=1e-3)


def test_hills_change_nothing_but_heights(log):
    level, terrain = simulate(5, WORLD, history=20), log.relief.terrain
    assert level.relief is None
    np.testing.assert_array_equal(log.relief.level.tracks.position, level.tracks.position)
    np.testing.assert_allclose(log.global_from_ego[:, :2, 3], level.global_from_ego[:, :2, 3])
    assert np.ptp(log.global_from_ego[:, 2, 3]) > 0.05
    assert [m.timestamp_ns for m in log.keyframes] == [m.timestamp_ns for m in level.keyframes]
    for number, lane in log.map.segments.items():
        np.testing.assert_allclose(lane.left[:, 2], terrain.height(lane.left[:, :2]))
        assert {tuple(p) for p in level.map.segments[number].left[:, :2]} <= {tuple(p) for p in lane.left[:, :2]}
    there = log.actors.valid
    boxes = [transform_points(x.global_from_ego, x.actors.position)[there] for x in (log, level)]
    np.testing.assert_allclose(boxes[0][:, :2], boxes[1][:, :2], atol=1e-9)
    # They stand on the ground: the center of a box is half its height above.
    np.testing.assert_allclose(boxes[0][:, 2] - terrain.height(boxes[0][:, :2]), boxes[1][:, 2], atol=1e-9)
    turned = np.abs(np.sin(log.actors.yaw - level.actors.yaw))[there]
    assert 0.0 < turned.max() < 0.02


def test_examples_have_heights_against_the_tilted_vehicle(log):
    example = make_example(log, 1, HILLS_EXAMPLE)
    points = example.lanes.points[example.lanes.valid]
    ground = transform_points(log.keyframes[1].global_from_ego, points.reshape(-1, 3).astype(float))
    # Between the vertices of a lane the ground bends by millimetres.
    np.testing.assert_allclose(ground[:, 2], log.relief.terrain.height(ground[:, :2]), atol=0.05)
    assert np.ptp(points[..., 2]) > 0.3
    near = points[np.linalg.norm(points[..., :2], axis=-1) < 5]
    assert np.abs(near[:, 2]).max() < 0.1
    with pytest.raises(UserError, match="fiducial markers are simulated on level ground only"):
        make_example(log, 1, replace(HILLS_EXAMPLE, markers=MarkerConfig()))


def test_lines_get_the_same_vertices_in_both_directions():
    line = np.array([[0.0, 0, 0], [9, 0, 0], [9, 2, 0]])
    np.testing.assert_allclose(with_vertices(line)[:, 0], [0, 3, 6, 9, 9])
    np.testing.assert_allclose(with_vertices(line[::-1]), with_vertices(line)[::-1])
    assert len(with_vertices(line[:1])) == 1


def surface(terrain, x=0.0):
    pose = terrain.pose(np.array([x, 0.0]), np.array(0.0))
    ground = yaw_pose(x, 0.0, 0.0)
    above = ground.copy()
    above[2, 3] = pose[2, 3]
    return Surface(terrain, ground, invert_pose(pose) @ above)


def test_on_level_ground_a_pixel_sees_what_it_saw():
    ours, plain = surface(FLAT).look(CAMERA), look(CAMERA)
    np.testing.assert_allclose(ours.elevation, plain.elevation, atol=1e-5)
    near = ours.distance < 60
    rows = slice(ours.first_row - plain.first_row, None)
    assert near.sum() > 300
    for name in ("x", "y"):
        np.testing.assert_allclose(getattr(ours, name)[near], getattr(plain, name)[rows][near], rtol=2e-3, atol=0.01)


@pytest.mark.parametrize("x", [0.0, 8.0, 22.0])
def test_a_pixel_of_the_ground_shows_the_point_that_is_drawn_there(x):
    """Uphill, before the crest, and downhill; bodies and ground move alike."""
    hill = surface(HILL, x)
    view = hill.look(CAMERA)
    rows, columns = np.nonzero((view.seen > 0) & (view.distance < 80))
    assert len(rows) > 100
    level = np.column_stack([view.x[rows, columns], view.y[rows, columns], np.zeros(len(rows))])
    pixels, depth = CAMERA.image_of(hill.raised(level.astype(float)))
    expected = np.column_stack([columns, rows + view.first_row]) + 0.5
    assert (depth > 0.0).all()
    np.testing.assert_allclose(pixels, expected, atol=0.25)


def test_a_crest_hides_what_lies_behind():
    """From 8 m before the top of the hill, the valley behind it, 22 to 45 m ahead, is out of sight."""
    view = surface(HILL, 7.0).look(CAMERA)
    ahead = view.x[:, 23][view.seen[:, 23] > 0]
    assert ahead.min() < 6
    assert not ((ahead > 20) & (ahead < 40)).any()


def test_a_body_keeps_its_shape_and_its_box_holds_it():
    solid = Solid()
    ring = np.array([[10.0, 1, 0], [14, 1, 0], [14, 1, 2], [10, 1, 2]])
    solid.add(ring, np.ones(3))
    hill = surface(HILL, 20.0)
    moved = hill.bodies(pack([solid], [(12.0, 1.0, 4.0, 0.1, 0.0, 0.0, 2.0)]))
    np.testing.assert_allclose(moved.corners, hill.raised(ring))
    assert moved.boxes[0, 5] <= moved.corners[:, 2].min()
    assert moved.boxes[0, 6] >= moved.corners[:, 2].max()


def test_level_logs_have_no_surface(log):
    assert surface_at(log.relief.level, np.eye(4)) is None
    ground = surface_at(log, log.keyframes[0].global_from_ego)
    np.testing.assert_allclose(ground.ego_from_level[:3, 3], 0.0, atol=1e-9)


@pytest.mark.parametrize("wrong", [{"grade": 0.5}, {"wavelength": (10.0, 20.0)}, {"waves": 0}])
def test_impossible_hills_are_refused(wrong):
    with pytest.raises(UserError, match=r"terrain needs a grade from 0 to 0\.2"):
        TerrainConfig(**wrong).draw(np.random.default_rng(0))

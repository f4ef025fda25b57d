"""Drawing of front views: camera, road coordinates, stripes, solids, noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry.cameras import project
from tflane_jax.world.front_view.ground import image_columns, look_at_ground, road_coordinates
from tflane_jax.world.front_view.road import HighwayConfig, Stripe, draw_highway
from tflane_jax.world.front_view.roadside import draw_roadside
from tflane_jax.world.front_view.stripes import draw_stripe
from tflane_jax.world.front_view.traffic import FrontTraffic, ground_shadows
from tflane_jax.world.front_view.vehicles import vehicle_solids
from tflane_jax.world.front_view.views import draw_front_scene
from tflane_jax.world.render.camera import NEAR, FrontCameraConfig, camera_pose, draw_camera, lift
from tflane_jax.world.render.noise import noise_tile
from tflane_jax.world.render.polygons import Solid, draw_solids

SCENES = st.integers(0, 3 * 10**8 - 1)


@settings(max_examples=20)
@given(SCENES)
def test_the_camera_agrees_with_geometry(seed):
    camera = draw_camera(np.random.default_rng(seed), FrontCameraConfig())
    xy = np.random.default_rng(seed).uniform([5.0, -20.0], [80.0, 20.0], (30, 2))
    pixels, depth = camera.image_of(lift(xy))
    expected, expected_depth, valid = project(lift(xy), camera.intrinsics, camera.camera_from_ego)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(depth, expected_depth)
    back, seen = camera.ground_at(pixels)
    assert seen.all()
    np.testing.assert_allclose(back, xy, atol=1e-6)
    for (u, v), z in zip(pixels, depth, strict=True):
        np.testing.assert_allclose(camera.ground_depth(np.array([u]), np.array([v]), 1e4)[0, 0], z, rtol=1e-4)
    far, _ = camera.image_of(np.array([[1e7, 1e6, 0.0]]))
    np.testing.assert_allclose(camera.horizon_rows(far[:, 0]), far[:, 1], atol=1e-3)


def test_pitch_yaw_and_roll_have_their_documented_directions():
    ahead = np.array([20.0, 0.0, 1.5, 1.0])
    assert (camera_pose(1.5, 0.1) @ ahead)[1] < 0.0  # looking down, what is ahead rises in the image
    assert (camera_pose(1.5, 0.0, yaw=0.1) @ ahead)[0] > 0.0  # looking left, it moves right
    right = np.array([20.0, -5.0, 1.5, 1.0])
    assert (camera_pose(1.5, 0.0, roll=0.1) @ right)[1] < 0.0  # leaning right, the right side rises


@settings(max_examples=20)
@given(SCENES)
def test_road_coordinates_invert_the_road(seed):
    rng = np.random.default_rng(seed)
    road = draw_highway(rng, HighwayConfig(), 0.5)
    s, offset = rng.uniform(0.0, 300.0, 50), rng.uniform(-15.0, 15.0, 50)
    back_s, back_offset = road_coordinates(road.axis, road.at(s, offset))
    np.testing.assert_allclose(back_s, s, atol=0.03)
    np.testing.assert_allclose(back_offset, offset, atol=5e-3)


def test_every_pixel_knows_its_place_on_the_road():
    scene = draw_front_scene(4)
    ground = look_at_ground(scene.camera, scene.road.axis)
    row, column = 200 - ground.first_row, np.arange(0, 640, 7)
    xy, _ = scene.camera.ground_at(np.stack([column + 0.5, np.full(len(column), 200.5)], -1))
    s, offset = road_coordinates(scene.road.axis, xy)
    np.testing.assert_allclose(ground.s[row, column], s, atol=0.02)
    np.testing.assert_allclose(ground.offset[row, column], offset, atol=0.01)
    assert ground.seen[-1].all()


def test_the_road_has_its_configured_width():
    rng = np.random.default_rng(0)
    for _ in range(50):
        road = draw_highway(rng, HighwayConfig(), 1.0)
        gaps = np.diff(road.lines[:, road.axis.s >= 0.0], axis=0)
        assert (gaps > -1e-9).all()
        assert (gaps < road.lane_width + 1e-9).all()
        assert 3.3 <= road.lane_width <= 3.8
        assert 0.0 < road.ego_offset < road.lines[-1].max()
        assert (np.diff(road.edges) >= 0.0).all()
        assert all(((stripe.opacity >= 0.0) & (stripe.opacity <= 1.0)).all() for stripe in road.paint)


@pytest.mark.parametrize("period", [0.0, 6.0])
def test_a_stripe_covers_its_own_area(period):
    """Paint in a row is as wide as the stripe, also below a pixel; of dashed lines the painted fraction is filled."""
    scene = draw_front_scene(2)
    camera, road = scene.camera, scene.road
    ground = look_at_ground(camera, road.axis)
    n = len(road.axis.s)
    stripe = Stripe(np.full(n, road.ego_offset), 0.15, (1.0, 1.0, 1.0), np.ones(n), period, 2.0)
    colour = np.zeros((3, *ground.s.shape), np.float32)
    draw_stripe(colour, stripe, camera, road, ground)
    assert colour.min() >= 0.0
    assert colour.max() <= 1.0
    rows = ground.first_row + np.arange(len(ground.s)) + 0.5
    left, s = image_columns(camera, road, stripe.offset - 0.075, rows, 300.0)
    right, _ = image_columns(camera, road, stripe.offset + 0.075, rows, 300.0)
    full = np.isfinite(s) & (s < 300.0) & (left > 10) & (right < camera.width - 10)
    assert full.sum() > 50
    painted, width = colour[0].sum(-1)[full], (right - left)[full]
    if period:
        np.testing.assert_allclose(painted.sum(), width.sum() * 2.0 / 6.0, rtol=0.5)
        assert (painted < width + 1e-3).all()
        assert painted.max() > 0.9 * width[painted.argmax()]
    else:
        np.testing.assert_allclose(painted, width, rtol=1e-3, atol=2e-3)


def test_a_box_is_drawn_where_it_projects():
    scene = draw_front_scene(5)
    image = np.zeros((360, 640, 3), np.uint8)
    wall = np.array([[20.0, 1.0, 0.0], [20.0, -1.0, 0.0], [20.0, -1.0, 2.0], [20.0, 1.0, 2.0]])
    solid = Solid(20.0)
    solid.add(wall, (1.0, 1.0, 1.0), light=1.0)
    draw_solids(image, [solid], scene.camera, scene.weather)
    pixels, _, _ = project(wall, scene.camera.intrinsics, scene.camera.camera_from_ego)
    row, column = np.nonzero(image.max(-1) > 60)
    np.testing.assert_allclose([column.min(), column.max() + 1], [pixels[:, 0].min(), pixels[:, 0].max()], atol=1.5)
    np.testing.assert_allclose([row.min(), row.max() + 1], [pixels[:, 1].min(), pixels[:, 1].max()], atol=1.5)
    behind = Solid(20.0)
    behind.add(wall[::-1], (1.0, 1.0, 1.0))
    nothing = np.zeros_like(image)
    draw_solids(nothing, [behind, Solid(3.0)], scene.camera, scene.weather)
    assert not nothing.any()


def test_a_polygon_beside_the_camera_is_cut_at_it():
    scene = draw_front_scene(5)
    image = np.zeros((360, 640, 3), np.uint8)
    solid = Solid(5.0)
    wall = np.array([[-5.0, -3.0, 3.0], [15.0, -3.0, 3.0], [15.0, -3.0, 0.0], [-5.0, -3.0, 0.0]])
    solid.add(wall, (1.0, 1.0, 1.0), light=1.0)
    draw_solids(image, [solid], scene.camera, scene.weather)
    assert not image[:, :300].any()
    assert image[200:, 600:].any()


def test_a_polygon_at_the_near_plane_causes_no_error():
    scene = draw_front_scene(5)
    forward = np.linalg.inv(scene.camera.camera_from_ego)[:3, 2]
    eye = np.linalg.inv(scene.camera.camera_from_ego)[:3, 3]
    for depth in NEAR * np.array([0.99, 1.0, 1.001, 1.02]):
        tip = eye + depth * forward
        solid = Solid(1.0)
        for ring in ([tip, [-5.0, 1.0, 0.0], [-5.0, -1.0, 0.0]], [[-5.0, -1.0, 0.0], [-5.0, 1.0, 0.0], tip]):
            solid.add(np.array(ring), (1.0, 1.0, 1.0))
        draw_solids(np.zeros((360, 640, 3), np.uint8), [solid], scene.camera, scene.weather)


def fleet(count: int) -> FrontTraffic:
    return FrontTraffic(
        xy=np.linspace([12.0, -8.0], [40.0, 8.0], count).reshape(count, 2),
        yaw=np.zeros(count),
        size=np.tile([4.5, 1.8, 1.5], (count, 1)),
        category=np.arange(count, dtype=np.int32) % 4,
        look=np.full((count, 4), 0.3),
    )


@pytest.mark.parametrize("count", [0, 1, 8])
def test_each_vehicle_is_a_solid_around_its_place(count):
    traffic = fleet(count)
    solids = vehicle_solids(traffic, 0.0)
    cast, below = ground_shadows(traffic, np.array([0.5, 0.5, 0.7]))
    assert len(solids) == len(cast) == len(below) == count
    for solid, xy in zip(solids, traffic.xy, strict=True):
        points = np.concatenate(solid.corners)
        assert np.abs(points[:, :2] - xy).max() < 2.4
        assert points[:, 2].min() >= -1e-9
        assert points[:, 2].max() < 1.6


def test_roadside_objects_stay_off_the_road():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        road = draw_highway(rng, HighwayConfig(extra_lane=0.0), 0.0)
        for solid in draw_roadside(rng, road).solids:
            for corners in solid.corners:
                low = corners[corners[:, 2] < 4.0]
                s, offset = road_coordinates(road.axis, low[:, :2]) if len(low) else (np.zeros(0), np.zeros(0))
                inside = (offset > road.lines[0].min() + 0.2) & (offset < road.lines[-1].max() - 0.2)
                assert not (inside & (s > 0.0) & (s < 200.0)).any()


def test_the_noise_tile_has_the_statistics_of_noise():
    tile = noise_tile()
    assert tile.dtype == np.float32
    np.testing.assert_allclose([tile.mean(), tile.std()], [0.0, 1.0], atol=1e-3)

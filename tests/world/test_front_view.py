"""Front views: labels against projected lines, weather, determinism."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.errors import UserError
from tflane_jax.geometry.cameras import ground_points, project
from tflane_jax.world.front_view.ground import image_columns
from tflane_jax.world.front_view.lines import ROW_FRACTIONS, label_lines, marked_lines
from tflane_jax.world.front_view.road import WHITE, Stripe
from tflane_jax.world.front_view.roadside import Roadside
from tflane_jax.world.front_view.traffic import FrontTrafficConfig
from tflane_jax.world.front_view.views import FrontWorldConfig, draw_front_scene, front_view, render, scene_lines
from tflane_jax.world.render.camera import PinholeCamera, lift
from tflane_jax.world.render.weather import Sky
from tflane_jax.world.roads.curves import ReferenceLine

CLEAN = FrontWorldConfig(severity=0.0)
SCENES = st.integers(0, 3 * 10**8 - 1)
SIZE = np.array([1280.0, 720.0])


def projected_columns(scene, number: int) -> np.ndarray:
    """Return u (1280 pixels of width) of a line at the labelled rows, from points close together on it."""
    road, camera = scene.road, scene.camera
    s = np.concatenate([np.arange(-5.0, 30.0, 0.05), np.arange(30.0, 300.0, 0.5)])
    xy = road.at(s, np.interp(s, road.axis.s, road.lines[number]))
    pixels, _, valid = project(np.pad(xy, ((0, 0), (0, 1))), camera.intrinsics, camera.camera_from_ego, 0.8)
    pixels = pixels[valid][::-1] * SIZE / [camera.width, camera.height]
    return np.interp(ROW_FRACTIONS * 720.0, pixels[:, 1], pixels[:, 0], left=np.nan, right=np.nan)


@settings(max_examples=25)
@given(SCENES)
def test_labels_are_the_projection_of_the_lines(scene_id):
    scene = draw_front_scene(scene_id)
    lines = scene_lines(scene, 90.0)
    lines.validate()
    columns = [projected_columns(scene, number) for number in marked_lines(scene.road)]
    for points, there in zip(lines.points[lines.valid], lines.point_valid[lines.valid], strict=True):
        u = points[there, 0] * 1280.0
        np.testing.assert_allclose(points[:, 1], ROW_FRACTIONS, rtol=1e-6)
        assert ((u >= 0.0) & (u < 1280.0)).all()
        assert min(np.abs(u - c[there]).max() for c in columns if not np.isnan(c[there]).any()) < 0.5


@pytest.mark.parametrize("radius", [(80.0, 90.0), (20.0, 25.0)])
def test_a_line_that_turns_back_is_followed_until_there(radius):
    """Beyond, rows repeat: interpolation gave columns far from the paint, or no line at all."""
    road = replace(CLEAN.road, radius=radius, straight=0.0)
    for scene in (draw_front_scene(scene_id, replace(CLEAN, road=road)) for scene_id in range(5)):
        rows, found = np.arange(scene.camera.height) + 0.5, 0
        for line in scene.road.lines:
            columns, stations = image_columns(scene.camera, scene.road, line, rows, 400.0)
            # Nearer, it is seen that chords of a metre stand for the curve; at 8 m they are up to a pixel off.
            seen = (columns > 0.0) & (columns < scene.camera.width) & (stations > 8.0)
            ground = scene.road.at(stations[seen], np.interp(stations[seen], scene.road.axis.s, line))
            pixels, _ = scene.camera.image_of(lift(ground))
            np.testing.assert_allclose(pixels, np.stack([columns, rows], -1)[seen], atol=2.0)
            assert (np.diff(stations[seen]) < 0.0).all()
            found += seen.sum()
        assert found > 50


@pytest.mark.parametrize("camera", [{"centre": 600.0}, {"pitch": (-40.0, -40.0)}, {"pitch": (100.0, 100.0)}])
def test_a_camera_may_look_anywhere(camera):
    """Regression: a camera whose horizon is below its last row ended in numpy's traceback."""
    config = replace(CLEAN, camera=replace(CLEAN.camera, **camera))
    views = [front_view(scene_id, config) for scene_id in range(4)]
    assert all(np.isfinite(view.image).all() for view in views)


@settings(max_examples=15)
@given(SCENES)
def test_labels_end_at_the_reach(scene_id):
    scene = draw_front_scene(scene_id)
    lines, camera = scene_lines(scene, 40.0), scene.camera
    pixels = lines.points[lines.point_valid] * [camera.width, camera.height]
    ground, seen = ground_points(pixels, camera.intrinsics, camera.camera_from_ego)
    assert seen.all()
    assert np.hypot(ground[:, 0], ground[:, 1]).max() < 40.0 + 10.0  # the outer lines of a curve are longer
    longer = scene_lines(scene, 90.0)
    assert longer.point_valid.sum() > lines.point_valid.sum()


@settings(max_examples=40)
@given(SCENES)
def test_both_lines_of_the_ego_lane_are_labelled_and_lines_are_sorted(scene_id):
    scene = draw_front_scene(scene_id)
    road, chosen = scene.road, marked_lines(scene.road)
    assert 2 <= len(chosen) <= 5
    assert scene_lines(scene, 90.0).valid.sum() >= 2
    beside = np.array([np.interp(0.0, road.axis.s, road.lines[number]) for number in chosen]) - road.ego_offset
    assert (np.diff(beside) >= 0.0).all()
    assert beside[beside <= 0].max() > -road.lane_width
    assert beside[beside >= 0].min() < road.lane_width
    lowest = [points[there][-1] for points, there in zip(*_valid_lines(scene), strict=True)]
    # Farther left along the bottom of the image, or higher up on its left border.
    order = [u - (1.0 - v) * np.sign(0.5 - u) for u, v in lowest]
    assert order == sorted(order)


def _valid_lines(scene):
    lines = scene_lines(scene, 90.0)
    return lines.points[lines.valid], lines.point_valid[lines.valid]


@settings(max_examples=15)
@given(SCENES)
def test_a_mirrored_road_has_mirrored_labels(scene_id):
    scene = draw_front_scene(scene_id)
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    pose = flip @ scene.camera.camera_from_ego @ np.diag([1.0, -1.0, 1.0, 1.0])
    intrinsics = scene.camera.intrinsics.copy()
    intrinsics[0, 2] = scene.camera.width - intrinsics[0, 2]
    camera = PinholeCamera(scene.camera.width, scene.camera.height, intrinsics, pose)
    axis = scene.road.axis
    road = replace(
        scene.road,
        axis=ReferenceLine(axis.s, axis.xy * [1.0, -1.0], -axis.heading),
        ego_offset=-scene.road.ego_offset,
        lines=-scene.road.lines[::-1],
        present=scene.road.present[::-1],
    )
    there, back = label_lines(scene.camera, scene.road, 90.0), label_lines(camera, road, 90.0)
    count = int(there.valid.sum())
    assert back.valid.sum() == count
    both = there.point_valid[:count] & back.point_valid[:count][::-1]
    assert (there.point_valid[:count] ^ back.point_valid[:count][::-1]).sum() <= count  # u = 0 is inside, u = 1 is not
    mirrored = 1.0 - back.points[:count][::-1][..., 0]
    np.testing.assert_allclose(mirrored[both], there.points[:count, :, 0][both], atol=1e-5)


def test_a_line_outside_the_image_has_no_points():
    scene = draw_front_scene(0)
    road = replace(scene.road, lines=scene.road.lines + 500.0, ego_offset=scene.road.ego_offset + 500.0)
    lines = label_lines(scene.camera, road, 90.0)
    assert not lines.valid.any()
    assert not lines.point_valid.any()
    assert np.isfinite(lines.points).all()


def test_nothing_within_reach_is_no_line():
    assert not scene_lines(draw_front_scene(1), 0.5).valid.any()


def test_lines_stay_labelled_behind_vehicles():
    empty = replace(CLEAN, traffic=FrontTrafficConfig(empty=1.0))
    busy = replace(CLEAN, traffic=FrontTrafficConfig(empty=0.0, density=(0.03, 0.04), clear_ahead=(5.0, 6.0)))
    hidden = 0
    for scene_id in range(6):
        a, b = front_view(scene_id, empty), front_view(scene_id, busy)
        np.testing.assert_array_equal(a.lines.points, b.lines.points)
        np.testing.assert_array_equal(a.lines.point_valid, b.lines.point_valid)
        points = a.lines.points[a.lines.point_valid]
        column, row = (points * [640, 360]).astype(int).T
        difference = np.abs(a.image[row, column].astype(int) - b.image[row, column]).max(-1)
        hidden += (difference > 40).sum()
    assert hidden > 10


@pytest.mark.parametrize("scene_id", range(4))
def test_paint_lies_where_the_labels_are(scene_id):
    """The picture is brighter on a label than 0.7 m beside it."""
    scene = draw_front_scene(scene_id, replace(CLEAN, traffic=FrontTrafficConfig(empty=1.0)))
    road, camera, n = scene.road, scene.camera, len(scene.road.axis.s)
    paint = tuple(Stripe(line, 0.2, WHITE, np.ones(n)) for line in road.lines)
    bare = Roadside([], np.zeros((0, 4)), [])
    image = render(replace(scene, road=replace(road, paint=paint), roadside=bare), scene_id).astype(float)
    lines = scene_lines(scene, 40.0)
    pixels = lines.points[lines.point_valid] * [camera.width, camera.height]
    ground, _ = ground_points(pixels, camera.intrinsics, camera.camera_from_ego)
    brightness = []
    for beside in (0.0, -0.7, 0.7):
        moved, _, _ = project(ground + np.array([0.0, beside, 0.0]), camera.intrinsics, camera.camera_from_ego)
        column, row = np.clip(moved, 0, [camera.width - 1, camera.height - 1]).astype(int).T
        brightness.append(image[row, column].mean(-1))
    on, left, right = brightness
    assert len(on) > 50
    assert (on > 15.0 + np.maximum(left, right)).mean() > 0.95


def test_the_same_number_is_the_same_image():
    a, b, other = front_view(7), front_view(7), front_view(8)
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.lines.points, b.lines.points)
    assert (a.image != other.image).mean() > 0.5
    assert a.image.dtype == np.uint8
    assert a.image_valid.all()
    a.validate()


def test_severity_zero_is_clear_fresh_and_free_of_noise():
    for scene_id in range(20):
        scene = draw_front_scene(scene_id, CLEAN)
        weather = scene.weather
        assert weather.kind is Sky.CLEAR
        assert (weather.noise, weather.blur, weather.wear, weather.dirt, weather.rain, weather.night) == (0,) * 6
        assert (weather.exposure, weather.contrast) == (1.0, 1.0)
        assert all(stripe.opacity.max() == 1.0 for stripe in scene.road.paint)


@pytest.mark.parametrize("severity", [-0.1, 1.1, float("nan")])
def test_an_invalid_severity_is_refused(severity):
    with pytest.raises(UserError, match="severity must be between 0 and 1"):
        draw_front_scene(0, FrontWorldConfig(severity=severity))


@pytest.mark.parametrize("severity", [0.0, 1.0])
def test_pictures_are_neither_black_nor_white(severity):
    for scene_id in range(15):
        image = front_view(scene_id, FrontWorldConfig(severity=severity)).image
        assert 8.0 < image.mean() < 235.0
        assert image.std() > 6.0


def test_severity_and_traffic_leave_the_labels_alone():
    a, b = front_view(11, CLEAN), front_view(11, FrontWorldConfig(severity=1.0))
    np.testing.assert_array_equal(a.lines.points, b.lines.points)


def test_other_image_sizes_show_the_same():
    config = replace(CLEAN, camera=replace(CLEAN.camera, width=320, height=180))
    small, large = front_view(3, config), front_view(3, CLEAN)
    assert small.image.shape == (180, 320, 3)
    np.testing.assert_allclose(small.lines.points, large.lines.points, atol=1e-6)
    shrunk = large.image.reshape(180, 2, 320, 2, 3).mean((1, 3))
    assert np.abs(small.image - shrunk).mean() < 8.0

"""Markers in the world's images: projection, brightness by area, occlusion."""

from dataclasses import replace

import numpy as np
import pytest

from tests.world import camera_scene
from tests.world.camera_scene import scene, street
from tflane_jax.errors import UserError
from tflane_jax.geometry.cameras import project
from tflane_jax.markers.detection import detect
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.scene.logs import PlacedMarkers
from tflane_jax.scene.marker_patterns import MarkerFamily, board_cells, board_size, marker_cells
from tflane_jax.world.cameras.markers import marker_bodies
from tflane_jax.world.cameras.pictures import paint_picture
from tflane_jax.world.cameras.ring import CameraRigConfig, draw_rig
from tflane_jax.world.cameras.sensor import render_cameras, render_window
from tflane_jax.world.cameras.solids import draw_bodies, join, pack
from tflane_jax.world.render.exposure import Window, develop
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import box
from tflane_jax.world.render.weather import FrontWeatherConfig, draw_weather

pytest.importorskip("cv2")

FRONT = replace(camera_scene.FRONT, markers=True)

CAMERA = draw_rig(0, CameraRigConfig(jitter=0.0, scale=0.4))[0]
WEATHER = draw_weather(np.random.default_rng(0), FrontWeatherConfig(), 0.0)
FAMILY = MarkerFamily.ARUCO_5X5_100


def pose(x, y, z, turn=0.0):
    """Return the pose of an upright marker that faces against x, turned to its own left by `turn` (radians)."""
    ahead = np.array([-np.cos(turn), -np.sin(turn), 0.0])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    result = np.eye(4)
    result[:3] = np.stack([right, [0.0, 0.0, 1.0], ahead, [x, y, z]], -1)
    return result


def markers(*poses, ids=None, size=1.0):
    ids = np.arange(len(poses)) if ids is None else np.array(ids)
    return PlacedMarkers(ids, np.array(poses).reshape(-1, 4, 4), size)


def drawn(*bodies, tone=120):
    image = np.full((CAMERA.height, CAMERA.width, 3), tone, np.uint8)
    draw_bodies(image, join(bodies), CAMERA, WEATHER)
    return image


@pytest.mark.parametrize("turn", [0.0, 0.6, -0.9])
def test_every_cell_lies_where_geometry_projects_it(turn):
    place = pose(7.0, -1.5, 2.4, turn)
    image = drawn(marker_bodies(markers(place, ids=[7]))).max(-1)
    cells = board_cells(FAMILY, 7)
    n = len(cells)
    side = board_size(FAMILY, 1.0)
    across = ((np.arange(n) + 0.5) / n - 0.5) * side
    x, y = np.meshgrid(across, -across)
    local = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], -1)
    pixels, _, _ = project((local @ place.T)[..., :3].reshape(-1, 3), CAMERA.intrinsics, CAMERA.camera_from_ego)
    column, row = pixels.astype(int).T
    seen = image[row, column].reshape(n, n)
    assert seen[cells].min() > 2 * seen[~cells].max()
    assert np.ptp(seen[cells]) == np.ptp(seen[~cells]) == 0


@pytest.mark.parametrize("distance", [4.0, 23.0, 90.0, 250.0])
def test_a_picture_darkens_the_image_by_its_area(distance):
    """However small: the sum over the image is area times tone, for a board of which a known fraction is white."""
    picture = marker_cells(FAMILY, 3).astype(float)
    half, focal = 0.5, CAMERA.intrinsics[0, 0]
    eye = np.linalg.inv(CAMERA.camera_from_ego)[:3, 3]
    axes = CAMERA.camera_from_ego[:3, :3]
    middle = eye + distance * axes[2]
    corners = np.array([middle + half * (a * axes[0] - b * axes[1]) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    paint_picture(image, corners, picture, CAMERA, np.array([[10.0] * 3, [250.0] * 3]))
    area = (focal / distance) ** 2
    expected = area * (250.0 * picture.mean() + 10.0 * (1.0 - picture.mean()))
    # Pixels round to whole numbers.
    covered = np.count_nonzero(image[..., 0])
    assert image[..., 0].sum() == pytest.approx(expected, rel=0.03, abs=0.5 * covered + 4.0)


@pytest.mark.parametrize(
    "corners",
    [
        [(0.5, -0.5, 1.0), (0.5, 0.5, 1.0), (0.5, 0.5, 2.0), (0.5, -0.5, 2.0)],  # behind what is nearest
        [(9.0, 90.5, 1.0), (9.0, 90.0, 1.0), (9.0, 90.0, 2.0), (9.0, 90.5, 2.0)],  # beside the image
    ],
)
def test_a_picture_outside_the_image_is_left_out(corners):
    image = np.full((CAMERA.height, CAMERA.width, 3), 7, np.uint8)
    paint_picture(image, np.array(corners), np.ones((2, 2)), CAMERA, np.full((2, 3), 200.0))
    assert (image == 7).all()


def test_a_vehicle_hides_a_marker_and_a_marker_hides_what_is_behind():
    wall = Solid()
    box(wall, np.array([14.0, -1.0]), 0.0, (1.0, 6.0), (0.0, 6.0), (0.2, 0.7, 0.2))
    wall = pack([wall], [(14.0, -1.0, 1.0, 6.0, 0.0, 0.0, 6.0)])
    near, far = (marker_bodies(markers(pose(x, -1.0, 2.5))) for x in (9.0, 20.0))
    alone = drawn(wall)
    assert (drawn(far, wall) == alone).all()
    changed = (drawn(wall, near) != alone).any(-1)
    assert changed.sum() > (0.9 * CAMERA.intrinsics[0, 0] / 9.0) ** 2


def test_a_marker_is_seen_from_its_face_only():
    """From behind there is a plain board."""
    back = marker_bodies(markers(pose(9.0, -1.0, 2.5, np.pi)))
    face = marker_bodies(markers(pose(9.0, -1.0, 2.5)))
    colours = [len(np.unique(drawn(bodies))) for bodies in (back, face)]
    assert colours[0] < colours[1]


def test_pictures_stay_with_their_polygons():
    """After bodies are joined, selected and moved."""
    some, more = (
        marker_bodies(markers(pose(9.0, 0.0, 2.5), pose(12.0, 1.0, 2.5))),
        marker_bodies(markers(pose(15.0, 2.0, 2.5), ids=[5])),
    )
    both = join([some, pack([], []), more])
    keep = np.ones(len(both.boxes), bool)
    keep[:2] = False  # first board and its post
    kept = both.chosen(keep).placed(np.array([[3.0, 0.0]]), np.zeros(1))
    shown = {tuple(kept.corners[4 * n : 4 * n + 4, 0].round(6)): picture for n, picture in kept.pictures.items()}
    assert sorted(shown) == [(15.0,) * 4, (18.0,) * 4]
    np.testing.assert_array_equal(shown[(15.0,) * 4], board_cells(FAMILY, 1))
    np.testing.assert_array_equal(shown[(18.0,) * 4], board_cells(FAMILY, 5))


def test_a_tilted_marker_lies_in_its_box():
    place = pose(9.0, -1.0, 2.5, 0.4)
    lean = np.eye(4)
    lean[1:3, 1:3] = [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    bodies = marker_bodies(markers(place @ lean))
    x, y, length, width, yaw, low, high = bodies.boxes[0]
    local = bodies.corners[:24] - [x, y, 0.0]  # six faces of the board
    along = local[:, 0] * np.cos(yaw) + local[:, 1] * np.sin(yaw)
    across = local[:, 1] * np.cos(yaw) - local[:, 0] * np.sin(yaw)
    np.testing.assert_allclose([np.abs(along).max(), np.abs(across).max()], [length / 2, width / 2], atol=1e-9)
    np.testing.assert_allclose([local[:, 2].min(), local[:, 2].max()], [low, high], atol=1e-9)


def test_nothing_to_draw():
    for none in (None, markers()):
        bodies = marker_bodies(none)
        assert len(bodies.boxes) == len(bodies.pictures) == 0
        assert (drawn(bodies) == 120).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"size": 0.0}, "size"),
        ({"ids": [100]}, "0 to 99"),
        ({"ids": [-1]}, "0 to 99"),
    ],
)
def test_invalid_arguments_are_refused(change, words):
    with pytest.raises(UserError, match=words):
        marker_bodies(markers(pose(9.0, 0.0, 2.0), **change))


def test_a_window_is_a_part_of_the_image():
    log = scene(street())
    whole = render_cameras(log, 0, FRONT).image[0]
    part = render_window(log, 0, FRONT, (200, 120), (140, 90))
    # The lens blurs across the part's border.
    difference = np.abs(part.astype(int) - whole[120:210, 200:340])[3:-3, 3:-3]
    assert difference.max() <= 3
    assert np.ptp(part) > 60
    with pytest.raises(UserError, match="window"):
        render_window(log, 0, FRONT, (600, 0), (140, 90))


def test_a_part_gets_its_part_of_the_rain():
    rain = replace(WEATHER, rain=0.9, noise=0.0, blur=0.0)

    def image(height, width, window=None):
        return develop(np.random.default_rng(3), np.full((height, width, 3), 90, np.uint8), rain, 1.5, window)

    whole, part = image(360, 640), image(90, 140, Window((640, 360), (200, 120)))
    # Without the border, where the lens blur of the part lacks its neighbours. Streaks from above reach into the part.
    np.testing.assert_array_equal(part[3:-3, 3:-3], whole[120:210, 200:340][3:-3, 3:-3])
    assert 0.005 < (part.max(-1) > np.median(part) + 3).mean() < 0.2
    np.testing.assert_array_equal(image(360, 640, Window((640, 360), (0, 0))), whole)


def test_a_marker_of_the_log_is_drawn_and_found_and_none_change_nothing():
    plain = scene(street())
    ego = plain.keyframes[0].global_from_ego
    local = pose(11.0, -1.8, 2.6, 0.3)
    bare = render_cameras(plain, 0, FRONT)
    empty = render_cameras(replace(plain, markers=markers()), 0, FRONT)
    assert empty.image.tobytes() == bare.image.tobytes()
    for family in (FAMILY, MarkerFamily.APRILTAG_36H11):
        placed = PlacedMarkers(np.array([17]), (ego @ local)[None], 1.0, family)
        unasked = render_cameras(replace(plain, markers=placed), 0, replace(FRONT, markers=False))
        assert unasked.image.tobytes() == bare.image.tobytes()
        views = render_cameras(replace(plain, markers=placed), 0, FRONT)
        found = detect(views, DetectorConfig(family))
        assert found.marker_id[found.valid].tolist() == [17]
        np.testing.assert_allclose(found.pose[0], local, atol=0.05)
        changed = (views.image != bare.image).any((0, 3))
        rows, columns = np.nonzero(changed)
        assert 0 < changed.mean() < 0.1
        assert columns.min() > 0.5 * FRONT.size(FRONT.cameras[0])[0]
        assert rows.min() > 0
    hidden = scene(street(), [(8.5, -1.4, 2.0, 1.9, 3.6)])
    views = render_cameras(replace(hidden, markers=placed), 0, FRONT)
    assert not detect(views, DetectorConfig(family)).valid.any()

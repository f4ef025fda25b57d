"""Drawing of solid bodies in camera images: order, clipping, placement."""

import numpy as np
import pytest

from tflane_jax.geometry.cameras import project
from tflane_jax.world.cameras.ring import CameraRigConfig, draw_rig
from tflane_jax.world.cameras.solids import draw_bodies, join, pack
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import box
from tflane_jax.world.render.weather import FrontWeatherConfig, draw_weather

pytest.importorskip("cv2")

CAMERA = draw_rig(0, CameraRigConfig(jitter=0.0, scale=0.2))[0]
WEATHER = draw_weather(np.random.default_rng(0), FrontWeatherConfig(), 0.0)


def block(x, y, length, width, height, colour, base=0.0, yaw=0.0):
    solid = Solid()
    box(solid, np.array([x, y]), yaw, (length, width), (base, base + height), colour)
    return pack([solid], [(x, y, length, width, yaw, base, base + height)])


def seen_at(image, point):
    """Return the strongest channel of the pixel that shows a point."""
    (pixel,), _, _ = project(np.array([point]), CAMERA.intrinsics, CAMERA.camera_from_ego)
    column, row = pixel.astype(int)
    return int(image[row, column].argmax())


RED, GREEN = (0.9, 0.05, 0.05), (0.05, 0.9, 0.05)
# Red must hide green at the point, wherever the middles of the bodies are.
PAIRS = {
    "a car before a long wall whose middle is nearer": (
        block(24.0, 4.0, 4.0, 1.8, 1.5, RED),
        block(15.0, 6.0, 30.0, 1.0, 5.0, GREEN),
        (22.0, 3.1, 1.0),
    ),
    "a wall before a car": (
        block(15.0, 4.0, 30.0, 1.0, 3.0, RED),
        block(20.0, 6.0, 4.0, 1.8, 1.5, GREEN),
        (18.0, 3.4, 1.0),
    ),
    "the nearer of two in a row": (
        block(10.0, 0.0, 4.0, 2.0, 2.5, RED),
        block(17.0, 0.0, 4.0, 2.0, 2.5, GREEN),
        (8.0, 0.5, 1.2),
    ),
    "a trunk below its crown, seen from below": (
        block(10.0, 0.0, 0.4, 0.4, 3.0, RED),
        block(10.0, 0.0, 4.0, 4.0, 2.0, GREEN, base=3.0),
        (9.8, 0.0, 2.9),
    ),
    "a turned body beside another": (
        block(14.0, 1.0, 8.0, 1.0, 2.0, RED, yaw=0.5),
        block(20.0, 2.0, 12.0, 1.0, 3.0, GREEN, yaw=0.5),
        (13.0, 1.05, 1.0),
    ),
}


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("pair", PAIRS)
def test_nearer_bodies_hide_farther_ones(pair, order):
    front, behind, point = PAIRS[pair]
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    draw_bodies(image, join([front, behind][::order]), CAMERA, WEATHER)
    assert seen_at(image, point) == 0
    alone = np.zeros_like(image)
    draw_bodies(alone, behind, CAMERA, WEATHER)
    assert (image.argmax(-1)[alone.any(-1)] == 0).any()


def test_a_body_that_reaches_behind_the_camera_is_cut_off():
    """A wall beside the vehicle, from 20 m behind it to 30 m ahead, covers the image's left border above the ground."""
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    draw_bodies(image, block(5.0, 3.0, 50.0, 0.5, 6.0, RED), CAMERA, WEATHER)
    assert (image[:, 2].argmax(-1) == 0).mean() > 0.9
    assert image[:-6, 2].max(-1).min() > 40
    assert image[:, -2].max() == 0


def test_nothing_to_draw():
    image = np.full((CAMERA.height, CAMERA.width, 3), 7, np.uint8)
    draw_bodies(image, pack([], []), CAMERA, WEATHER)
    draw_bodies(image, block(-20.0, 0.0, 4.0, 2.0, 2.0, RED), CAMERA, WEATHER)
    assert (image == 7).all()


def test_placed_bodies_take_their_boxes_along():
    bodies = join([block(2.0, 1.0, 4.0, 2.0, 1.0, RED), block(0.0, 0.0, 1.0, 1.0, 1.0, GREEN)])
    moved = bodies.placed(np.array([[10.0, 0.0], [0.0, 5.0]]), np.array([np.pi / 2, 0.0]))
    expected = [[9.0, 2.0, 4.0, 2.0, np.pi / 2], [0.0, 5.0, 1.0, 1.0, 0.0]]
    np.testing.assert_allclose(moved.boxes[:, :5], expected, atol=1e-9)
    for number, (low, high) in enumerate((([8.0, 0.0], [10.0, 4.0]), ([-0.5, 4.5], [0.5, 5.5]))):
        corners = moved.corners[np.repeat(moved.owner, 4) == number]
        np.testing.assert_allclose([corners[:, :2].min(0), corners[:, :2].max(0)], [low, high], atol=1e-9)
    kept = moved.chosen(np.array([False, True]))
    np.testing.assert_allclose(kept.corners[:, :2].min(0), [-0.5, 4.5])

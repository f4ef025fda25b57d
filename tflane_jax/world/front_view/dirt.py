"""Distractors on the asphalt: seams, tyre marks, cracks, patches, joints and arrows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.world.front_view.ground import Ground
from tflane_jax.world.front_view.road import Highway, Stripe
from tflane_jax.world.render.camera import PinholeCamera, lift
from tflane_jax.world.render.polygons import SHIFT, fixed_point

TRACK = 0.85  # half the distance between the wheels of a car, metres
_SKID = (0.12, 0.12, 0.12)
# Nothing is drawn on nearer ground, metres.
_NEAREST = 2.0
_ARROW = np.array([[0.0, -0.08], [2.6, -0.08], [2.6, -0.35], [4.2, 0.0], [2.6, 0.35], [2.6, 0.08], [0.0, 0.08]])


def dirt_stripes(rng: np.random.Generator, road: Highway, dirt: float) -> list[Stripe]:
    """Draw seams, cracks along the road and tyre marks."""
    s = road.axis.s
    stripes = []
    for _ in range(rng.poisson(2.5 * dirt)):
        middle = rng.choice(road.lanes) + rng.uniform(-0.5, 0.5) * road.lane_width
        waves = np.interp(s, np.arange(s[0], s[-1] + 8, 8.0), rng.standard_normal(len(np.arange(s[0], s[-1] + 8, 8.0))))
        wobble = rng.choice([0.0, 0.02, 0.06]) * waves
        grey = rng.choice([0.1, 0.2, 0.62], p=[0.5, 0.3, 0.2])
        span = _window(s, rng.uniform(-5.0, 60.0), rng.uniform(10.0, 150.0))
        opacity = span * rng.uniform(0.3, 0.9)
        stripes.append(Stripe(middle + wobble, rng.uniform(0.02, 0.1), (grey, grey, grey), opacity))
    for _ in range(rng.poisson(0.7 * dirt)):
        start, length = rng.uniform(3.0, 50.0), rng.uniform(10.0, 35.0)
        middle = rng.choice(road.lanes) + rng.uniform(-0.6, 0.6)
        swerve = rng.uniform(-1.5, 1.5) * np.clip((s - start) / length, 0.0, 1.0) ** 2
        for side in (-TRACK, TRACK):
            opacity = rng.uniform(0.25, 0.6) * _window(s, start, length)
            stripes.append(Stripe(middle + side + swerve, 0.2, _SKID, opacity))
    return stripes


def _window(s: np.ndarray, start: float, length: float) -> np.ndarray:
    return np.clip(np.minimum(s - start, start + length - s) / 3.0, 0.0, 1.0)


def draw_stains(
    rng: np.random.Generator,
    colour: Float[np.ndarray, "3 h w"],
    camera: PinholeCamera,
    road: Highway,
    ground: Ground,
    dirt: float,
) -> None:
    """Draw patches, joints, cracks and arrows into the ground's colours."""
    import cv2

    dark = np.full(colour.shape[1:], 255, np.uint8)
    shift = np.array([0.0, ground.first_row])

    def seen(s, offset):
        flat = road.at(np.maximum(s, _NEAREST), np.asarray(offset, np.float64))
        return fixed_point(camera.image_of(lift(flat))[0] - shift)

    first, last = road.lines[0, 0], road.lines[-1, 0]
    for _ in range(rng.poisson(1.2 * dirt)):
        s, length = rng.uniform(3.0, 60.0), rng.uniform(1.5, 18.0)
        middle, half = rng.choice(road.lanes) + rng.uniform(-0.6, 0.6), rng.uniform(0.4, 1.7)
        ring = seen(s + np.array([0.0, length, length, 0.0]), middle + np.array([-half, -half, half, half]))
        cv2.fillPoly(dark, [ring], int(rng.uniform(165, 235)), cv2.LINE_AA, SHIFT)
    if rng.random() < 0.3 * dirt:
        spacing, width = rng.uniform(4.5, 9.0), rng.uniform(0.02, 0.05)
        for s in np.arange(rng.uniform(_NEAREST, spacing + _NEAREST), 45.0, spacing):
            ring = seen(s + np.array([0.0, 0.0, width, width]), [first, last, last, first])
            cv2.fillPoly(dark, [ring], 175, cv2.LINE_AA, SHIFT)
    for _ in range(rng.poisson(2.0 * dirt)):
        steps = int(rng.integers(4, 14))
        walk = np.cumsum(rng.normal([rng.choice([0.0, 0.7]), 0.0], [0.5, 0.25], (steps, 2)), 0)
        line = seen(rng.uniform(4.0, 22.0) + walk[:, 0], rng.choice(road.lanes) + walk[:, 1])
        cv2.polylines(dark, [line], False, int(rng.uniform(150, 215)), 1, cv2.LINE_AA, SHIFT)
    if dark.min() < 255:
        colour *= dark * np.float32(1.0 / 255.0)
    if rng.random() < 0.15 * dirt:
        paint = np.zeros(colour.shape[1:], np.uint8)
        for lane in road.lanes:
            place = rng.uniform(6.0, 40.0) + _ARROW[:, 0], lane + _ARROW[:, 1] * rng.uniform(1.0, 1.6)
            cv2.fillPoly(paint, [seen(*place)], 190, cv2.LINE_AA, SHIFT)
        fraction = paint * np.float32(1.0 / 255.0)
        colour += fraction * (np.float32(0.85) - colour)

"""From the light that reaches a lens to the delivered image: rain, blur, exposure, contrast, tint and noise."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.world.render.polygons import SHIFT
from tflane_jax.world.render.weather import Weather


@functools.cache
def _grain() -> Float[np.ndarray, " n"]:
    """Return standard normal noise, the same in every process; drawing it anew for every image would be slower."""
    return np.random.default_rng(20_250_714).standard_normal(1 << 21, np.float32)


@dataclass(frozen=True)
class Window:
    """Where a part of a camera's image lies, pixels.

    Attributes:
        whole: width and height of the whole image.
        corner: column and row of the part's upper left pixel.
    """

    whole: tuple[int, int]
    corner: tuple[int, int]


def develop(
    rng: np.random.Generator,
    image: UInt8[np.ndarray, "h w 3"],
    weather: Weather,
    scale: float = 1.0,
    window: Window | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the delivered image after rain streaks, blur, exposure, contrast, tint and noise.

    Args:
        rng: stream of rain and noise.
        image: light at the lens; rain streaks are added to it in place.
        weather: with the camera's tone.
        scale: length of the rain streaks; 1 for images of 640 x 360.
        window: which part of a larger image this one is; None for a whole one.
    """
    import cv2

    if weather.rain:
        _streaks(rng, image, weather, scale, window or Window(image.shape[1::-1], (0, 0)))
    # A lens spreads a point over about a pixel at best.
    image = cv2.GaussianBlur(image, (0, 0), 0.45 + weather.blur)
    levels = np.arange(256, dtype=np.float32)[:, None] / 255.0 * (weather.exposure * weather.tint).astype(np.float32)
    levels = 0.45 + weather.contrast * (levels - 0.45)
    table = np.clip(255.0 * levels, 0.0, 255.0).astype(np.uint8)
    image = cv2.LUT(image, table[None])
    if weather.noise:
        start = rng.integers(len(_grain()) - image.size) if image.size < len(_grain()) else 0
        grain = np.resize(_grain()[start : start + image.size], image.shape) * (255.0 * weather.noise)
        image = cv2.add(image, grain, dtype=cv2.CV_8U)
    return image


def _streaks(rng: np.random.Generator, image: np.ndarray, weather: Weather, scale: float, window: Window) -> None:
    import cv2

    # All streaks of the whole image are drawn: a small part has few of them.
    count = int(260 * weather.rain)
    start = rng.uniform(0.0, 1.0, (count, 2)) * window.whole - window.corner
    fall = scale * rng.uniform(6.0, 22.0, (count, 1)) * [rng.uniform(-0.3, 0.3), 1.0]
    layer = image.copy()
    lines = np.round(np.stack([start, start + fall], 1) * 16).astype(np.int32)
    cv2.polylines(layer, list(lines), False, (200, 205, 210), 1, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(layer, 0.3, image, 0.7, 0.0, dst=image)

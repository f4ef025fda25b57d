"""Axis-aligned windows of the ground, in texels, and noise fixed to the ground."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.world.render.noise import noise_tile
from tflane_jax.world.render.polygons import SHIFT

# One standard deviation of noise, grey levels.
NOISE_SIGMA = 40.0
# Window sides are multiples of this many texels, so that they can be halved five times.
_BLOCK = 32


@dataclass(frozen=True)
class Window:
    """An axis-aligned part of the ground.

    Attributes:
        low: (2,) global x and y of its corner, metres.
        texel: metres.
        columns, rows: texels along x and y.
    """

    low: tuple[float, float]
    texel: float
    columns: int
    rows: int

    def fixed(self, points: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Convert points to cv2's fixed point: 1/16 texel from the first texel's center."""
        return np.round(((points - np.array(self.low)) / self.texel - 0.5) * (1 << SHIFT)).astype(np.int32)

    def meets(self, corners: Float[np.ndarray, "n k 2"]) -> Bool[np.ndarray, " n"]:
        """Return which polygons may reach into the window."""
        low = np.array(self.low)
        high = low + self.texel * np.array([self.columns, self.rows])
        return ((corners.max(1) > low) & (corners.min(1) < high)).all(-1)


def window_around(points: Float[np.ndarray, "n 2"], reach: float, texel: float) -> Window:
    """Return the window that contains everything within `reach` metres of the points along x and y."""
    # Aligned to whole texels, so that overlapping windows share texels; sides are multiples of the block.
    first = np.floor((points.min(0) - reach) / texel)
    count = np.ceil(((points.max(0) + reach) / texel - first) / _BLOCK) * _BLOCK
    low = first * texel
    return Window((float(low[0]), float(low[1])), texel, int(count[0]), int(count[1]))


def ground_noise(window: Window, cell: float) -> UInt8[np.ndarray, "h w"]:
    """Return noise that is fixed to the ground: 128 on average, in cells of about `cell` metres."""
    import cv2

    texels = max(round(cell / window.texel), 1)
    tile = _noise_bytes()
    # One cell more on each side, so that cells have the same positions in every window.
    first = [round(low / window.texel) // texels - 1 for low in window.low]
    columns, rows = (
        (start + np.arange(count // texels + 4)) % len(tile)
        for start, count in zip(first, (window.columns, window.rows), strict=True)
    )
    wide = cv2.resize(tile[rows][:, columns], None, fx=texels, fy=texels, interpolation=cv2.INTER_LINEAR)
    left, top = (round(low / window.texel) - start * texels for low, start in zip(window.low, first, strict=True))
    return wide[top : top + window.rows, left : left + window.columns]


@functools.cache
def _noise_bytes() -> UInt8[np.ndarray, "n n"]:
    return np.clip(128.0 + NOISE_SIGMA * noise_tile(), 0.0, 255.0).astype(np.uint8)

"""A tile of smooth noise, the texture of ground, clouds and hills in front views and ring cameras."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float

# Side of the tile, which repeats without a seam.
TILE = 256


@functools.cache
def noise_tile() -> Float[np.ndarray, "n n"]:
    """Return smooth periodic noise of unit variance, the same in every process."""
    rng = np.random.default_rng(20_250_712)
    frequency = np.fft.fftfreq(TILE)
    radius = np.hypot(frequency[:, None], frequency[None, : TILE // 2 + 1]) * TILE
    strength = np.zeros_like(radius)
    seen = (radius > 2.0) & (radius < 90.0)
    strength[seen] = radius[seen] ** -0.8
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TILE, TILE))) * strength)
    return (noise / noise.std()).astype(np.float32)

"""Colours of the ground of a front view: grass, asphalt, paint, wear and dirt."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.world.front_view.dirt import TRACK, dirt_stripes, draw_stains
from tflane_jax.world.front_view.ground import Ground
from tflane_jax.world.front_view.road import Beside, Highway
from tflane_jax.world.front_view.stripes import draw_stripe
from tflane_jax.world.render.camera import PinholeCamera
from tflane_jax.world.render.noise import TILE, noise_tile

# Spacing of the tabulated colours across the road, and the largest offset on either side, metres.
_STEP, _WIDEST = 0.04, 80.0
_GRASS = ((0.30, 0.35, 0.18), (0.36, 0.38, 0.22), (0.42, 0.38, 0.26), (0.25, 0.3, 0.16), (0.5, 0.44, 0.32))


def paint_ground(
    rng: np.random.Generator, camera: PinholeCamera, road: Highway, ground: Ground, *, dirt: float, wet: float
) -> Float[np.ndarray, "3 h w"]:
    """Return the albedo of the ground (colours in full even light) for the rows of `ground`.

    Args:
        rng: stream of colours, dirt and texture.
        camera, road, ground: of the view.
        dirt: 0 (a spotless road) to 1.
        wet: 0 to 1.
    """
    profile = (1.0 - 0.35 * wet) * _profile(rng, road, dirt)
    index = ((ground.offset + np.float32(_WIDEST)) * np.float32(1.0 / _STEP)).astype(np.int32)
    np.clip(index, 0, profile.shape[1] - 1, out=index)
    texture = _texture(rng, ground, dirt)
    colour = np.empty((3, *index.shape), np.float32)
    for channel in range(3):
        np.multiply(profile[channel][index], texture, out=colour[channel])
    draw_stains(rng, colour, camera, road, ground, dirt)
    for stripe in (*dirt_stripes(rng, road, dirt), *road.paint):
        draw_stripe(colour, stripe, camera, road, ground)
    return colour


def _profile(rng: np.random.Generator, road: Highway, dirt: float) -> Float[np.ndarray, "3 k"]:
    """Return colours at offsets from -`_WIDEST`, `_STEP` apart."""
    offset = np.arange(-_WIDEST, _WIDEST, _STEP)
    grass = np.array(_GRASS[rng.integers(len(_GRASS))]) * rng.uniform(0.8, 1.2)
    grey = rng.uniform(0.3, 0.56)
    asphalt = grey * (1.0 + rng.uniform(-0.03, 0.05) * np.array([1.0, 0.2, -1.0]))
    shoulder = asphalt * (1.0 + dirt * rng.uniform(-0.25, 0.15))
    colour = np.tile(grass, (len(offset), 1))
    far_edge, near_median, left_edge, right_edge = road.edges
    colour[(offset > far_edge) & (offset < near_median)] = asphalt * rng.uniform(0.9, 1.1)
    if road.left[0] is Beside.BARRIER or near_median >= left_edge:
        colour[(offset >= near_median) & (offset <= left_edge)] = shoulder
    colour[(offset > left_edge) & (offset < right_edge)] = shoulder
    first, last = road.lines[0].min(), road.lines[-1].max()
    lanes = (offset > first - 0.1) & (offset < last + 0.1)
    colour[lanes] = asphalt
    # Lanes differ a little, tyres darken or polish their tracks, oil drips between them.
    strength, oil = dirt * rng.uniform(-0.12, 0.06), dirt * rng.uniform(-0.12, 0.02)
    factor = np.ones(len(offset))
    for middle in road.lanes:
        d = offset - middle
        tracks = np.exp(-(((np.abs(d) - TRACK) / 0.28) ** 2))
        inside = np.abs(d) < 0.5 * road.lane_width
        factor[inside] *= 1.0 + dirt * rng.uniform(-0.06, 0.06)
        factor += strength * tracks + oil * np.exp(-((d / 0.4) ** 2))
    return np.ascontiguousarray((colour * factor[:, None]).T, np.float32)


def _texture(rng: np.random.Generator, ground: Ground, dirt: float) -> Float[np.ndarray, "h w"]:
    """Return factors about 1: blotches along the road, and grain where pixels are small enough to show it."""
    import cv2

    tile, factor = noise_tile(), np.ones_like(ground.s)
    # Cell along and across the road (metres) and strength; each fades where a pixel covers more than a few cells.
    for along, across, strength in ((0.9, 0.22, 0.025 + 0.05 * dirt), (0.03, 0.015, 0.06 + 0.05 * dirt)):
        shift = rng.uniform(0.0, TILE, 2).astype(np.float32)
        seen = strength * np.clip(8.0 * along / ground.length - 1.0, 0.0, 1.0).astype(np.float32)
        near = slice(int(np.argmax(seen > 0.0)), None)
        values = cv2.remap(
            tile,
            ground.offset[near] * np.float32(1.0 / across) + shift[0],
            ground.s[near] * np.float32(1.0 / along) + shift[1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        values *= seen[near, None]
        factor[near] += values
    return factor

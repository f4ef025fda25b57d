"""The ground of a map as a mipmapped texture: drawing it, and sampling it for a camera.

A window of the ground is drawn once in global coordinates, so that texture and paint are the same for every camera, and
then halved repeatedly. A camera samples the level whose texels are about as large as the pixel's footprint (Williams
1983, "Pyramidal Parametrics"), so that thin paint fades with distance without aliasing.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from tflane_jax.scene.logs import VectorMap
from tflane_jax.world.cameras.ground_window import NOISE_SIGMA, Window, ground_noise
from tflane_jax.world.cameras.paint import Paint
from tflane_jax.world.render.polygons import SHIFT
from tflane_jax.world.roads.area import road_rings

# cv2 also fills the texels under an antialiased edge, which widens shapes by this, texels.
_GROWTH = 1.4
_KERB, _SIDEWALK = 0.22, 3.2
_GRASS = ((0.27, 0.33, 0.15), (0.33, 0.36, 0.19), (0.4, 0.37, 0.25), (0.22, 0.29, 0.13))
_PAVING = ((0.55, 0.53, 0.5), (0.5, 0.5, 0.5), (0.58, 0.53, 0.47))
# Cell sizes of the ground's blotches and grain and of worn paint, metres.
_BLOTCH, _GRAIN, _PATCH = 0.96, 0.04, 0.16
# Largest ratio of footprint length to width that is averaged along its length; beyond it, samples blur sideways.
_STRETCH = 5.0


@dataclass(frozen=True)
class Ground:
    """A window of the ground: a mipmap of its albedo.

    Attributes:
        window: of the first level; each further one halves it.
        levels: (rows, columns, 3) each, RGB.
    """

    window: Window
    levels: tuple[UInt8[np.ndarray, "_ _ 3"], ...]

    @functools.cached_property
    def beyond(self) -> tuple[float, float, float]:
        """Colour of the ground outside the window: the median of its border."""
        coarse = self.levels[-1]
        border = np.concatenate([coarse[0], coarse[-1], coarse[:, 0], coarse[:, -1]])
        red, green, blue = np.median(border, 0).tolist()
        return red, green, blue


def draw_ground(
    rng: np.random.Generator,
    vector_map: VectorMap,
    paint: Paint,
    window: Window,
    *,
    dirt: float,
    wet: float,
    urban: bool,
    levels: int = 6,
) -> Ground:
    """Draw a window of the ground.

    Args:
        rng: stream of colours and dirt; the same stream gives the same ground in every window.
        vector_map, paint: roads and their paint.
        window: what to draw.
        dirt: 0 (spotless asphalt) to 1.
        wet: 0 to 1, darkens.
        urban: paved beside the road.
        levels: how many levels to make, the first included; at most 6.
    """
    import cv2

    grass = np.array(_GRASS[rng.integers(len(_GRASS))]) * rng.uniform(0.85, 1.15)
    paving = np.array(_PAVING[rng.integers(len(_PAVING))]) * rng.uniform(0.85, 1.1)
    asphalt = rng.uniform(0.27, 0.44) * (1.0 + rng.uniform(-0.02, 0.04) * np.array([1.0, 0.2, -1.0]))
    image = np.empty((window.rows, window.columns, 3), np.uint8)
    image[:] = _bytes(grass)
    road = [window.fixed(ring) for ring in road_rings(vector_map.road_boundaries)]
    kerbs = [window.fixed(line[:, :2]) for line in vector_map.road_boundaries]

    def stroke(lines: Sequence[np.ndarray], width: float, colour: np.ndarray, line_type: int = cv2.LINE_8) -> None:
        thickness = max(1, round(width / window.texel))
        cv2.polylines(image, lines, False, _bytes(colour), thickness, line_type, SHIFT)

    if urban:
        stroke(kerbs, 2.0 * _SIDEWALK, paving)
    if road:
        cv2.fillPoly(image, road, _bytes(asphalt), cv2.LINE_8, SHIFT)
    for ring in road[1:] if urban else ():
        _pave_small_islands(image, ring, paving, window)
    _wear_asphalt(rng, image, vector_map, window, asphalt, dirt)
    if not road:
        _pave_lanes(image, vector_map, window, asphalt)
    stroke(kerbs, _KERB, np.array([0.66, 0.65, 0.62]), cv2.LINE_AA)
    _texture(image, window, dirt)
    _add_paint(image, paint, window)
    if wet:
        cv2.convertScaleAbs(image, image, 1.0 - 0.3 * wet)
    pyramid: list[np.ndarray] = [image]
    while len(pyramid) < levels and min(pyramid[-1].shape[:2]) > 4:
        h, w = pyramid[-1].shape[:2]
        pyramid.append(cv2.resize(pyramid[-1], (-(-w // 2), -(-h // 2)), interpolation=cv2.INTER_AREA))
    return Ground(window, tuple(pyramid))


def _bytes(colour: Float[np.ndarray, "3"]) -> list[float]:
    return (255.0 * np.clip(colour, 0.0, 1.0)).tolist()


def _pave_small_islands(image: np.ndarray, ring: np.ndarray, paving: np.ndarray, window: Window) -> None:
    """Pave medians; large islands keep their grass."""
    import cv2

    metres = ring.astype(np.float32) * (window.texel / (1 << SHIFT))
    if abs(cv2.contourArea(metres)) < 120.0:
        cv2.fillPoly(image, [ring], _bytes(0.9 * paving), cv2.LINE_8, SHIFT)


def _pave_lanes(image: np.ndarray, vector_map: VectorMap, window: Window, asphalt: np.ndarray) -> None:
    """Pave the lanes of a map that has no road boundaries."""
    import cv2

    for segment in vector_map.segments.values():
        ring = np.concatenate([segment.left[:, :2], segment.right[::-1, :2]])
        cv2.fillPoly(image, [window.fixed(ring)], _bytes(asphalt), cv2.LINE_8, SHIFT)


def _wear_asphalt(
    rng: np.random.Generator, image: np.ndarray, vector_map: VectorMap, window: Window, asphalt: np.ndarray, dirt: float
) -> None:
    """Draw the darker tracks of tyres, patches and cracks."""
    import cv2

    tone = rng.uniform(0.88, 1.06)
    for segment in vector_map.segments.values():
        middle, left = segment.centerline[:, :2], segment.left
        width = float(np.linalg.norm(left[0, :2] - middle[0]))
        step = np.gradient(middle, axis=0)
        normal = np.stack([-step[:, 1], step[:, 0]], -1) / np.maximum(np.linalg.norm(step, axis=-1), 1e-6)[:, None]
        tracks = [window.fixed(middle + side * 0.42 * width * normal) for side in (-1.0, 1.0)]
        shade = asphalt * (1.0 + dirt * (tone - 1.0))
        cv2.polylines(image, tracks, False, _bytes(shade), max(1, round(0.5 / window.texel)), cv2.LINE_8, SHIFT)
    if not dirt or not vector_map.segments:
        return
    lines = [segment.centerline[:, :2] for segment in vector_map.segments.values()]
    lengths = np.array([len(line) for line in lines], float)
    for _ in range(rng.poisson(40 * dirt)):
        line = lines[rng.choice(len(lines), p=lengths / lengths.sum())]
        at, kind = line[rng.integers(len(line) - 1)] + rng.uniform(-1.6, 1.6, 2), rng.random()
        heading = np.arctan2(*(line[1] - line[0])[::-1])
        u, v = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        size, factor = rng.uniform([0.4, 0.3], [4.0, 1.2]), rng.uniform(0.7, 1.12)
        wander = rng.normal(0.0, 0.25, (14, 2))
        if kind < 0.45:
            ring = np.array([at - size @ [u, v], at + size @ [u, -v], at + size @ [u, v], at + size @ [-u, v]])
            cv2.fillPoly(image, [window.fixed(ring)], _bytes(asphalt * factor), cv2.LINE_8, SHIFT)
        else:
            crack = at + np.cumsum(0.35 * (u if kind < 0.8 else v) + wander, 0)
            thickness = max(1, round(0.05 / window.texel))
            cv2.polylines(image, [window.fixed(crack)], False, _bytes(0.55 * asphalt), thickness, cv2.LINE_AA, SHIFT)


def _texture(image: UInt8[np.ndarray, "h w 3"], window: Window, dirt: float) -> None:
    """Multiply the colours by blotches and grain that are fixed to the ground, in place."""
    import cv2

    blotches, grain = (0.035 + 0.05 * dirt) * 128.0 / NOISE_SIGMA, (0.05 + 0.03 * dirt) * 128.0 / NOISE_SIGMA
    # Grain finer than a texel averages out.
    grain *= min(1.0, _GRAIN / window.texel)
    middle = 128.0 * (1.0 - blotches - grain)
    factor = cv2.addWeighted(ground_noise(window, _BLOTCH), blotches, ground_noise(window, _GRAIN), grain, middle)
    cv2.multiply(image, cv2.merge([factor, factor, factor]), image, 1.0 / 128.0)


def _add_paint(image: UInt8[np.ndarray, "h w 3"], paint: Paint, window: Window) -> None:
    """Blend paint over the ground, in place; worn paint is missing where the ground is rough."""
    import cv2

    near = np.flatnonzero(window.meets(paint.corners) & (paint.left > 0.02))
    colours, kind = np.unique(paint.colour[near], axis=0, return_inverse=True)
    rough = ground_noise(window, _PATCH) if len(near) and paint.left[near].min() < 0.98 else None
    flat = image.reshape(-1, 3)
    for number, colour in enumerate(colours):
        rows = near[kind == number]
        mask = np.zeros(image.shape[:2], np.uint8)
        corners = window.fixed(_narrowed(paint.corners[rows], paint, rows, window.texel))
        for ring, value in zip(corners, (255.0 * paint.left[rows]).tolist(), strict=True):
            cv2.fillPoly(mask, [ring], value, cv2.LINE_AA, SHIFT)
        painted = np.flatnonzero(mask)
        fraction = mask.ravel()[painted].astype(np.float32) * np.float32(1.0 / 255.0)
        if rough is not None:
            # Partly worn paint is gone in patches; fresh and fully worn paint are uniform.
            height = (rough[np.unravel_index(painted, rough.shape)].astype(np.float32) - 128.0) / NOISE_SIGMA
            fraction *= np.clip(1.0 + 1.6 * (1.0 - fraction) * np.minimum(height, 0.6), 0.0, 1.0)
        base = flat[painted].astype(np.float32)
        base += fraction[:, None] * (255.0 * colour.astype(np.float32) - base)
        flat[painted] = base.astype(np.uint8)


def _narrowed(
    corners: Float[np.ndarray, "n 4 2"], paint: Paint, rows: Int[np.ndarray, " n"], texel: float
) -> Float[np.ndarray, "n 4 2"]:
    """Return quadrilaterals shrunk by what cv2 adds, so that the drawn area is right."""
    width, length = paint.width[rows], paint.length[rows]
    across = np.clip(1.0 - _GROWTH * texel / np.maximum(width, 1e-6), 0.02, 1.0)[:, None, None]
    # Neighbouring pieces of a line touch, so they are shortened by half as much.
    along = np.clip(1.0 - 0.5 * _GROWTH * texel / np.maximum(length, 1e-6), 0.02, 1.0)[:, None, None]
    middle = corners.mean(1, keepdims=True)
    u = 0.25 * (corners[:, 1] + corners[:, 2] - corners[:, 0] - corners[:, 3])[:, None]
    v = 0.25 * (corners[:, 2] + corners[:, 3] - corners[:, 0] - corners[:, 1])[:, None]
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])[None, :, :, None]
    rectangle = middle + signs[:, :, 0] * u + signs[:, :, 1] * v
    narrow = middle + along * signs[:, :, 0] * u + across * signs[:, :, 1] * v
    return corners + narrow - rectangle


def sample_ground(
    ground: Ground,
    x: Float[np.ndarray, "h w"],
    y: Float[np.ndarray, "h w"],
    across: Float[np.ndarray, " h"],
    along: Float[np.ndarray, " h"],
) -> Float[np.ndarray, "h w 3"]:
    """Return the ground's colours (0 to 255, float32) at the global positions seen by an image's pixels.

    Args:
        ground: to sample.
        x, y: float32 metres from `ground.window.low`.
        across, along: size of a pixel's footprint in each row, metres.
    """
    import cv2

    window = ground.window
    footprint = np.sqrt(across * np.minimum(along, _STRETCH * across))
    level = np.clip(np.log2(np.maximum(footprint / window.texel, 1e-6)), 0.0, len(ground.levels) - 1.0)
    result = np.zeros((*x.shape, 3), np.float32)
    for number, texels in enumerate(ground.levels):
        weight = np.maximum(1.0 - np.abs(level - number), 0.0).astype(np.float32)
        rows = np.flatnonzero(weight > 0.0)
        if not len(rows):
            continue
        part = slice(rows[0], rows[-1] + 1)
        scale = np.float32(1.0 / (window.texel * 2**number))
        seen = cv2.remap(
            texels,
            x[part] * scale - np.float32(0.5),
            y[part] * scale - np.float32(0.5),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=ground.beyond,
        )
        result[part] += weight[part, None, None] * seen
    return result

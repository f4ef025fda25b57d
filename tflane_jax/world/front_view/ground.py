"""Inverse projection of a front view: road coordinates (station, offset) and depth of the ground at every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.world.front_view.road import Highway
from tflane_jax.world.render.camera import PinholeCamera, lift
from tflane_jax.world.roads.curves import ReferenceLine

# Road coordinates are computed in every such column and interpolated linearly in between.
_COLUMNS = 16
# Road coordinates are clamped beyond this distance, metres.
FAR = 400.0
_NEWTON_STEPS = 4


@dataclass(frozen=True)
class Ground:
    """The rows of an image below its horizon. Arrays are float32.

    Attributes:
        first_row: image row of row 0 of the arrays.
        s, offset: (h, w) station and offset of the road at each pixel's center, metres.
        depth: (h, w) along the optical axis, metres; `_BEYOND` where a pixel shows no ground.
        length: (h,) metres of road that a row covers.
    """

    first_row: int
    s: Float[np.ndarray, "h w"]
    offset: Float[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    length: Float[np.ndarray, " h"]

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """Where a pixel shows ground."""
        return self.depth < _BEYOND


_BEYOND = 20_000.0


def look_at_ground(camera: PinholeCamera, axis: ReferenceLine) -> Ground:
    """Return the ground seen at each pixel."""
    knots = np.arange(0, camera.width + _COLUMNS, _COLUMNS) + 0.5
    horizon = camera.horizon_rows(np.array([0.0, camera.width])).min()
    first = int(np.clip(np.floor(horizon), 0, camera.height - 1))
    rows = np.arange(first, camera.height) + 0.5
    pixels = np.stack(np.meshgrid(knots, rows), -1)
    xy, seen = camera.ground_at(pixels.reshape(-1, 2))
    distance = np.where(seen, np.hypot(xy[:, 0], xy[:, 1]), FAR)
    # Farther points are moved to distance FAR along their rays, so that all stations lie on the axis.
    s, offset = road_coordinates(axis, xy * np.minimum(1.0, FAR / np.maximum(distance, 1e-9))[:, None])
    coarse = np.stack([s, offset]).reshape(2, *pixels.shape[:2]).astype(np.float32)
    middle = coarse[0, :, len(knots) // 2]
    length = np.abs(np.gradient(middle)) if len(rows) > 1 else np.full(1, FAR)  # of a camera that looks at the sky
    fine = _between_columns(coarse)[..., : camera.width]
    depth = camera.ground_depth(np.arange(camera.width) + 0.5, rows, _BEYOND)
    return Ground(first, fine[0], fine[1], depth, np.maximum(length, 1e-3))


def _between_columns(coarse: Float[np.ndarray, "c h k"]) -> Float[np.ndarray, "c h w"]:
    fraction = (np.arange(_COLUMNS) / _COLUMNS).astype(np.float32)
    fine = np.diff(coarse, axis=-1)[..., None] * fraction
    fine += coarse[..., :-1, None]
    return fine.reshape(*coarse.shape[:-1], -1)


def road_coordinates(
    axis: ReferenceLine, xy: Float[np.ndarray, "k 2"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return station and offset (to the right) of ground points, by Newton's method from s = x.

    The axis must be sampled evenly and not turn back on itself.
    """
    start, spacing, last = axis.s[0], axis.s[1] - axis.s[0], len(axis.s) - 2
    table = np.concatenate([axis.xy, axis.heading[:, None]], 1)

    def from_axis(s):
        """Return the coordinates of the points in the axis frame at s: ahead and to the right."""
        place = (s - start) / spacing
        index = np.clip(place.astype(int), 0, last)
        base = table[index]
        here = base + (place - index)[:, None] * (table[index + 1] - base)
        cos, sin = np.cos(here[:, 2]), np.sin(here[:, 2])
        dx, dy = xy[:, 0] - here[:, 0], xy[:, 1] - here[:, 1]
        return cos * dx + sin * dy, sin * dx - cos * dy

    s = np.clip(xy[:, 0], axis.s[0], axis.s[-1])
    for _ in range(_NEWTON_STEPS):
        s = np.clip(s + from_axis(s)[0], axis.s[0], axis.s[-1])
    return s, from_axis(s)[1]


def image_columns(
    camera: PinholeCamera, road: Highway, offset: Float[np.ndarray, " n"], rows: Float[np.ndarray, " r"], reach: float
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]]:
    """Return where a line along the road crosses image rows: columns and stations.

    Args:
        camera: of the image.
        road: whose axis the line follows.
        offset: of the line at the axis' vertices.
        rows: v, pixels, ascending.
        reach: the line ends at this station.

    Both results are NaN in rows that the line does not reach before it turns back towards the camera.
    """
    axis = road.axis
    keep = axis.s <= reach
    ground = axis.offset(offset)[keep]
    s = axis.s[keep]
    if reach < axis.s[-1]:
        end = road.at(np.array([reach]), np.interp([reach], axis.s, offset))
        ground, s = np.concatenate([ground, end]), np.append(s, reach)
    pixels, depth = camera.image_of(lift(ground))
    pixels, s = pixels[depth > 1.0], s[depth > 1.0]
    # Farther points are higher in the image, up to where the road turns back.
    back = np.flatnonzero(np.diff(pixels[:, 1]) > 1e-9)
    until = back[0] + 1 if len(back) else len(s)
    u, v, s = pixels[:until, 0][::-1], pixels[:until, 1][::-1], s[:until][::-1]
    if len(v) < 2:
        return np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    # Along the road, rows are proportional to inverse distances, so interpolate stations there.
    inside = (rows >= v[0]) & (rows <= v[-1])
    columns, stations = np.interp(rows, v, u), np.interp(rows, v, s)
    return np.where(inside, columns, np.nan), np.where(inside, stations, np.nan)

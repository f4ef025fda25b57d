"""The BEV sensor of the world: an evidence raster in the ego frame, as a vision network might deliver it.

Lane paint, road edges, crossings and the visible faces of obstacles are drawn; occluded cells stay empty. Evidence is
degraded: blurred, faded and misplaced with range, worn along lines, with missing and false patches, and worse in bad
weather. All random draws are seeded; the occlusion is exact.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.special import ndtri

from tflane_jax.geometry import BevGrid, PerceptionRange, transform_points
from tflane_jax.limits import Fraction, Positive, PositiveOrZero
from tflane_jax.scene import BevChannel
from tflane_jax.world.bev.line_of_sight import Directions, hidden_points
from tflane_jax.world.bev.map_samples import MapSamples

# Range to which the blur and error settings refer, metres.
_FAR = 50.0
# Knot spacing of the noise for missing patches, false patches and the position error, metres.
_LOST_PATCH, _INVENTED_PATCH, _ERROR_PATCH = 8.0, 2.5, 12.0
# Wavelengths of wear along a line, metres.
_WEAR_WAVES = np.array([60.0, 23.0, 9.0])
# Points around the outline of an obstacle; distance outside its faces at which visibility is tested, and depth of the
# evidence behind a face, metres.
_OUTLINE_POINTS, _OUTSIDE, _DEPTH = 64, 0.02, 0.6
# Brings a blurred line back to nearly full evidence.
_GAIN = 1.4
_WEAR_STREAM, _FRAME_STREAM = 1, 2


@dataclass(frozen=True)
class BevSensorConfig:
    """Grid and strength of every degradation.

    Attributes:
        grid: cells of the raster.
        severity: scales all degradations below, and the log's own weather and paint wear; 0 gives a perfect
            raster in which only occlusion is left.
        sight_range: range at which confidence has fallen to 1/e in clear weather, metres.
        weather_range_loss: fraction of that range lost in the worst weather.
        far_blur: 0 to 1, how much softer evidence is at 50 m.
        far_error: standard deviation of the misplacement along the ray at 50 m, metres.
        lost: fraction of the ground where evidence is missing, in patches.
        invented: fraction of the visible ground with false evidence, for each channel.
        noise: standard deviation of the cell noise; full evidence is 1.
    """

    grid: BevGrid = BevGrid()
    severity: Fraction = 1.0
    sight_range: Positive = 65.0
    weather_range_loss: Fraction = 0.5
    far_blur: Fraction = 0.8
    far_error: PositiveOrZero = 0.8
    lost: Fraction = 0.08
    invented: Fraction = 0.008
    noise: PositiveOrZero = 0.03


def hidden_cells(
    grid: BevGrid, boxes: Float[np.ndarray, "k 7"], buildings: Float[np.ndarray, "b 5"]
) -> Bool[np.ndarray, "h w"]:
    """Return the cells whose center on the ground the sensor cannot see (see `hidden_points`)."""
    lattice = _lattice(grid)
    hidden = hidden_points(lattice.centers, boxes, buildings, directions=lattice.directions)
    return hidden.reshape(grid.rows, grid.columns)


def render_bev(
    samples: MapSamples,
    ego_from_global: Float[np.ndarray, "4 4"],
    boxes: Float[np.ndarray, "k 7"],
    buildings: Float[np.ndarray, "b 5"],
    hidden: Bool[np.ndarray, "h w"],
    *,
    weather: float,
    paint_wear: float,
    log_seed: int,
    frame: int,
    config: BevSensorConfig,
) -> UInt8[np.ndarray, "h w 4"]:
    """Return the evidence of one frame, 0 to 255 in the channels of `BevChannel`.

    Args:
        samples: the map, global frame.
        boxes, buildings: obstacles in the ego frame, as `hidden_points` takes them.
        hidden: `hidden_cells` of the same obstacles.
        weather, paint_wear: 0 to 1, see `logs.Log`.
        log_seed: seed of the log; wear depends on it alone, so it is the same in all frames.
        frame: number of the frame in the log.
    """
    severity, lattice = config.severity, _lattice(config.grid)
    weather, paint_wear = min(weather * severity, 1.0), min(paint_wear * severity, 1.0)
    rng = np.random.default_rng([log_seed, _FRAME_STREAM, frame])
    visible = _smooth((~hidden).astype(np.float32)[None])[0]
    error = config.far_error * severity * lattice.noise(rng, 1, _ERROR_PATCH)[0]

    worn = paint_left(samples.paint_line, samples.paint_along, samples.lines, paint_wear, log_seed)
    crisp = _draw_ground(samples, ego_from_global, lattice, visible, error, worn)
    crisp[BevChannel.OBSTACLE] = _draw_obstacles(boxes, buildings, lattice, error)
    evidence = _soften(crisp, lattice, severity, config.far_blur)

    reach = config.sight_range * (1.0 - config.weather_range_loss * weather)
    evidence *= np.exp(-severity * (lattice.range / reach) ** 2)
    lost = min(config.lost * severity * (1.0 + weather), 1.0)
    evidence *= np.clip((lattice.noise(rng, 1, _LOST_PATCH) - ndtri(lost)) * 2.0 + 0.5, 0.0, 1.0)
    invented = min(config.invented * severity * (1.0 + weather), 1.0)
    patches = lattice.noise(rng, len(BevChannel), _INVENTED_PATCH) + ndtri(invented)
    # Ground evidence is masked by visibility. Obstacle faces are not: a visible face hides the ground below itself.
    evidence[: BevChannel.OBSTACLE] *= visible
    evidence += visible * np.clip(patches * 0.8, 0.0, 0.6)
    noise = rng.standard_normal(evidence.shape, np.float32)
    evidence += config.noise * severity * (1.0 + weather) * noise
    return np.round(255.0 * np.clip(evidence, 0.0, 1.0)).astype(np.uint8).transpose(1, 2, 0)


@dataclass(frozen=True)
class _Lattice:
    """A grid with values that every frame needs: cell centers (H W, 2), their directions and range (H, W), metres."""

    grid: BevGrid
    centers: np.ndarray
    directions: Directions
    range: np.ndarray

    def noise(self, rng: np.random.Generator, channels: int, patch: float) -> Float[np.ndarray, "c h w"]:
        """Return smooth noise of about unit variance that varies over `patch` metres."""
        size_x, size_y = self.grid.range.size(2)
        rows = _upsampling(self.grid.rows, size_y / patch)
        columns = _upsampling(self.grid.columns, size_x / patch)
        coarse = rng.standard_normal((channels, rows.shape[1], columns.shape[1]), np.float32)
        return rows @ coarse @ columns.T

    def splat(self, points: np.ndarray, channel: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "c h w"]:
        """Add points (M, 2) with weights to the four cells around each; points outside are ignored."""
        h, w = self.grid.rows, self.grid.columns
        pixel = self.grid.pixel(points)
        corner = np.floor(pixel).astype(int)
        fraction = pixel - corner
        total = np.zeros(len(BevChannel) * h * w)
        for dx in (0, 1):
            for dy in (0, 1):
                column, row = corner[:, 0] + dx, corner[:, 1] + dy
                share = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1]) * weight
                inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
                cell = (channel * h + row) * w + column
                total += np.bincount(cell[inside], share[inside], minlength=len(total))
        return total.reshape(len(BevChannel), h, w).astype(np.float32)

    def cell_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest cell (row, column) of each point (M, 2), clamped to the grid."""
        column, row = np.round(self.grid.pixel(points)).astype(int).T
        return np.clip(row, 0, self.grid.rows - 1), np.clip(column, 0, self.grid.columns - 1)


@functools.lru_cache(maxsize=8)
def _lattice(grid: BevGrid) -> _Lattice:
    x, y = np.meshgrid(*grid.centers())
    centers = np.stack([x.ravel(), y.ravel()], -1)
    return _Lattice(grid, centers, Directions.of(centers), np.hypot(x, y).astype(np.float32))


@functools.lru_cache(maxsize=32)
def _upsampling(cells: int, patches: float) -> Float[np.ndarray, "cells knots"]:
    """Return the matrix that interpolates `cells` values from knots, each row of unit norm (unit variance)."""
    knots = max(int(np.ceil(patches)), 1) + 1
    at = np.linspace(0.0, knots - 1, cells)
    matrix = np.maximum(1.0 - np.abs(at[:, None] - np.arange(knots)), 0.0)
    return (matrix / np.linalg.norm(matrix, axis=-1, keepdims=True)).astype(np.float32)


def paint_left(
    line: Int[np.ndarray, " m"], along: Float[np.ndarray, " m"], lines: int, paint_wear: float, log_seed: int
) -> Float[np.ndarray, " m"]:
    """Return the fraction of paint left at each point, 0 to 1; it varies smoothly along a line and between lines.

    Args:
        line, along: the painted line (as `map_samples.painted_lines` numbers it) and the distance along it, metres.
        lines: number of painted lines.
        paint_wear: 0 to 1, see `logs.Log`.
        log_seed: seed of the log; wear depends on it alone.
    """
    rng = np.random.default_rng([log_seed, _WEAR_STREAM])
    phase = rng.uniform(0.0, 2 * np.pi, (lines, len(_WEAR_WAVES)))
    level = rng.standard_normal(lines)
    wave = np.sin(along[:, None] * (2 * np.pi / _WEAR_WAVES) + phase[line]).sum(-1)
    spread = 0.8 * paint_wear * (1.0 - paint_wear)
    return np.clip(1.0 - paint_wear + spread * (wave + level[line]), 0.0, 1.0)


def _draw_ground(
    samples: MapSamples,
    ego_from_global: np.ndarray,
    lattice: _Lattice,
    visible: np.ndarray,
    error: np.ndarray,
    worn: np.ndarray,
) -> Float[np.ndarray, "c h w"]:
    parts = (samples.paint, samples.edge, samples.crossing)
    channels = [BevChannel.LANE_PAINT, BevChannel.ROAD_EDGE, BevChannel.CROSSING]
    channel = np.repeat(channels, [len(p) for p in parts])
    weight = np.concatenate([worn, np.ones(len(samples.edge) + len(samples.crossing))])
    points = transform_points(ego_from_global, np.concatenate(parts))[:, :2]
    near = _margin(lattice.grid.range, 3.0).contains(points)
    points, channel, weight = points[near], channel[near], weight[near]
    weight = weight * visible[lattice.cell_of(points)]
    return np.minimum(lattice.splat(_misplace(points, lattice, error), channel, weight), 1.0)


def _draw_obstacles(
    boxes: np.ndarray, buildings: np.ndarray, lattice: _Lattice, error: np.ndarray
) -> Float[np.ndarray, "h w"]:
    """Draw the faces visible at half their height; parked and moving boxes look the same."""
    drawn = boxes[_margin(lattice.grid.range, 10.0).contains(boxes[:, :2])]
    outline, inward = _outlines(drawn)
    height = np.repeat(drawn[:, 6] + drawn[:, 5] / 2, _OUTLINE_POINTS)
    seen = ~hidden_points(outline - _OUTSIDE * inward, boxes, buildings, target_height=height)
    outline, inward = outline[seen], inward[seen]
    points = _misplace(np.concatenate([outline, outline + _DEPTH * inward]), lattice, error)
    channel = np.full(len(points), BevChannel.OBSTACLE)
    return np.minimum(lattice.splat(points, channel, np.ones(len(points)))[BevChannel.OBSTACLE], 1.0)


def _outlines(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points around each box, equally many on each face, and the unit vectors into the box there."""
    side = (np.arange(_OUTLINE_POINTS // 4) + 0.5) / (_OUTLINE_POINTS // 4) - 0.5
    half = np.full_like(side, 0.5)
    faces = ((half, side), (-half, side), (side, half), (side, -half))
    unit = np.concatenate([np.stack(face, -1) for face in faces])
    normal = np.repeat([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]], len(side), axis=0)
    cos, sin = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
    rotation = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)
    points = (unit * boxes[:, None, 2:4]) @ rotation + boxes[:, None, :2]
    return points.reshape(-1, 2), (normal @ rotation).reshape(-1, 2)


def _misplace(points: np.ndarray, lattice: _Lattice, error: np.ndarray) -> np.ndarray:
    """Move points along their rays by the error field, which is given at 50 m and grows with the range squared."""
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    return points * (1.0 + error[lattice.cell_of(points)][:, None] * distance / _FAR**2)


def _margin(range_: PerceptionRange, metres: float) -> PerceptionRange:
    (x0, x1), (y0, y1) = range_.x, range_.y
    return PerceptionRange((x0 - metres, x1 + metres), (y0 - metres, y1 + metres), range_.z)


def _soften(crisp: np.ndarray, lattice: _Lattice, severity: float, far_blur: float) -> Float[np.ndarray, "c h w"]:
    near = _smooth(crisp)
    far = _smooth(_smooth(_smooth(near)))
    share = np.clip(far_blur * severity * lattice.range / _FAR, 0.0, 1.0)
    soft = np.minimum(_GAIN * ((1.0 - share) * near + share * far), 1.0)
    return crisp + min(severity, 1.0) * (soft - crisp)


def _smooth(image: np.ndarray) -> np.ndarray:
    """Blur by (1, 2, 1) / 4 along rows and columns, repeating the border."""
    rows = np.concatenate([image[:, :1], image, image[:, -1:]], 1)
    image = 0.25 * (rows[:, :-2] + rows[:, 2:]) + 0.5 * image
    columns = np.concatenate([image[:, :, :1], image, image[:, :, -1:]], 2)
    return 0.25 * (columns[:, :, :-2] + columns[:, :, 2:]) + 0.5 * image

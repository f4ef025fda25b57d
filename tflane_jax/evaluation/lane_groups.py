"""Groups of true lanes by what the sensor shows of them and by the traffic near them.

A prior from traffic should help on lanes that the sensor hardly shows and that vehicles drive along. Lanes that the
sensor hardly shows and that no vehicle touched are the negative control of a comparison.

Both fractions are computed from the example alone, so that a lane is in the same group for every model. They are taken
over `SAMPLES` points, equally spaced along the lane.

- **shown**: the evidence raster has lane paint or a road edge, at least `EVIDENCE` of full evidence, within `TOLERANCE`
  of the lane's left or right boundary. Ground out of sight, beyond the sensor's range, with worn paint or without paint
  (lanes across a junction) shows nothing.
- **driven**: a vehicle passed within `BESIDE` of the point, with a heading within `HEADING` of the lane's direction.

| group | shown fraction | traffic |
|---|---|---|
| `hidden+traffic` | below `HALF` | driven fraction at least `HALF` |
| `hidden-traffic` | below `HALF` | no vehicle came within `NEARBY` of the points, in any direction |
| `visible+traffic`, `visible-traffic` | at least `HALF` | the same |
| `hidden-neighbours` | below `HALF` | no vehicle came within `NEXT_LANE` of the points |

Lanes with some traffic, but along less than half of their length, are in none of the first four groups; lanes whose
boundaries are not known, both without length, are in none at all. Lanes of the control may have traffic in the lane
beside them, which indicates them too; `hidden-neighbours`, a subset of the control, excludes that, but has few lanes.

Lines of a vector map have the same groups (`line_groups`). A line is shown by evidence on itself, a crossing by its
stripes, a centerline by paint or edges within `HALF_LANE` more. Traffic along a line passes within `HALF_LANE` more and
in either direction, because vehicles drive beside dividers and boundaries; a line without traffic has none in the lanes
on both sides of it, within `NEARBY_LINE`, and of `hidden-neighbours` none within twice that.

Traffic is the history of the example before any selection: its valid, not occluded frames,
and straight lines between successive ones. Pedestrians do not count.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import maximum_filter

from tflane_jax.geometry import BevGrid, PerceptionRange, resample_lines, wrap_angle
from tflane_jax.scene import BevChannel, LaneGraph, LineClass, MapLines, RoadUser, TrafficFlow

_EDGES = (BevChannel.LANE_PAINT, BevChannel.ROAD_EDGE)
LANE_GROUPS = ("hidden+traffic", "hidden-traffic", "visible+traffic", "visible-traffic", "hidden-neighbours")
SAMPLES = 25
EVIDENCE = 64  # of 255
TOLERANCE = 1.0  # metres
BESIDE = 1.5  # metres
HEADING = np.radians(30.0)
NEARBY, NEXT_LANE = 2.5, 5.0  # metres; lanes are 3 to 3.75 m wide
HALF = 0.5
HALF_LANE, NEARBY_LINE = 1.25, 3.5  # metres


def lane_groups(
    lanes: LaneGraph, bev: UInt8[np.ndarray, "h w c"], flow: TrafficFlow, ground: PerceptionRange
) -> dict[str, Bool[np.ndarray, " g"]]:
    """Return for each of `LANE_GROUPS` which of the G valid lanes, in their order, belong to it.

    Args:
        lanes, bev, flow: of one example; padding may hold anything.
        ground: the range that `bev` covers.
    """
    valid = np.asarray(lanes.valid)
    center, left, right = (np.asarray(x)[valid] for x in (lanes.points, lanes.left, lanes.right))
    hidden = shown_fraction(left, right, bev, ground) < HALF
    driven, distance = driven_fraction(center, flow)
    bounded = np.concatenate([np.ptp(left, axis=1), np.ptp(right, axis=1)], axis=-1).any(-1)
    found = _groups(hidden, driven >= HALF, distance > NEARBY, distance > NEXT_LANE)
    return {name: members & bounded for name, members in found.items()}


def line_groups(
    lines: MapLines, bev: UInt8[np.ndarray, "h w c"], flow: TrafficFlow, ground: PerceptionRange
) -> dict[str, Bool[np.ndarray, " g"]]:
    """Return for each of `LANE_GROUPS` which of the G valid lines of a vector map, in their order, belong to it."""
    valid = np.asarray(lines.valid)
    points, category = np.asarray(lines.points)[valid], np.asarray(lines.category)[valid]
    shown = np.zeros(len(points))
    for kind in LineClass:
        mine = category == kind
        channels = (BevChannel.CROSSING,) if kind == LineClass.CROSSING else _EDGES
        tolerance = TOLERANCE + (HALF_LANE if kind == LineClass.CENTERLINE else 0.0)
        shown[mine] = shown_fraction(points[mine], points[mine], bev, ground, channels=channels, tolerance=tolerance)
    driven, distance = driven_fraction(points, flow, beside=BESIDE + HALF_LANE, directions="both")
    return _groups(shown < HALF, driven >= HALF, distance > NEARBY_LINE, distance > 2.0 * NEARBY_LINE)


def _groups(hidden: np.ndarray, traffic: np.ndarray, none: np.ndarray, remote: np.ndarray) -> dict[str, np.ndarray]:
    groups = hidden & traffic, hidden & none, ~hidden & traffic, ~hidden & none, hidden & remote
    return dict(zip(LANE_GROUPS, groups, strict=True))


def shown_fraction(
    left: Float[np.ndarray, "g n 3"],
    right: Float[np.ndarray, "g n 3"],
    bev: UInt8[np.ndarray, "h w c"],
    ground: PerceptionRange,
    *,
    channels: tuple[BevChannel, ...] = _EDGES,
    tolerance: float = TOLERANCE,
) -> Float[np.ndarray, " g"]:
    """Return the fraction of each lane's length at which the raster shows its left or right boundary.

    Args:
        left, right: boundaries in driving direction, metres, ego frame.
        bev: evidence in the channels of `BevChannel`; it must cover `ground`.
        ground: the range that `bev` covers; nothing is shown outside.
        channels: of the evidence that counts.
        tolerance: distance of the evidence, metres.
    """
    grid = BevGrid(ground, *bev.shape[:2])
    window = [2 * round(tolerance / size) + 1 for size in reversed(grid.cell)]  # cells along y and x
    evidence = np.asarray(bev)[..., list(channels)].max(-1)
    shown = maximum_filter(evidence, window, mode="constant") >= EVIDENCE
    found = np.zeros((len(left), SAMPLES), bool)
    for line in (left, right):
        points = _samples(line)
        column, row = np.moveaxis(np.round(grid.pixel(points)).astype(int), -1, 0)
        row, column = np.clip(row, 0, grid.rows - 1), np.clip(column, 0, grid.columns - 1)
        found |= shown[row, column] & ground.contains(points)
    return found.mean(-1)


def driven_fraction(
    points: Float[np.ndarray, "g n 3"],
    flow: TrafficFlow,
    *,
    beside: float = BESIDE,
    directions: Literal["same", "both"] = "same",
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """Return the fraction of each lane's length that vehicles drove along, and the least distance of any vehicle.

    Args:
        points: centerlines in driving direction, metres, ego frame.
        flow: tracks; padding may hold anything.
        beside: distance at which a vehicle drives along a point, metres.
        directions: of travel that count: that of the line, or both.

    Returns:
        Fractions, and distances in metres between vehicle centers and the sampled points of the lane; inf without
        vehicles.
    """
    start, step, yaw, turn = _pieces(flow)
    line = _samples(points).astype(np.float32)
    direction = np.arctan2(*np.moveaxis(np.gradient(line, axis=1), -1, 0)[::-1])
    # Coordinate by coordinate: a last axis of two would be several times slower.
    (x, y), (step_x, step_y) = np.moveaxis(line[:, :, None] - start, -1, 0), step.T
    length = step_x**2 + step_y**2
    along = np.clip((x * step_x + y * step_y) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    distance = np.sqrt((x - along * step_x) ** 2 + (y - along * step_y) ** 2)
    lane, sample, piece = np.nonzero(distance <= beside)
    heading = yaw[piece] + along[lane, sample, piece] * turn[piece]
    turned = np.abs(wrap_angle(heading - direction[lane, sample]))
    aligned = (np.minimum(turned, np.pi - turned) if directions == "both" else turned) <= HEADING
    driven = np.zeros(line.shape[:2], bool)
    driven[lane[aligned], sample[aligned]] = True
    return driven.mean(-1), distance.min((1, 2), initial=np.inf)


def _pieces(flow: TrafficFlow) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the straight pieces of all tracks: start (M, 2), step (M, 2), yaw at the start (M,), turn (M,).

    A frame without a successor gives a piece of length zero.
    """
    vehicle = np.asarray(flow.category) != RoadUser.PEDESTRIAN
    seen = np.asarray(flow.valid) & ~np.asarray(flow.occluded) & vehicle[:, None]
    instance, frame = np.nonzero(seen)
    following = np.minimum(frame + 1, seen.shape[1] - 1)
    following = np.where(seen[instance, following], following, frame)
    position, yaw = np.asarray(flow.position)[..., :2], np.asarray(flow.yaw)
    start, heading = position[instance, frame], yaw[instance, frame]
    return start, position[instance, following] - start, heading, wrap_angle(yaw[instance, following] - heading)


def _samples(lines: Float[np.ndarray, "g n 3"]) -> Float[np.ndarray, "g s 2"]:
    return resample_lines(list(lines), SAMPLES)[..., :2]

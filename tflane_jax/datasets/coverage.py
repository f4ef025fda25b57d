"""What the input of an example says about its lanes: how much of them evidence shows, and how much traffic drove on.

Line of sight is a part of the truth (`LaneGraph.visibility`); these two are measured on what a model gets.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.scene import BevChannel, LaneGraph, RoadUser, TrafficFlow

# A box shows a lane point if it is as near as this, metres, and heads along the lane up to this, radians.
_ON_LANE, _ALONG = 1.5, np.deg2rad(30.0)
# Evidence counts from this fraction of full evidence.
_SHOWN = 0.25


def observed_frames(flow: TrafficFlow, range_: PerceptionRange) -> Bool[np.ndarray, "k n"]:
    """Return in which frames each road user was seen inside the range, as the traffic-flow prior counts them."""
    inside = range_.contains(np.where(flow.valid[..., None], flow.position, 0.0))
    return np.asarray(flow.valid & ~flow.occluded & inside)


def covered_by_traffic(lanes: LaneGraph, flow: TrafficFlow, range_: PerceptionRange) -> Bool[np.ndarray, "l p"]:
    """Return which points of the lanes a vehicle or bicycle drove over in the history; False where not valid.

    A box counts if it was seen inside the range, is within 1.5 m of the point and within 30 degrees of the lane.
    """
    boxes = observed_frames(flow, range_) & (flow.category != RoadUser.PEDESTRIAN)[:, None]
    at, yaw = np.asarray(flow.position)[boxes][:, :2], np.asarray(flow.yaw)[boxes]
    points = np.where(lanes.valid[:, None, None], lanes.points, 0.0)[..., :2]
    near = np.linalg.norm(points[:, :, None] - at, axis=-1) < _ON_LANE
    turned = _heading(points)[:, :, None] - yaw
    along = np.abs((turned + np.pi) % (2 * np.pi) - np.pi) < _ALONG
    return (near & along).any(-1) & lanes.valid[:, None]


def covered_by_evidence(lanes: LaneGraph, bev: UInt8[np.ndarray, "h w c"], grid: BevGrid) -> Bool[np.ndarray, "l p"]:
    """Return at which points of the lanes the raster shows paint or a road edge; False where not valid.

    It is looked for in the 3 x 3 cells around the left and around the right boundary there.
    """
    shown = bev[..., [BevChannel.LANE_PAINT, BevChannel.ROAD_EDGE]].max(-1) >= 255 * _SHOWN
    wide = np.pad(shown, 1)
    shown = np.any([wide[i : i + grid.rows, j : j + grid.columns] for i in range(3) for j in range(3)], axis=0)
    return (_value_at(shown, lanes.left, grid) | _value_at(shown, lanes.right, grid)) & lanes.valid[:, None]


def _value_at(raster: np.ndarray, points: np.ndarray, grid: BevGrid) -> Bool[np.ndarray, "l p"]:
    """Return the raster's cell at each point; False outside."""
    finite = np.where(np.isfinite(points), points, 0.0)
    column, row = np.round(grid.pixel(finite[..., :2])).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
    return inside & raster[np.clip(row, 0, grid.rows - 1), np.clip(column, 0, grid.columns - 1)]


def _heading(points: Float[np.ndarray, "l p 2"]) -> Float[np.ndarray, "l p"]:
    """Return the heading of the lanes at each of their points, radians."""
    step = np.gradient(points, axis=1)
    return np.arctan2(step[..., 1], step[..., 0])

"""Quantities of one example for `tflane data stats`: lanes and map lines, by evidence and traffic, and the traffic."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.evaluation.lane_groups import HALF, driven_fraction, lane_groups
from tflane_jax.geometry import PerceptionRange, line_lengths
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.scene import Example, LaneGraph, LineClass, MapLines, RoadUser, TrafficFlow

# A lane is out of sight below this visibility, as in the metrics.
_HIDDEN = 0.5
# A vehicle that moves less during its observed frames stands, metres: more than the tracker's noise.
_STANDS = 1.5


def example_stats(example: Example, config: ExampleConfig) -> dict[str, float]:
    """Return the quantities of one example by name.

    Traffic is left out where no track is valid in the oldest frame: a history that begins before the recording would
    look sparser than it is.
    """
    lanes, flow = example.lanes, example.traffic_flow
    driven = None
    if flow is not None and flow.valid[:, 0].any():
        driven, _ = driven_fraction(np.asarray(lanes.points)[lanes.valid], flow)
    found = _lane_stats(lanes, driven)
    if flow is not None and driven is not None and example.bev is not None:
        groups, metres = lane_groups(lanes, np.asarray(example.bev), flow, config.ground), _metres(lanes)
        found |= {f"lanes {name}": members.sum() for name, members in groups.items()}
        found |= {f"metres of lanes {name}": metres[members].sum() for name, members in groups.items()}
    if flow is not None and driven is not None:
        found |= _traffic_stats(flow, config)
    return found if example.map_lines is None else found | _line_stats(example.map_lines)


def _line_stats(lines: MapLines) -> dict[str, float]:
    """Return the number and the length of the lines of a vector map by class."""
    valid, category = np.asarray(lines.valid), np.asarray(lines.category)
    metres = line_lengths(np.where(valid[:, None, None], np.asarray(lines.points), 0.0))
    found = {}
    for kind in LineClass:
        chosen, name = valid & (category == kind), kind.name.lower()
        found |= {f"lines, {name}": chosen.sum(), f"metres of {name}": metres[chosen].sum()}
    return found


def _lane_stats(lanes: LaneGraph, driven: Float[np.ndarray, " g"] | None) -> dict[str, float]:
    """Return the quantities of lanes; `driven` is the fraction of each valid lane that vehicles drove along."""
    valid = np.asarray(lanes.valid)
    hidden = np.asarray(lanes.visibility)[valid] < _HIDDEN
    metres = _metres(lanes)
    found = {
        "lanes": valid.sum(),
        "lanes out of sight": hidden.sum(),
        "metres of lane": metres.sum(),
        "topology links": (lanes.successor & valid[:, None] & valid).sum(),
    }
    if driven is not None:
        found["lanes out of sight with traffic"] = (hidden & (driven >= HALF)).sum()
        if metres.sum() > 0:
            found["fraction of lane length driven on"] = (driven * metres).sum() / metres.sum()
    return found


def _metres(lanes: LaneGraph) -> Float[np.ndarray, " g"]:
    """Return the lengths of the valid lanes."""
    return line_lengths(np.asarray(lanes.points)[np.asarray(lanes.valid)])


def _traffic_stats(flow: TrafficFlow, config: ExampleConfig) -> dict[str, float]:
    """Return what the traffic-flow prior would take, at its default settings, with unlimited slots."""
    prior, frames = TrafficFlowPriorConfig(), _observed_frames(flow, config.range)
    number = frames.sum(-1)
    taken = number >= prior.min_valid_frames
    position = np.where(frames[..., None], flow.position, np.nan)[taken, :, :2]
    moved = np.nanmax(np.linalg.norm(position - _first(position, frames[taken]), axis=-1), -1, initial=0.0)
    category = np.asarray(flow.category)[taken]
    vehicle = category <= RoadUser.MOTORCYCLE
    found: dict[str, Any] = {
        f"road users in range for {prior.min_valid_frames} frames": taken.sum(),
        "- standing vehicles": (vehicle & (moved < _STANDS)).sum(),
        "- moving vehicles": (vehicle & (moved >= _STANDS)).sum(),
        "- bicycles": (category == RoadUser.BICYCLE).sum(),
        "- pedestrians": (category == RoadUser.PEDESTRIAN).sum(),
        f"examples with more than {prior.max_instances}": taken.sum() > prior.max_instances,
        "tracks at any distance": flow.valid.any(-1).sum(),
    }
    if taken.any():
        found["frames of each in range"] = number[taken].mean()
    return found


def _observed_frames(flow: TrafficFlow, range_: PerceptionRange) -> Bool[np.ndarray, "k n"]:
    """Return in which frames each road user was seen inside the range, as the traffic-flow prior counts them."""
    inside = range_.contains(np.where(flow.valid[..., None], flow.position, 0.0))
    return np.asarray(flow.valid & ~flow.occluded & inside)


def _first(position: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the first valid position of each road user, (k, 1, 2)."""
    return np.take_along_axis(position, frames.argmax(-1)[:, None, None], axis=1)

"""The part of a longer drive that a scene shows: most often one in which the vehicle crosses a junction.

Vehicles wait before junctions for most of the time that they spend near them, and recorded scenes are chosen for what
happens in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.traffic.simulation import Traffic

# When the vehicle is on a connector, as a fraction of the time from the first key frame to the end of the scene: it
# may cross the junction shortly before or after.
_CROSSES = (-0.2, 1.2)
# Farther from the nearest vertex of a lane, the vehicle is on none, metres.
_NEAR = 3.0


def excerpt(
    rng: np.random.Generator,
    lanes: Mapping[int, LaneSegment],
    traffic: Traffic,
    *,
    frames: int,
    history: int,
    rate_hz: float,
) -> Traffic:
    """Return consecutive frames of a drive, while the vehicle is on its route.

    A random frame on a connector becomes frame `history + u (frames - history)` of the result, with u drawn from
    `_CROSSES`: 0 is the first key frame, 1 the end. A drive without such a frame is shown from its start.

    Args:
        rng: stream.
        lanes: that vehicles drive; a map may have connectors at access roads, too, up to the border of the roads.
        traffic: the whole drive, of at least `frames` frames.
        frames: of the result.
        history: frames of the result before its first key frame.
        rate_hz: frames a second.
    """
    last_start = max(min(len(traffic.ego), traffic.on_route) - frames, 0)
    crossing = np.flatnonzero(on_connector(lanes, traffic.ego[: last_start + frames, :2]))
    crossing = crossing[crossing >= history]
    start = 0
    if len(crossing):
        before = history + round(rng.uniform(*_CROSSES) * (frames - history))
        start = min(max(int(rng.choice(crossing)) - before, 0), last_start)

    def still_shown(count: int) -> int:
        """Return how many of the drive's first `count` frames are shown."""
        return min(max(count - start, 0), frames)

    shown = slice(start, start + frames)
    seen = traffic.present[shown].any(0)
    return Traffic(
        xy=traffic.xy[shown, seen],
        yaw=traffic.yaw[shown, seen],
        present=traffic.present[shown, seen],
        size=traffic.size[seen],
        category=traffic.category[seen],
        ego=traffic.ego[shown],
        on_route=still_shown(traffic.on_route),
        signals=replace(traffic.signals, offset=traffic.signals.offset + start / rate_hz),
        on_roads=still_shown(traffic.on_roads),
    )


def on_connector(lanes: Mapping[int, LaneSegment], xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Return at which places, in metres, the nearest lane is one inside an intersection."""
    if not lanes or not len(xy):
        return np.zeros(len(xy), bool)
    vertices = np.concatenate([lane.centerline[:, :2] for lane in lanes.values()])
    sizes = [len(lane.centerline) for lane in lanes.values()]
    inside = np.repeat([lane.is_intersection for lane in lanes.values()], sizes)
    distance, nearest = KDTree(vertices).query(xy)
    return inside[nearest] & (distance < _NEAR)

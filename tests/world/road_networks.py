"""Road networks that several tests share, and the plane geometry that they need."""

from __future__ import annotations

import functools
import math

import numpy as np

from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.networks import RoadConfig, RoadNetwork, SceneKind, build_road_network

CONFIG = RoadConfig()
SEEDS = range(20)
WIDE = (3.2, 6.5)


def _only(kind: SceneKind) -> RoadConfig:
    return RoadConfig(kinds=((kind, 1.0),))


@functools.cache
def network(seed: int, kind: SceneKind | None = None) -> RoadNetwork:
    return build_road_network(np.random.default_rng([11, seed]), CONFIG if kind is None else _only(kind))


@functools.cache
def changing_network(seed: int) -> RoadNetwork:
    """A network of wide lanes and streets, in which lanes open and close where these meet an intersection."""
    config = RoadConfig(lane_changes=1.0, another_lane=0.5, single_lane_width=WIDE)
    return build_road_network(np.random.default_rng([12, seed]), config)


def case_networks() -> list[RoadNetwork]:
    """Twenty draws of the usual mix, two of each kind, and eight with changing lanes."""
    kinds = [network(s, kind) for kind in SceneKind for s in range(2)]
    return [network(s) for s in SEEDS] + kinds + [changing_network(s) for s in range(8)]


def heading(line: np.ndarray, end: int) -> float:
    a, b = (line[-2], line[-1]) if end else (line[0], line[1])
    return math.atan2(b[1] - a[1], b[0] - a[0])


def turn_between(a: LaneSegment, b: LaneSegment) -> float:
    difference = heading(b.centerline, 0) - heading(a.centerline, 1)
    return abs(math.remainder(difference, 2 * math.pi))


def inside_boxes(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(B, P) which points lie in which (x, y, length, width, yaw) boxes."""
    hits = []
    for x, y, length, width, yaw in boxes:
        c, s = math.cos(yaw), math.sin(yaw)
        local = (points - [x, y]) @ np.array([[c, -s], [s, c]])
        hits.append((np.abs(local[:, 0]) < length / 2) & (np.abs(local[:, 1]) < width / 2))
    return np.array(hits).reshape(len(boxes), len(points))


def crossings_of(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n - 1, m - 1) which steps of one polyline properly cross which steps of another."""

    def side(p, q, r):
        area = (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        return np.where(np.abs(area) > 1e-9, np.sign(area), 0.0)  # steps of one straight line touch, not cross

    if (a.min(0)[:2] > b.max(0)[:2]).any() or (b.min(0)[:2] > a.max(0)[:2]).any():
        return np.zeros((len(a) - 1, len(b) - 1), bool)
    p, q = a[:-1, None, :2], a[1:, None, :2]
    u, v = b[None, :-1, :2], b[None, 1:, :2]
    return (side(p, q, u) * side(p, q, v) < 0) & (side(u, v, p) * side(u, v, q) < 0)

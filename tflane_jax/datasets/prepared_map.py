"""A vector map prepared for many frames: lanes in both flavours, packed so that one product moves them all."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.chains import merge_chains
from tflane_jax.geometry import PerceptionRange, transform_points
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.bev.map_samples import MapSamples, sample_map


@dataclass(frozen=True)
class PackedLines:
    """Polylines of a map in one array, so that one matrix product moves all of them into a frame.

    Attributes:
        points: (M, 3) all points, one line after the other.
        ends: (L,) index after the last point of each line.
    """

    points: np.ndarray
    ends: np.ndarray

    @classmethod
    def pack(cls, lines: Sequence[np.ndarray]) -> PackedLines:
        """Pack lines of any length, none empty."""
        ends = np.cumsum([len(line) for line in lines], dtype=int)
        return cls(np.concatenate([np.zeros((0, 3)), *lines]), ends)

    def line(self, number: int) -> Float[np.ndarray, "n 3"]:
        """Return one line (a view)."""
        return self.points[self.ends[number - 1] if number else 0 : self.ends[number]]

    def moved(self, pose: Float[np.ndarray, "4 4"]) -> PackedLines:
        """Return the lines in another frame."""
        return PackedLines(transform_points(pose, self.points), self.ends)

    def near(self, range_: PerceptionRange) -> list[int]:
        """Return the numbers of the lines whose bounding box meets the range."""
        if len(self.ends) == 0:
            return []
        starts = np.concatenate([[0], self.ends[:-1]])
        low = np.minimum.reduceat(self.points[:, :2], starts, axis=0)
        high = np.maximum.reduceat(self.points[:, :2], starts, axis=0)
        range_low, range_high = np.array([range_.x, range_.y]).T
        return np.flatnonzero(((high >= range_low) & (low <= range_high)).all(-1)).tolist()


@dataclass(frozen=True)
class MapLanes:
    """The lanes of a whole map in one flavour.

    Attributes:
        lanes: L lanes, global frame.
        centerline, left, right: L packed lines each.
        edges: (E, 2) lane numbers; the second is a successor of the first.
    """

    lanes: tuple[LaneSegment, ...]
    centerline: PackedLines
    left: PackedLines
    right: PackedLines
    edges: np.ndarray

    @classmethod
    def of(cls, lanes: dict[int, LaneSegment]) -> MapLanes:
        """Number and pack lanes."""
        number = {lane_id: i for i, lane_id in enumerate(lanes)}
        edges = [(number[s.id], number[t]) for s in lanes.values() for t in s.successors if t in number]
        return cls(
            lanes=tuple(lanes.values()),
            centerline=PackedLines.pack([s.centerline for s in lanes.values()]),
            left=PackedLines.pack([s.left for s in lanes.values()]),
            right=PackedLines.pack([s.right for s in lanes.values()]),
            edges=np.array(edges, int).reshape(-1, 2),
        )


@dataclass(frozen=True)
class PreparedMap:
    """A map prepared for many frames.

    Attributes:
        segments, centerlines: its lanes in both flavours.
        chain_of: from segment id to the number of its merged lane in `centerlines`.
        crossings, boundaries: packed lines.
        samples: dense points for the bird's-eye-view sensor.
    """

    segments: MapLanes
    centerlines: MapLanes
    chain_of: dict[int, int]
    crossings: PackedLines
    boundaries: PackedLines
    samples: MapSamples


_PREPARED: dict[tuple[int, bool], PreparedMap] = {}


def prepare_map(vector_map: VectorMap, *, bike_lanes: bool) -> PreparedMap:
    """Merge, pack and sample a map; the result is cached for the lifetime of the map object.

    Args:
        vector_map: global frame.
        bike_lanes: whether to keep bicycle lanes. Whether the official ground truth does is unknown; MapTRv2 does.
    """
    key = (id(vector_map), bike_lanes)
    if key not in _PREPARED:
        _PREPARED[key] = _prepare(vector_map, bike_lanes)
        weakref.finalize(vector_map, _PREPARED.pop, key)
    return _PREPARED[key]


def _prepare(vector_map: VectorMap, bike_lanes: bool) -> PreparedMap:
    kept = {i: s for i, s in vector_map.segments.items() if bike_lanes or s.vehicle}
    merged = merge_chains(kept)
    number = {chain: i for i, chain in enumerate(merged.chains)}
    return PreparedMap(
        segments=MapLanes.of(kept),
        centerlines=MapLanes.of(merged.chains),
        chain_of={segment: number[chain] for segment, chain in merged.chain_of.items()},
        crossings=PackedLines.pack(vector_map.crossings),
        boundaries=PackedLines.pack(vector_map.road_boundaries),
        samples=sample_map(vector_map),
    )

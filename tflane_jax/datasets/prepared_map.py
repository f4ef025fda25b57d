"""A vector map prepared for many frames: lanes in both flavours, packed so that one product moves them all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tflane_jax.datasets.chains import merge_chains
from tflane_jax.datasets.lane_dividers import lane_dividers
from tflane_jax.datasets.map_geometry import MapGeometry
from tflane_jax.datasets.packed_lines import PackedLines
from tflane_jax.recent import KeptWith
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.bev.map_samples import MapSamples, sample_map


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
        dividers: of the map's own record, global metres; None derives them from the sides of lanes.
        samples: dense points for the bird's-eye-view sensor.
    """

    segments: MapLanes
    centerlines: MapLanes
    chain_of: dict[int, int]
    crossings: PackedLines
    boundaries: PackedLines
    dividers: tuple[np.ndarray, ...] | None
    samples: MapSamples

    @cached_property
    def segment_of(self) -> dict[int, int]:
        """From segment id to its number in `segments`."""
        return {segment.id: i for i, segment in enumerate(self.segments.lanes)}

    @cached_property
    def geometry(self) -> MapGeometry:
        """The lines of the map, for `map_lines`; made when first asked for."""
        rings = (self.crossings.line(i) for i in range(len(self.crossings.ends)))
        return MapGeometry.of(
            dividers=lane_dividers(self.segments.lanes) if self.dividers is None else self.dividers,
            crossings=[[ring] for ring in rings],
            boundaries=[self.boundaries.line(i) for i in range(len(self.boundaries.ends))],
            centerlines=[lane.centerline for lane in self.centerlines.lanes],
            edges=self.centerlines.edges,
        )


_PREPARED: KeptWith[PreparedMap] = KeptWith()


def prepare_map(vector_map: VectorMap, *, bike_lanes: bool) -> PreparedMap:
    """Merge, pack and sample a map; the result is cached for the lifetime of the map object. Threads may call it.

    Args:
        vector_map: global frame.
        bike_lanes: whether to keep bicycle lanes. Whether the official ground truth does is unknown; MapTRv2 does.
    """
    return _PREPARED(vector_map, bike_lanes, lambda: _prepare(vector_map, bike_lanes))


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
        dividers=vector_map.dividers,
        samples=sample_map(vector_map),
    )

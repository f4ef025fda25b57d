"""A map as dense points on paint, road edges and crossings, ready to be rasterised.

Sampled once per map in global metres, so that dashes and wear stay fixed to the ground.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tflane_jax.geometry.polylines import arc_length, sample_at
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import VectorMap

# Half a cell of the usual grid, so that no cell on a line is missed, metres.
SPACING = 0.25
# Length of a dash and of dash with gap, metres.
DASH, DASH_PERIOD = 3.0, 9.0


@dataclass(frozen=True)
class MapSamples:
    """Dense points of a map, global metres.

    Attributes:
        paint: (M, 3) on painted lane boundaries.
        paint_line: (M,) number of the line that a paint point is on, from 0 to `lines` - 1.
        paint_along: (M,) distance along that line, metres.
        lines: number of painted lines.
        edge: (E, 3) on road boundaries.
        crossing: (C, 3) all over pedestrian crossings.
    """

    paint: np.ndarray
    paint_line: np.ndarray
    paint_along: np.ndarray
    lines: int
    edge: np.ndarray
    crossing: np.ndarray


def sample_map(vector_map: VectorMap) -> MapSamples:
    """Sample lane boundaries of every type but NONE (dashes only where dashed), road boundaries and crossings."""
    lines = painted_lines(vector_map)
    points, along = [np.zeros((0, 3))], [np.zeros(0)]
    number = [np.zeros(0, int)]
    for i, (line, kind) in enumerate(lines):
        at, reached = _stations(line)
        length = reached[-1]
        if kind == LineType.DASHED:
            # Anchored at the middle, so that the dashes do not depend on the direction of travel.
            at = at[(at - length / 2 + DASH / 2) % DASH_PERIOD < DASH]
        points.append(sample_at(line, at, reached))
        along.append(at)
        number.append(np.full(len(at), i))
    edges = [np.zeros((0, 3)), *(sample_at(line, *_stations(line)) for line in vector_map.road_boundaries)]
    crossings = [np.zeros((0, 3)), *map(_fill, vector_map.crossings)]
    return MapSamples(
        paint=np.concatenate(points),
        paint_line=np.concatenate(number),
        paint_along=np.concatenate(along),
        lines=len(lines),
        edge=np.concatenate(edges),
        crossing=np.concatenate(crossings),
    )


def painted_lines(vector_map: VectorMap) -> list[tuple[np.ndarray, int]]:
    """Return every painted line once: the common boundary of two neighbours is in the map twice."""
    found: dict[tuple[float, ...], tuple[np.ndarray, int]] = {}
    for line, kind in _boundaries(vector_map):
        if kind != LineType.NONE and len(line) > 1:
            found.setdefault(line_key(line), (line, kind))
    return list(found.values())


def line_key(line: np.ndarray) -> tuple[float, ...]:
    """Return a key that is equal for two copies of one line, in either direction."""
    ends = sorted(tuple(np.round(point[:2], 1)) for point in (line[0], line[-1]))
    along = arc_length(line)
    middle = np.round(sample_at(line, along[-1:] / 2, along)[0, :2], 0)
    return (*ends[0], *ends[1], *middle)


def _boundaries(vector_map: VectorMap) -> Iterable[tuple[np.ndarray, int]]:
    for segment in vector_map.segments.values():
        yield segment.left, segment.left_type
        yield segment.right, segment.right_type


def _stations(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances along a line, `SPACING` apart, and those of its vertices."""
    along = arc_length(line)
    return np.arange(0.0, along[-1] + SPACING / 2, SPACING), along


def _fill(ring: np.ndarray) -> np.ndarray:
    """Return the points of a square lattice that lie inside a ring (even-odd rule), at the ring's mean height."""
    low, high = ring[:, :2].min(0), ring[:, :2].max(0)
    x, y = np.meshgrid(*(np.arange(a, b, SPACING) for a, b in zip(low, high, strict=True)))
    x, y = x.ravel(), y.ravel()
    (x0, y0), (x1, y1) = ring[:-1, :2].T, ring[1:, :2].T
    crosses = (y0 > y[:, None]) != (y1 > y[:, None])
    rise = np.where(y1 == y0, 1.0, y1 - y0)
    right_of_point = x[:, None] < x0 + (y[:, None] - y0) / rise * (x1 - x0)
    inside = (crosses & right_of_point).sum(-1) % 2 == 1
    return np.stack([x[inside], y[inside], np.full(inside.sum(), ring[:-1, 2].mean())], -1)

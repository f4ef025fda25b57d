"""Changes of a whole scene: every point of its map, and all of its boxes, in the same way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from tflane_jax.scene.logs import LaneSegment, Log, Tracks, VectorMap

# Straight lines get a vertex every so many metres, so that they follow a deformed ground.
_STEP = 4.0
Move = Callable[[Float[np.ndarray, "_ 3"]], Float[np.ndarray, "_ 3"]]
"""Lines or points, global metres -> where they are now; a line may get further vertices."""


def moved_map(found: VectorMap, line: Move, point: Move) -> VectorMap:
    """Return a map with all lines, crossings and elements elsewhere. Yaws and buildings stay.

    Args:
        found: the map.
        line: moves lines.
        point: moves what must keep its vertices: rings of crossings, whose corners have a meaning, and elements.
    """

    def lines(given: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        return tuple(line(one) for one in given)

    def segment(lane: LaneSegment) -> LaneSegment:
        centerline, left, right = lines([lane.centerline, lane.left, lane.right])
        return replace(lane, centerline=centerline, left=left, right=right)

    return replace(
        found,
        segments={number: segment(lane) for number, lane in found.segments.items()},
        crossings=tuple(point(ring) for ring in found.crossings),
        road_boundaries=lines(found.road_boundaries),
        elements=tuple(replace(e, position=point(np.asarray(e.position, float)[None])[0]) for e in found.elements),
        roads=lines(found.roads),
        dividers=None if found.dividers is None else lines(found.dividers),
    )


def moved_boxes(log: Log, move: Callable[[Tracks], Tracks]) -> tuple[Tracks, Tracks]:
    """Return the tracks and the true boxes of a log, moved; one object where they are one."""
    tracks = move(log.tracks)
    return tracks, tracks if log.actors is log.tracks else move(log.actors)


def with_vertices(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return a line with further vertices, at most 4 m apart; a line driven the other way gets the same ones."""
    if len(line) < 2:
        return line
    start, step = line[:-1], np.diff(line, axis=0)
    count = np.maximum(np.ceil(np.linalg.norm(step[:, :2], axis=-1) / _STEP), 1).astype(int)
    parts = [
        a + np.arange(n)[:, None] / n * d if n > 1 else a[None] for a, d, n in zip(start, step, count, strict=True)
    ]
    return np.concatenate([*parts, line[-1:]])

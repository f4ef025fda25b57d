"""How lane segments and the merged centerlines of one scene belong together (host, numpy)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from tflane_jax.geometry import line_distances
from tflane_jax.scene.truth import LaneGraph, TrafficElements

# Metres; a segment lies on a centerline if all of its points are nearer than this.
_ON_LANE = 0.5


def segments_on_lanes(segments: LaneGraph, lanes: LaneGraph) -> Bool[np.ndarray, "s n"]:
    """Return which valid segments lie on which valid centerlines, in the same direction."""
    out = np.zeros((len(segments.valid), len(lanes.valid)), bool)
    rows, columns = np.flatnonzero(segments.valid), np.flatnonzero(lanes.valid)
    if not len(rows) or not len(columns):
        return out
    parts, wholes = np.asarray(segments.points[rows], float), np.asarray(lanes.points[columns], float)
    distance, along = line_distances(parts[:, None], wholes)
    out[np.ix_(rows, columns)] = (distance.max(-1) < _ON_LANE) & (along[..., -1] > along[..., 0])
    return out


def governed_lanes(elements: TrafficElements | None, lanes: LaneGraph, segments: LaneGraph) -> Bool[np.ndarray, "n e"]:
    """Return which elements govern each valid centerline: as labelled, or those of the segments that lie on it."""
    if elements is None:
        return np.zeros((len(lanes.valid), 0), bool)
    if elements.lane is not None:
        return np.asarray(elements.lane, bool) & np.asarray(lanes.valid)[:, None]
    return segments_on_lanes(segments, lanes).T @ np.asarray(elements.segment, bool)


def governed_segments(
    elements: TrafficElements | None, segments: LaneGraph, lanes: LaneGraph
) -> Bool[np.ndarray, "s e"]:
    """Return which elements govern each valid segment: as labelled, or those of the centerlines on which it lies."""
    if elements is None:
        return np.zeros((len(segments.valid), 0), bool)
    if elements.segment is not None:
        return np.asarray(elements.segment, bool) & np.asarray(segments.valid)[:, None]
    return segments_on_lanes(segments, lanes) @ np.asarray(elements.lane, bool)

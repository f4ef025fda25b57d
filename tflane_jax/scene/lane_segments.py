"""How lane segments and the merged centerlines of one scene belong together (host, numpy)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from tflane_jax.geometry import line_distances
from tflane_jax.scene.truth import LaneGraph

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

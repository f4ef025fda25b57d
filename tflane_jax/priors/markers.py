"""The fiducial-marker prior (Wu and Hu, sections III-A and III-B), up to the learned part.

The observations of a frame become lane polylines with a fixed number of points and the confidence of their marker. Runs
in numpy or under jit, depending on the arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from flax import struct
from jaxtyping import Bool, Float

from tflane_jax.geometry import segment_distances
from tflane_jax.geometry.namespace import namespace
from tflane_jax.limits import Count, Positive, counted
from tflane_jax.scene import MarkerObservations
from tflane_jax.scene.arrays import Array


@dataclass(frozen=True)
class MarkerPriorConfig:
    """Selection and confidence of marker lanes.

    Attributes:
        points: K, points of a polyline (paper: 11).
        lanes: L, largest number of lanes of a frame's markers; lanes of the most confident markers are kept.
        distance_scale: tau_d of Eq. (2), metres.
        residual_scale: tau_r of Eq. (2), metres.
        use_score: multiply the confidence by the detector's raw score, an addition that the paper mentions.
        trust: "confidence" is Eq. (2). "all" gives every detected marker the confidence 1, so that it no longer
            decides their order (then by distance), their weight in a frame, or when memory is read (then only when
            nothing is detected).
    """

    points: Annotated[int, counted(2)] = 11
    lanes: Count = 32
    distance_scale: Positive = 40.0
    residual_scale: Positive = 10.0
    use_score: bool = False
    trust: Literal["confidence", "all"] = "confidence"


@struct.dataclass
class MarkerLanes:
    """Lanes of all markers of one frame.

    Attributes:
        points: (L, K, 2) metres, ego frame; 0 where not valid.
        confidence: (L,) of the marker that the lane belongs to; 0 where not valid.
        successor: (L, L) directed connectivity, within a marker only.
        valid: (L,).
    """

    points: Float[Array, "l k 2"]
    confidence: Float[Array, " l"]
    successor: Bool[Array, "l l"]
    valid: Bool[Array, " l"]

    @property
    def frame_confidence(self) -> Float[Array, ""]:
        """c_t, the confidence of a frame: the highest of its markers, 0 without any."""
        return self.confidence.max(initial=0.0)


def confidence(
    distance: Float[Array, " m"], residual: Float[Array, " m"], config: MarkerPriorConfig
) -> Float[Array, " m"]:
    """Return Eq. (2), in (0, 1], from the distance of the marker and its short-term residual, both in metres."""
    xp = namespace(distance, residual)
    return xp.exp(-residual / config.residual_scale) * xp.exp(-distance / config.distance_scale)  # Eq. (2)


def marker_confidence(markers: MarkerObservations, config: MarkerPriorConfig) -> Float[Array, " m"]:
    """Return the confidence of one frame's markers under a configuration, 0 where not valid; padding may hold anything.

    It is Eq. (2), times the score with `use_score`, or 1 with `trust` "all".
    """
    xp = namespace(markers.pose, markers.valid)
    pose = xp.where(markers.valid[:, None, None], markers.pose, xp.eye(4, dtype=markers.pose.dtype)[None])
    residual = xp.where(markers.valid, markers.residual, 0.0)
    # The prior ignores the vertical coordinate (section III-A).
    found = confidence(xp.sqrt((pose[:, :2, 3] ** 2).sum(-1)), residual, config)
    if config.trust == "all":
        found = xp.ones_like(found)
    elif config.use_score:
        found = found * xp.where(markers.valid, markers.score, 0.0)
    return xp.where(markers.valid, found, 0.0)


def select_marker_lanes(markers: MarkerObservations, config: MarkerPriorConfig) -> MarkerLanes:
    """Return the lanes of one frame's markers by descending confidence; padding may hold anything.

    Where there are more than the prior takes, the nearest to the vehicle come first among those of equal confidence.

    Raises ValueError if the lanes have fewer points than the configuration.
    """
    xp = namespace(markers.lanes, markers.valid)
    count, lanes, points = markers.lanes.shape[:3]
    if points < config.points:
        raise ValueError(
            f"the markers' lanes have {points} points, the prior asks for {config.points}: raise "
            "data.example.markers.points or lower priors.markers.prior.points"
        )
    valid = (markers.lane_valid & markers.valid[:, None]).reshape(-1)
    flat = markers.lanes[..., :2].reshape(count * lanes, points, 2)[:, stride(points, config.points)]
    flat = xp.where(valid[:, None, None], flat, 0.0)
    same = np.repeat(np.eye(count, dtype=bool), lanes, 0).repeat(lanes, 1)
    edges = xp.broadcast_to(markers.successor[:, :, None, :], (count, lanes, count, lanes))
    edges = edges.reshape(count * lanes, count * lanes) & same & valid[:, None] & valid[None, :]
    lane_confidence = xp.where(valid, xp.repeat(marker_confidence(markers, config), lanes), 0.0)
    # To the lines, not to their points, which may be 10 m apart.
    vehicle, start = xp.zeros((1, 2), flat.dtype), flat[:, :-1]
    near = segment_distances(vehicle, start, flat[:, 1:] - start)[1].min(-1)
    # Stable: lanes of one marker keep their order if all have a place; padding comes last.
    near = xp.where(valid.sum() > config.lanes, near, 0.0)
    order = xp.lexsort((near, xp.where(valid, -lane_confidence, xp.inf)))[: config.lanes]
    missing = config.lanes - len(order)
    return MarkerLanes(
        points=xp.pad(flat[order], ((0, missing), (0, 0), (0, 0))),
        confidence=xp.pad(lane_confidence[order], (0, missing)),
        successor=xp.pad(edges[order][:, order], ((0, missing), (0, missing))),
        valid=xp.pad(valid[order], (0, missing)),
    )


def stride(points: int, kept: int) -> np.ndarray:
    """Return the indices of `kept` of `points` points at an even stride, first and last included."""
    return np.linspace(0, points - 1, kept).round().astype(int)

"""Prior observations of one frame: traffic flow, fiducial markers, SD map."""

from __future__ import annotations

import enum

import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int

from tflane_jax.scene.arrays import Array, check_shapes


class RoadUser(enum.IntEnum):
    """Category of a moving road user. Street furniture is not traffic and has no entry."""

    CAR = 0
    TRUCK = 1
    BUS = 2
    MOTORCYCLE = 3
    BICYCLE = 4
    PEDESTRIAN = 5


class SdCategory(enum.IntEnum):
    """Category of a line of an SD map, as SMERF numbers it."""

    ROAD = 0
    CROSSWALK = 1  # also sidewalks and other pedestrian ways
    TRUCK_ROAD = 2
    HIGHWAY = 3
    RESIDENTIAL = 4
    SERVICE = 5
    BUS_WAY = 6
    OTHER = 7


@struct.dataclass
class TrafficFlow:
    """Tracks of K other road users over the N frames before the current one, warped into the current ego frame.

    This is TF_i of TF-Lane (section 3.2) before any selection. Frame 0 is the oldest, frame N-1 the one just before
    the current frame.

    Attributes:
        position: (K, N, 3) box centers, metres, current ego frame.
        yaw: (K, N) heading in the current ego frame, radians.
        size: (K, 3) length, width, height, metres.
        category: (K,) `RoadUser`.
        occluded: (K, N) the tracker reported a box that its sensors did not see (interpolated or hidden).
        valid: (K, N) the track exists in that frame. An instance without a valid frame is padding.
    """

    position: Float[Array, "k n 3"]
    yaw: Float[Array, "k n"]
    size: Float[Array, "k 3"]
    category: Int[Array, " k"]
    occluded: Bool[Array, "k n"]
    valid: Bool[Array, "k n"]

    @classmethod
    def empty(cls, capacity: int, frames: int) -> TrafficFlow:
        """Return a traffic flow of `capacity` invalid instances."""
        flag = np.zeros((capacity, frames), bool)
        return cls(
            position=np.zeros((capacity, frames, 3), np.float32),
            yaw=np.zeros((capacity, frames), np.float32),
            size=np.zeros((capacity, 3), np.float32),
            category=np.zeros(capacity, np.int32),
            occluded=flag,
            valid=flag.copy(),
        )

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


@struct.dataclass
class MarkerObservations:
    """Fiducial markers detected in the current frame, with the local lane graph stored for each id.

    Attributes:
        marker_id: (M,) identity.
        pose: (M, 4, 4) ego_from_marker, metres.
        score: (M,) detection score, 0 to 1.
        residual: (M,) short-term pose residual, metres.
        lanes: (M, J, P, 3) the marker's lane centerlines in the ego frame, metres.
        lane_valid: (M, J).
        successor: (M, J, J) directed connectivity among the marker's lanes.
        valid: (M,).
    """

    marker_id: Int[Array, " m"]
    pose: Float[Array, "m 4 4"]
    score: Float[Array, " m"]
    residual: Float[Array, " m"]
    lanes: Float[Array, "m j p 3"]
    lane_valid: Bool[Array, "m j"]
    successor: Bool[Array, "m j j"]
    valid: Bool[Array, " m"]

    @classmethod
    def empty(cls, capacity: int, lanes: int, points: int) -> MarkerObservations:
        """Return `capacity` invalid markers of `lanes` lanes each."""
        return cls(
            marker_id=np.zeros(capacity, np.int32),
            pose=np.tile(np.eye(4, dtype=np.float32), (capacity, 1, 1)),
            score=np.zeros(capacity, np.float32),
            residual=np.zeros(capacity, np.float32),
            lanes=np.zeros((capacity, lanes, points, 3), np.float32),
            lane_valid=np.zeros((capacity, lanes), bool),
            successor=np.zeros((capacity, lanes, lanes), bool),
            valid=np.zeros(capacity, bool),
        )

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


@struct.dataclass
class SdMap:
    """Standard-definition map around the vehicle: road-level polylines.

    Attributes:
        points: (R, P, 2) metres, ego frame.
        category: (R,) `SdCategory`.
        valid: (R,).
    """

    points: Float[Array, "r p 2"]
    category: Int[Array, " r"]
    valid: Bool[Array, " r"]

    @classmethod
    def empty(cls, capacity: int, points: int) -> SdMap:
        """Return a map of `capacity` invalid lines of `points` points."""
        return cls(np.zeros((capacity, points, 2), np.float32), np.zeros(capacity, np.int32), np.zeros(capacity, bool))

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)

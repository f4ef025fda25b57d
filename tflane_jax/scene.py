"""The vocabulary that every floor shares: what is around the vehicle at one moment, as fixed-size arrays.

One `Example` holds one frame of one scene in the **ego frame** (x forward, y left, z up; metres, radians).
Containers are pytrees without a batch axis; callers `vmap`. Every padded array has a bool `valid` beside it, and
`valid` is the only truth: what stands in padding is arbitrary (NaN included) and must never reach an output.
Arrays are numpy on the host and jax on the device; dtype float32, bool and int32 unless a docstring says otherwise.

Host-side recordings in global coordinates (maps, poses, tracks) live in `tflane_jax.logs`.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Any

import chex
import jax
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int, UInt8

# Leaves are numpy on the host and jax on the device, and either may be indexed, reduced and handed on.
if TYPE_CHECKING:
    from typing import Any as Array
else:
    Array = np.ndarray | jax.Array


class RoadUser(enum.IntEnum):
    """Category of a moving road user. Street furniture is not traffic and has no entry."""

    CAR = 0
    TRUCK = 1
    BUS = 2
    MOTORCYCLE = 3
    BICYCLE = 4
    PEDESTRIAN = 5


class LineType(enum.IntEnum):
    """Marking of a lane boundary, as OpenLane-V2 numbers it."""

    NONE = 0
    SOLID = 1
    DASHED = 2


class AreaType(enum.IntEnum):
    """Category of an area, as OpenLane-V2 numbers it."""

    PEDESTRIAN_CROSSING = 1
    ROAD_BOUNDARY = 2


class SdCategory(enum.IntEnum):
    """Category of a line of an SD map, as SMERF numbers it."""

    ROAD = 0
    CROSSWALK = 1  # sidewalks and other ways of pedestrians too
    TRUCK_ROAD = 2
    HIGHWAY = 3
    RESIDENTIAL = 4
    SERVICE = 5
    BUS_WAY = 6
    OTHER = 7


class BevChannel(enum.IntEnum):
    """Channels of the bird's-eye-view evidence raster (`Example.bev`)."""

    LANE_PAINT = 0
    ROAD_EDGE = 1
    CROSSING = 2
    OBSTACLE = 3


@struct.dataclass
class LaneGraph:
    """Directed lane graph: N lanes of P points.

    The same container serves both OpenLane-V2 flavours: merged centerlines and lane segments.

    Attributes:
        points: (N, P, 3) centerline in driving direction, metres.
        left, right: (N, P, 3) boundaries in driving direction, metres.
        left_type, right_type: (N,) `LineType`.
        is_connector: (N,) lane inside an intersection.
        visibility: (N,) share of the centerline in direct line of sight, 0 to 1.
        successor: (N, N) [i, j] true where the end of lane i is the start of lane j.
        valid: (N,).
    """

    points: Float[Array, "n p 3"]
    left: Float[Array, "n p 3"]
    right: Float[Array, "n p 3"]
    left_type: Int[Array, " n"]
    right_type: Int[Array, " n"]
    is_connector: Bool[Array, " n"]
    visibility: Float[Array, " n"]
    successor: Bool[Array, "n n"]
    valid: Bool[Array, " n"]

    @classmethod
    def empty(cls, capacity: int, points: int) -> LaneGraph:
        """Return a graph with room for `capacity` lanes of `points` points and none valid."""
        line = np.zeros((capacity, points, 3), np.float32)
        label = np.zeros(capacity, np.int32)
        flag = np.zeros(capacity, bool)
        return cls(
            points=line, left=line.copy(), right=line.copy(),
            left_type=label, right_type=label.copy(),
            is_connector=flag, visibility=np.zeros(capacity, np.float32),
            successor=np.zeros((capacity, capacity), bool), valid=flag.copy(),
        )  # fmt: skip

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        n, p = self.points.shape[:2]
        chex.assert_shape([self.points, self.left, self.right], (n, p, 3))
        chex.assert_shape([self.left_type, self.right_type, self.is_connector, self.visibility], (n,))
        chex.assert_shape(self.successor, (n, n))
        chex.assert_shape(self.valid, (n,))


@struct.dataclass
class Areas:
    """Pedestrian crossings (closed rings) and road boundaries.

    Attributes:
        points: (A, P, 3) metres; a closed ring repeats its first point at the end.
        category: (A,) `AreaType`.
        valid: (A,).
    """

    points: Float[Array, "a p 3"]
    category: Int[Array, " a"]
    valid: Bool[Array, " a"]

    @classmethod
    def empty(cls, capacity: int, points: int) -> Areas:
        """Return a set with room for `capacity` areas and none valid."""
        return cls(
            np.zeros((capacity, points, 3), np.float32), np.zeros(capacity, np.int32), np.zeros(capacity, bool)
        )

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        a, p = self.points.shape[:2]
        chex.assert_shape(self.points, (a, p, 3))
        chex.assert_shape([self.category, self.valid], (a,))


@struct.dataclass
class TrafficFlow:
    """Tracks of K other road users over the N frames before the current one, warped into the current ego frame.

    This is TF_i of TF-Lane (section 3.2) before any selection. Frame 0 is the oldest, frame N-1 the one just before
    the current frame.

    Attributes:
        position: (K, N, 3) box centres, metres, current ego frame.
        yaw: (K, N) heading in the current ego frame, radians.
        size: (K, 3) length, width, height, metres.
        category: (K,) `RoadUser`.
        occluded: (K, N) the tracker reported the box without seeing it (interpolated or hidden).
        valid: (K, N) the track exists in that frame. An instance that no frame holds is padding.
    """

    position: Float[Array, "k n 3"]
    yaw: Float[Array, "k n"]
    size: Float[Array, "k 3"]
    category: Int[Array, " k"]
    occluded: Bool[Array, "k n"]
    valid: Bool[Array, "k n"]

    @classmethod
    def empty(cls, capacity: int, frames: int) -> TrafficFlow:
        """Return a traffic flow with room for `capacity` instances and none valid."""
        flag = np.zeros((capacity, frames), bool)
        return cls(
            position=np.zeros((capacity, frames, 3), np.float32), yaw=np.zeros((capacity, frames), np.float32),
            size=np.zeros((capacity, 3), np.float32), category=np.zeros(capacity, np.int32),
            occluded=flag, valid=flag.copy(),
        )  # fmt: skip

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        k, n = self.valid.shape
        chex.assert_shape(self.position, (k, n, 3))
        chex.assert_shape([self.yaw, self.occluded, self.valid], (k, n))
        chex.assert_shape(self.size, (k, 3))
        chex.assert_shape(self.category, (k,))


@struct.dataclass
class MarkerObservations:
    """Fiducial markers detected in the current frame and the local lane graph that each id names.

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
        """Return room for `capacity` markers of `lanes` lanes each, and none valid."""
        return cls(
            marker_id=np.zeros(capacity, np.int32),
            pose=np.tile(np.eye(4, dtype=np.float32), (capacity, 1, 1)),
            score=np.zeros(capacity, np.float32), residual=np.zeros(capacity, np.float32),
            lanes=np.zeros((capacity, lanes, points, 3), np.float32),
            lane_valid=np.zeros((capacity, lanes), bool), successor=np.zeros((capacity, lanes, lanes), bool),
            valid=np.zeros(capacity, bool),
        )  # fmt: skip

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        m, j, p = self.lanes.shape[:3]
        chex.assert_shape(self.lanes, (m, j, p, 3))
        chex.assert_shape(self.pose, (m, 4, 4))
        chex.assert_shape([self.marker_id, self.score, self.residual, self.valid], (m,))
        chex.assert_shape(self.lane_valid, (m, j))
        chex.assert_shape(self.successor, (m, j, j))


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
        """Return a map with room for `capacity` lines of `points` points and none valid."""
        return cls(
            np.zeros((capacity, points, 2), np.float32), np.zeros(capacity, np.int32), np.zeros(capacity, bool)
        )

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        r, p = self.points.shape[:2]
        chex.assert_shape(self.points, (r, p, 2))
        chex.assert_shape([self.category, self.valid], (r,))


@struct.dataclass
class TrafficElements:
    """Traffic lights and signs.

    Attributes:
        position: (E, 3) centre in the ego frame, metres.
        box: (E, 2, 2) top-left and bottom-right pixel corners in the front image; zeros where there is no image.
        category: (E,) 1 traffic light, 2 road sign.
        attribute: (E,) OpenLane-V2 attribute 0 to 12.
        lane: (N, E) element e governs lane n of the merged centerlines.
        valid: (E,).
    """

    position: Float[Array, "e 3"]
    box: Float[Array, "e 2 2"]
    category: Int[Array, " e"]
    attribute: Int[Array, " e"]
    lane: Bool[Array, "n e"]
    valid: Bool[Array, " e"]

    @classmethod
    def empty(cls, capacity: int, lanes: int) -> TrafficElements:
        """Return a set with room for `capacity` elements and none valid."""
        label = np.zeros(capacity, np.int32)
        return cls(
            position=np.zeros((capacity, 3), np.float32), box=np.zeros((capacity, 2, 2), np.float32),
            category=label, attribute=label.copy(), lane=np.zeros((lanes, capacity), bool),
            valid=np.zeros(capacity, bool),
        )  # fmt: skip

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        e = self.valid.shape[0]
        chex.assert_shape(self.position, (e, 3))
        chex.assert_shape(self.box, (e, 2, 2))
        chex.assert_shape([self.category, self.attribute, self.valid], (e,))
        chex.assert_shape(self.lane, (None, e))


@struct.dataclass
class CameraViews:
    """What V calibrated pinhole cameras see in one frame.

    Camera 0 looks ahead, and traffic elements are labelled in its image.
    All images have one size; a smaller one lies in the top-left corner of its array and the rest is padding.

    Attributes:
        image: (V, H, W, 3) uint8, RGB, without lens distortion.
        size: (V, 2) width and height of each image, pixels.
        intrinsics: (V, 3, 3), pixels from the top-left corner of the image (see `geometry.cameras`).
        camera_from_ego: (V, 4, 4).
        valid: (V,) the camera delivered an image.
    """

    image: UInt8[Array, "v h w 3"]
    size: Int[Array, "v 2"]
    intrinsics: Float[Array, "v 3 3"]
    camera_from_ego: Float[Array, "v 4 4"]
    valid: Bool[Array, " v"]

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        v, h, w = self.image.shape[:3]
        chex.assert_shape(self.image, (v, h, w, 3))
        chex.assert_shape(self.size, (v, 2))
        chex.assert_shape(self.intrinsics, (v, 3, 3))
        chex.assert_shape(self.camera_from_ego, (v, 4, 4))
        chex.assert_shape(self.valid, (v,))


@struct.dataclass
class Example:
    """One frame: what the sensors and the priors say, and the truth.

    A prior or sensor that a dataset does not offer at all is None; one that is absent in this frame is all invalid.
    Both mean the same to a model.

    Attributes:
        bev: (H, W, C) uint8 evidence in [0, 255] per `BevChannel`; row 0 lies at the least y, column 0 at the least x
            (BEVFormer's grid).
        hidden: (H, W) bool, ground that no ray reaches. Never a model input: it is there for evaluation and pictures.
        traffic_flow: prior of TF-Lane.
        markers: prior of marker fusion.
        sd_map: prior of SMERF.
        lanes: truth, merged centerlines (OpenLane-V2 `lane_centerline`).
        segments: truth, lane segments (OpenLane-V2 `lane_segment`).
        areas: truth, crossings and road boundaries.
        traffic_elements: truth.
        previous_from_ego: (4, 4) pose of this ego frame in the previous frame's ego frame.
        has_previous: () the previous frame belongs to the same scene.
        cameras: what the cameras see.
    """

    bev: UInt8[Array, "h w c"] | None
    hidden: Bool[Array, "h w"] | None
    traffic_flow: TrafficFlow | None
    markers: MarkerObservations | None
    sd_map: SdMap | None
    lanes: LaneGraph
    segments: LaneGraph
    areas: Areas
    traffic_elements: TrafficElements | None
    previous_from_ego: Float[Array, "4 4"]
    has_previous: Bool[Array, ""]
    cameras: CameraViews | None = None

    def validate(self) -> None:
        """Validate every part; raise AssertionError naming the first field that does not fit."""
        parts = (self.traffic_flow, self.markers, self.sd_map, self.lanes, self.segments, self.areas,
                 self.traffic_elements, self.cameras)  # fmt: skip
        for part in parts:
            if part is not None:
                part.validate()
        chex.assert_shape(self.previous_from_ego, (4, 4))


@struct.dataclass
class LanePrediction:
    """Lanes predicted by Q queries.

    Attributes:
        points: (Q, P, 3) metres, ego frame, in driving direction.
        logits: (Q, C) class logits (sigmoid); C = 1 for centerlines.
        successor_logits: (Q, Q) [i, j]: lane j continues lane i.
    """

    points: Float[Array, "*layers q p 3"]
    logits: Float[Array, "*layers q c"]
    successor_logits: Float[Array, "*layers q q"]

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Confidence of the best class, 0 to 1."""
        return jax.nn.sigmoid(self.logits).max(-1)


@struct.dataclass
class ElementPrediction:
    """Traffic lights and signs predicted by E queries in the front image.

    Attributes:
        box: (E, 2, 2) top-left and bottom-right corners, pixels of camera 0.
        logits: (E, 13) by OpenLane-V2 attribute (sigmoid).
        lane_logits: (Q, E) [i, e]: element e governs lane i of the `LanePrediction` beside it.
    """

    box: Float[Array, "*layers e 2 2"]
    logits: Float[Array, "*layers e a"]
    lane_logits: Float[Array, "*layers q e"]


@struct.dataclass
class Prediction:
    """What a model says about one frame; a part that the model does not predict is None."""

    lanes: LanePrediction | None = None
    elements: ElementPrediction | None = None


def stack_examples(examples: list[Any]) -> Any:
    """Stack pytrees of equal structure into one batch with a leading axis (numpy, host)."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def shapes_of(example: Any, *leading: int) -> Any:
    """Return shapes and types of the leaves of a pytree, with `leading` axes in front."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape), leaf.dtype), example)


@struct.dataclass
class LaneLines:
    """Lane lines in one front-view image: L lines of up to P points, from the horizon down.

    Attributes:
        points: (L, P, 2) column u and row v as shares of the image's width and height, v ascending.
        point_valid: (L, P) the line has this point; what stands at the others is arbitrary.
        valid: (L,).
    """

    points: Float[Array, "l p 2"]
    point_valid: Bool[Array, "l p"]
    valid: Bool[Array, " l"]

    @classmethod
    def empty(cls, capacity: int, points: int) -> LaneLines:
        """Return a set with room for `capacity` lines of `points` points and none valid."""
        return cls(
            np.zeros((capacity, points, 2), np.float32), np.zeros((capacity, points), bool), np.zeros(capacity, bool)
        )

    def validate(self) -> None:
        """Raise AssertionError naming the field whose shape does not fit the others."""
        l, p = self.points.shape[:2]
        chex.assert_shape(self.points, (l, p, 2))
        chex.assert_shape(self.point_valid, (l, p))
        chex.assert_shape(self.valid, (l,))


@struct.dataclass
class RoadImage:
    """One front-view image and the lane lines in it: an example of the monocular task.

    Attributes:
        image: (H, W, 3) uint8, RGB.
        image_valid: (H, W) false where augmentation left no image.
        lines: truth.
    """

    image: UInt8[Array, "h w 3"]
    image_valid: Bool[Array, "h w"]
    lines: LaneLines

    def validate(self) -> None:
        """Validate every part; raise AssertionError naming the first field that does not fit."""
        h, w = self.image_valid.shape
        chex.assert_shape(self.image, (h, w, 3))
        self.lines.validate()


@struct.dataclass
class LaneCurvePrediction:
    """Lane lines predicted by Q queries as parameters of the lane shape model (GTN paper, Eq. 7 and 8).

    Attributes:
        logits: (Q, 2) class logits (softmax), index 1 is a lane.
        curves: (Q, 8) lower and upper end (alpha, beta: rows v), k'', f'', m'', n', b'', b''' in shares of the image.
    """

    logits: Float[Array, "*layers q 2"]
    curves: Float[Array, "*layers q 8"]

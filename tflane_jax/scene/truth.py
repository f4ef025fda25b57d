"""Ground truth around the vehicle, or in one image: lanes, areas, traffic elements, lane lines."""

from __future__ import annotations

import enum
from dataclasses import replace

import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int

from tflane_jax.scene.arrays import Array, check_shapes


class LineType(enum.IntEnum):
    """Marking of a lane boundary, as OpenLane-V2 numbers it."""

    NONE = 0
    SOLID = 1
    DASHED = 2


class AreaType(enum.IntEnum):
    """Category of an area, as OpenLane-V2 numbers it."""

    PEDESTRIAN_CROSSING = 1
    ROAD_BOUNDARY = 2


class LineClass(enum.IntEnum):
    """Class of a line of a vector map, as MapTR numbers it; MapTRv2 adds centerlines."""

    DIVIDER = 0
    CROSSING = 1
    BOUNDARY = 2
    CENTERLINE = 3


@struct.dataclass
class LaneGraph:
    """Directed lane graph: N lanes of P points.

    The same container serves both OpenLane-V2 flavours: merged centerlines and lane segments.

    Attributes:
        points: (N, P, 3) centerline in driving direction, metres.
        left, right: (N, P, 3) boundaries in driving direction, metres.
        left_type, right_type: (N,) `LineType`.
        is_connector: (N,) lane inside an intersection.
        visibility: (N,) fraction of the centerline in direct line of sight, 0 to 1.
        successor: (N, N) [i, j] the end of lane i is the start of lane j.
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
        """Return a graph of `capacity` invalid lanes of `points` points."""
        line = np.zeros((capacity, points, 3), np.float32)
        label = np.zeros(capacity, np.int32)
        flag = np.zeros(capacity, bool)
        return cls(
            points=line,
            left=line.copy(),
            right=line.copy(),
            left_type=label,
            right_type=label.copy(),
            is_connector=flag,
            visibility=np.zeros(capacity, np.float32),
            successor=np.zeros((capacity, capacity), bool),
            valid=flag.copy(),
        )

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


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
        """Return `capacity` invalid areas of `points` points."""
        return cls(np.zeros((capacity, points, 3), np.float32), np.zeros(capacity, np.int32), np.zeros(capacity, bool))

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


@struct.dataclass
class MapLines:
    """Lines of a vector map: L polylines and rings of P points.

    Attributes:
        points: (L, P, 3) metres, ego frame; a ring repeats its first point at the end.
        category: (L,) `LineClass`.
        closed: (L,) the line is a ring; its start is arbitrary.
        valid: (L,).
        visibility: (L,) fraction of the line in direct line of sight, 0 to 1; None if it is unknown.
        identity: (L,) number of the line in its map, the same in every frame of a scene, for dividers, crossings and
            boundaries; pieces of one line share it. Paths of centerlines change with the range and have none. None if
            it is unknown.
        dense: (L, S, 3) points equally spaced along the lines as the source has them, which the evaluation measures;
            `points`, which a model learns, cut corners. None if `points` are all that is known.
    """

    points: Float[Array, "l p 3"]
    category: Int[Array, " l"]
    closed: Bool[Array, " l"]
    valid: Bool[Array, " l"]
    visibility: Float[Array, " l"] | None = None
    identity: Int[Array, " l"] | None = None
    dense: Float[Array, "l s 3"] | None = None

    @classmethod
    def empty(cls, capacity: int, points: int, dense: int | None = None) -> MapLines:
        """Return a map of `capacity` invalid lines of `points` points, and of as many as `dense` in the dense form."""
        label, flag = np.zeros(capacity, np.int32), np.zeros(capacity, bool)
        return cls(
            points=np.zeros((capacity, points, 3), np.float32),
            category=label,
            closed=flag,
            valid=flag.copy(),
            visibility=np.zeros(capacity, np.float32),
            identity=label.copy(),
            dense=None if dense is None else np.zeros((capacity, dense, 3), np.float32),
        )

    def of_classes(self, count: int) -> MapLines:
        """Return the same lines; those of other classes than the first `count` of `LineClass` are invalid."""
        return replace(self, valid=self.valid & (self.category < count))

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


@struct.dataclass
class TrafficElements:
    """Traffic lights and signs.

    Attributes:
        position: (E, 3) center in the ego frame, metres.
        box: (E, 2, 2) top-left and bottom-right pixel corners in the front image; zeros without an image.
        category: (E,) 1 traffic light, 2 road sign.
        attribute: (E,) OpenLane-V2 attribute 0 to 12.
        lane: (N, E) element e governs lane n of the merged centerlines; None if only its segments are known.
        valid: (E,).
        segment: (S, E) element e governs segment s; None if only its centerlines are known.
    """

    position: Float[Array, "e 3"]
    box: Float[Array, "e 2 2"]
    category: Int[Array, " e"]
    attribute: Int[Array, " e"]
    lane: Bool[Array, "n e"] | None
    valid: Bool[Array, " e"]
    segment: Bool[Array, "s e"] | None = None

    @classmethod
    def empty(cls, capacity: int, lanes: int | None = None, segments: int | None = None) -> TrafficElements:
        """Return `capacity` invalid elements that govern none of so many lanes and segments; None leaves these out."""
        label = np.zeros(capacity, np.int32)
        return cls(
            position=np.zeros((capacity, 3), np.float32),
            box=np.zeros((capacity, 2, 2), np.float32),
            category=label,
            attribute=label.copy(),
            lane=None if lanes is None else np.zeros((lanes, capacity), bool),
            valid=np.zeros(capacity, bool),
            segment=None if segments is None else np.zeros((segments, capacity), bool),
        )

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


@struct.dataclass
class LaneLines:
    """Lane lines in one front-view image: L lines of up to P points, from the horizon down.

    Attributes:
        points: (L, P, 2) column u and row v as fractions of the image's width and height, v ascending.
        point_valid: (L, P) the line has this point; others are padding.
        valid: (L,).
    """

    points: Float[Array, "l p 2"]
    point_valid: Bool[Array, "l p"]
    valid: Bool[Array, " l"]

    @classmethod
    def empty(cls, capacity: int, points: int) -> LaneLines:
        """Return `capacity` invalid lines of `points` points."""
        return cls(
            np.zeros((capacity, points, 2), np.float32), np.zeros((capacity, points), bool), np.zeros(capacity, bool)
        )

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)

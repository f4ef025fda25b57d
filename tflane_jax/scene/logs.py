"""The log of a drive: vector map, ego poses and tracks, in numpy on the host.

The built-in world simulates a `Log`, and the readers of Argoverse 2 and nuScenes read one;
`tflane_jax.datasets.examples` turns one moment into an `Example`. Global coordinates (city frame) stay float64. Only
tracks are padded, with `valid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.scene.marker_patterns import MarkerFamily
from tflane_jax.scene.terrain import Terrain

Side = Literal["left", "right"]


@dataclass(frozen=True)
class LaneSegment:
    """One stretch of lane with constant markings and neighbours (an Argoverse 2 lane segment).

    Attributes:
        id: unique in its map.
        centerline, left, right: (n, 3) float64 global metres, in driving direction; n may differ among the three.
        left_type, right_type: `scene.LineType`.
        is_intersection: inside an intersection.
        successors: ids of the segments that continue this one.
        vehicle: open to motor vehicles (False for bike lanes).
    """

    id: int
    centerline: np.ndarray
    left: np.ndarray
    right: np.ndarray
    left_type: int
    right_type: int
    is_intersection: bool
    successors: tuple[int, ...]
    vehicle: bool = True


@dataclass(frozen=True)
class MapElement:
    """A traffic light or sign.

    Attributes:
        position: (3,) center, global metres.
        yaw: direction of its front, global radians.
        category: 1 traffic light, 2 road sign.
        attribute: OpenLane-V2 attribute; of a light, its initial state.
        lanes: ids of the lane segments that it governs.
    """

    position: np.ndarray
    yaw: float
    category: int
    attribute: int
    lanes: tuple[int, ...]


@dataclass(frozen=True)
class VectorMap:
    """Static map in global metres, float64.

    Attributes:
        segments: lane segments by id.
        crossings: closed rings (n, 3), first point repeated at the end.
        road_boundaries: polylines (n, 3); a closed ring repeats its first point.
        elements: traffic lights and signs.
        buildings: (B, 5) x, y, length, width, yaw of opaque blocks of unlimited height.
        roads: center line (n, 3) of each road; empty if the source has no roads. A closed one repeats its first point.
        dividers: painted dividers (n, 3) where the source records them on their own; None if it records only the sides
            of lanes.
        side: on which traffic keeps, if the source says so; see `world.roads.road_map.driving_side`.
    """

    segments: dict[int, LaneSegment]
    crossings: tuple[np.ndarray, ...] = ()
    road_boundaries: tuple[np.ndarray, ...] = ()
    elements: tuple[MapElement, ...] = ()
    buildings: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))
    roads: tuple[np.ndarray, ...] = ()
    dividers: tuple[np.ndarray, ...] | None = None
    side: Side | None = None


@dataclass(frozen=True)
class Tracks:
    """Boxes of K road users over F frames; **each frame's boxes in the ego frame of that frame**.

    Attributes:
        position: (F, K, 3) box centers, metres.
        yaw: (F, K) radians.
        size: (K, 3) length, width, height, metres.
        category: (K,) `scene.RoadUser`.
        occluded: (F, K) the tracker reports a box that its sensors did not see.
        valid: (F, K).
        uuid: (K,) str, name of the track in the source.
    """

    position: np.ndarray
    yaw: np.ndarray
    size: np.ndarray
    category: np.ndarray
    occluded: np.ndarray
    valid: np.ndarray
    uuid: np.ndarray

    @classmethod
    def empty(cls, frames: int, uuid: np.ndarray | Sequence[str] = ()) -> Tracks:
        """Return tracks without a box: one for each name, by default none."""
        count = len(uuid)
        return cls(
            position=np.zeros((frames, count, 3)),
            yaw=np.zeros((frames, count)),
            size=np.zeros((count, 3)),
            category=np.zeros(count, np.int32),
            occluded=np.zeros((frames, count), bool),
            valid=np.zeros((frames, count), bool),
            uuid=np.array(uuid, str),
        )

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return self.valid.shape[0]


@dataclass(frozen=True)
class KeyFrame:
    """A moment of a log that becomes an example.

    Attributes:
        timestamp_ns: time, nanoseconds.
        global_from_ego: (4, 4) float64 pose at that time.
        track_frame: index of this moment among the log's track frames; the history is the frames before it.
    """

    timestamp_ns: int
    global_from_ego: np.ndarray
    track_frame: int


@dataclass(frozen=True)
class PlacedMarkers:
    """Fiducial markers beside the road; `tflane_jax.markers` defines the frame of a marker.

    Attributes:
        marker_id: (M,) int32, unique within a log.
        pose: (M, 4, 4) float64 global_from_marker, metres.
        size: side of the black square, metres.
        family: dictionary of the printed patterns.
    """

    marker_id: np.ndarray
    pose: np.ndarray
    size: float = 1.0
    family: MarkerFamily = MarkerFamily.ARUCO_5X5_100


@dataclass(frozen=True)
class Relief:
    """Hilly ground under a simulated drive.

    Attributes:
        terrain: heights, global metres.
        level: the same drive on level ground, from which cameras render; x, y and yaw of all poses are the same.
    """

    terrain: Terrain
    level: Log


@dataclass(frozen=True)
class Log:
    """One drive.

    Attributes:
        name: unique name (log id, or the world's scene number).
        source: dataset name.
        map: static map.
        timestamps_ns: (F,) int64, one for each track frame.
        global_from_ego: (F, 4, 4) float64, the ego pose of each track frame.
        tracks: boxes reported by the tracker; priors use no other traffic.
        actors: all true boxes, for line of sight and the obstacle channel; the same object as `tracks` unless the
            source simulates a tracker.
        keyframes: moments that become examples, in time order.
        element_attribute: (F, E) attribute of each map element at each track frame (the state of a light); None if
            all are constant.
        weather: 0 (clear) to 1 (worst); weakens all evidence.
        paint_wear: 0 (fresh) to 1 (gone); weakens lane paint.
        seed: of all random numbers in rendering this log.
        markers: fiducial markers beside the road; None if there are none.
        area: place, such as a city, in whose coordinates the log is; "" if it is unknown.
        relief: hilly ground of a simulated drive; None on level ground and for recorded logs.
    """

    name: str
    source: str
    map: VectorMap
    timestamps_ns: np.ndarray
    global_from_ego: np.ndarray
    tracks: Tracks
    actors: Tracks
    keyframes: tuple[KeyFrame, ...]
    element_attribute: np.ndarray | None = None
    weather: float = 0.0
    paint_wear: float = 0.0
    seed: int = 0
    markers: PlacedMarkers | None = None
    area: str = ""
    relief: Relief | None = None

    @property
    def rate_hz(self) -> float | None:
        """Track frames per second, from the median interval; None for a log of fewer than two frames.

        Raises UserError where a frame is not later than the one before it.
        """
        intervals = np.diff(self.timestamps_ns)
        if len(wrong := np.flatnonzero(intervals <= 0)):
            raise UserError(f"log {self.name}: frame {wrong[0] + 1} is not later than the frame before it")
        return None if len(intervals) == 0 else 1e9 / float(np.median(intervals))

"""Virtual markers for OpenLane-V2 (marker paper, section IV-A): boards beside the junctions of a segment's own lanes.

The photographs stay as they are. Boards, their ids and the noise of their detection depend on seed and segment alone. A
board is detected only where its whole square lies in an image of the frame's own cameras; nothing is known of poles,
parked cars and trees, so nothing hides it.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.marker_observations import observations
from tflane_jax.datasets.openlane_annotation import lane_ids, read_annotation
from tflane_jax.datasets.openlane_frames import FrameFile
from tflane_jax.datasets.openlane_lanes import FrameLanes, segment_lanes
from tflane_jax.errors import UserError
from tflane_jax.files.openlane import FieldNames
from tflane_jax.geometry import PerceptionRange, invert_pose, relative_pose
from tflane_jax.limits import Positive, Seed
from tflane_jax.markers.simulation import MarkerConfig, moment_before, simulate_detections
from tflane_jax.markers.store import MarkerStore, store_of
from tflane_jax.markers.visibility import in_images
from tflane_jax.scene import MarkerObservations
from tflane_jax.scene.logs import KeyFrame, Log, PlacedMarkers, Tracks, VectorMap
from tflane_jax.world.mirror import markers_beside
from tflane_jax.world.render.camera import PinholeCamera
from tflane_jax.world.roads.markers import PlacementConfig, Visible, approaching, marker_pose


@dataclass(frozen=True)
class BoardsConfig:
    """Where virtual boards stand.

    Attributes:
        seed: of ids, small deviations of the boards, and the noise of their detection, with the segment's name.
        placement: as in the built-in world. With `site` "clear", a board moves along the lane and back from it until
            the segment's own frames, 8 to 50 m before it, have it in their images; where no frame passes, it stays.
        lane_width: assumed width of a lane, metres: the files of centerlines have no boundaries. A board stands half of
            it, the road's edge (0.5 m) and `placement.setback` to the right of the rightmost lane.
    """

    seed: Seed = 0
    placement: PlacementConfig = PlacementConfig(site="clear")
    lane_width: Positive = 3.5


@dataclass(frozen=True)
class SegmentFrame:
    """One frame of a segment.

    Attributes:
        timestamp_ns: time.
        lanes: what it annotates.
        cameras: calibrated, with the sizes of the images in the files; those that the frame has.
    """

    timestamp_ns: int
    lanes: FrameLanes
    cameras: tuple[PinholeCamera, ...]


def segment_frame(
    file: FrameFile, names: FieldNames, timestamp_ns: int, sizes: Sequence[tuple[int, int] | None]
) -> SegmentFrame:
    """Return what a frame's file says; without an annotation there are no lanes.

    Args:
        file: of the frame.
        names: of its flavour.
        timestamp_ns: its time.
        sizes: width and height of each camera's images; None leaves the camera out.
    """
    pose, where = file.global_from_ego, f"{file.path}: annotation"
    lanes = FrameLanes(pose, [], [], np.zeros(0, bool), np.zeros((0, 0), bool))
    if file.annotation is not None:
        found = read_annotation(file.annotation, names, where)
        ids = lane_ids(file.annotation, names, where)
        lanes = FrameLanes(pose, ids, found.lines, found.is_connector, found.successor)
    cameras = [
        PinholeCamera(*size, camera.intrinsics, invert_pose(camera.ego_from_camera))
        for camera, size in zip(file.cameras, sizes, strict=True)
        if camera is not None and size is not None
    ]
    return SegmentFrame(timestamp_ns, lanes, tuple(cameras))


class SegmentBoards:
    """The boards of segments and what each frame detects of them; a segment is prepared once and kept (0.3 MB).

    Args:
        boards: where they stand.
        config: of the prior; its cameras and what hides boards do not apply.
        range_: perception range.
        read: name of a segment -> its frames in the order of time.

    Raises UserError for a prior from pixels: the photographs show no boards.
    """

    def __init__(
        self,
        boards: BoardsConfig,
        config: MarkerConfig,
        range_: PerceptionRange,
        read: Callable[[str], Sequence[SegmentFrame]],
    ):
        if config.pixels is not None:
            raise UserError(
                "OpenLane-V2's photographs show no boards to be read from pixels: set data.example.markers.pixels to "
                "None, which simulates the detections of virtual boards"
            )
        self._boards, self._range, self._read = boards, range_, read
        self._config = replace(config, simulation=replace(config.simulation, cameras=None, occlusion="none"))
        self._segments: dict[str, _Segment] = {}

    def observations(self, name: str, frame: int) -> MarkerObservations:
        """Return what frame number `frame` of a segment detects."""
        if name not in self._segments:
            self._segments[name] = _Segment(name, self._read(name), self._boards, self._config.radius)
        segment, simulation = self._segments[name], self._config.simulation
        moment = segment.log.keyframes[frame]
        before = moment_before(segment.log, frame, simulation.residual_interval)

        def detected(then: KeyFrame):
            cameras = segment.cameras[then.track_frame]
            return simulate_detections(segment.log, then, segment.markers, simulation, cameras=cameras)

        return observations(
            detected(moment),
            segment.store,
            self._config,
            self._range,
            previous=None if before is None else detected(before),
            now_from_previous=None if before is None else relative_pose(moment.global_from_ego, before.global_from_ego),
        )

    def markers(self, name: str) -> PlacedMarkers:
        """Return the boards of a segment whose frames have been asked for."""
        return self._segments[name].markers


class _Segment:
    """Boards, store and cameras of one segment."""

    def __init__(self, name: str, frames: Sequence[SegmentFrame], boards: BoardsConfig, radius: float):
        lanes = segment_lanes([frame.lanes for frame in frames], boards.lane_width)
        self.cameras = [frame.cameras for frame in frames]
        self.log = _log(name, frames, VectorMap(lanes), zlib.crc32(f"{boards.seed}/{name}".encode()))
        poses = self.log.global_from_ego
        clear = boards.placement.site == "clear"
        seen = _seen_by(poses, self.cameras, boards.placement.size) if clear else None
        self.markers = markers_beside(self.log.map, self.log.seed, boards.placement, seen, poses)
        self.store: MarkerStore = store_of(lanes, self.markers, radius=radius, source=name)
        # Lanes are in the store; what is left of the log is small.
        self.log = replace(self.log, map=VectorMap({}))


def _log(name: str, frames: Sequence[SegmentFrame], vector_map: VectorMap, seed: int) -> Log:
    poses = np.stack([frame.lanes.global_from_ego for frame in frames])
    times = np.array([frame.timestamp_ns for frame in frames], np.int64)
    nobody = Tracks.empty(len(frames))
    return Log(
        name=name,
        source="openlane_v2",
        map=vector_map,
        timestamps_ns=times,
        global_from_ego=poses,
        tracks=nobody,
        actors=nobody,
        keyframes=tuple(KeyFrame(int(time), pose, i) for i, (time, pose) in enumerate(zip(times, poses, strict=True))),
        seed=seed,
    )


def _seen_by(poses: Float[np.ndarray, "f 4 4"], cameras: Sequence[tuple[PinholeCamera, ...]], size: float) -> Visible:
    """Return the function that says in which fraction of the frames that approach a board it lies in an image."""

    def visible(place: Float[np.ndarray, "3"], heading: float) -> float:
        rows: list[int] = approaching(poses, place, heading).tolist()
        if not rows:
            return 1.0
        board = marker_pose(place[None], np.array([heading + np.pi]))
        return float(np.mean([in_images(relative_pose(poses[row], board), size, cameras[row])[0] for row in rows]))

    return visible

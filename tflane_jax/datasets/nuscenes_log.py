"""A scene of nuScenes as a `Log`: key frames at 2 Hz, poses, and the boxes of each instance as a track.

nuScenes has no heights: the z of every ego pose is 0, also uphill. Boxes are therefore taken into the vehicle's frame
of their own moment with its whole pose, but moved from frame to frame, like the flat map, in the plane: the poses of
the log are level (x, y and yaw).
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.datasets.nuscenes_splits import MISPLACED
from tflane_jax.datasets.nuscenes_tables import Row, Tables, poses_of, vectors
from tflane_jax.datasets.plausible import (
    check_distance,
    check_headings,
    check_interval,
    check_motion,
    check_place,
    missing_frames,
)
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, pose_yaw, relative_pose, transform_points, wrap_angle, yaw_pose
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import KeyFrame, Log, Side, Tracks, VectorMap

CATEGORIES: Mapping[str, RoadUser | None] = {
    "vehicle.car": RoadUser.CAR,
    "vehicle.emergency.police": RoadUser.CAR,
    "vehicle.emergency.ambulance": RoadUser.TRUCK,
    "vehicle.truck": RoadUser.TRUCK,
    "vehicle.trailer": RoadUser.TRUCK,
    "vehicle.construction": RoadUser.TRUCK,
    "vehicle.bus": RoadUser.BUS,
    "vehicle.motorcycle": RoadUser.MOTORCYCLE,
    "vehicle.bicycle": RoadUser.BICYCLE,
    "vehicle.ego": None,
    "human.pedestrian": RoadUser.PEDESTRIAN,
    "movable_object": None,
    "static_object": None,
    "static": None,
    "flat": None,
    "animal": None,
    "noise": None,
}
"""Road user of each category and of those below it; None is no traffic: barriers, cones and racks have tracks too."""

ReferenceFrame = Literal["ego", "lidar"]
"""Origin and heading of the frame of all examples, x forward, y left: the vehicle's, or MapTR's, see `level_poses`."""
Visibility = Literal["v0-40", "v40-60", "v60-80", "v80-100"]
VISIBILITY: tuple[Visibility, ...] = ("v0-40", "v40-60", "v60-80", "v80-100")
"""Levels of the table `visibility`: percent of an object that the six cameras see together."""

# Frames of a gap at most: nothing looks back farther.
_LONGEST_GAP = 200


@dataclass(frozen=True)
class SceneFrames:
    """Moments and poses of the key frames of a scene.

    Attributes:
        samples: F rows.
        timestamps_ns: (F,) of the samples.
        global_from_ego: (F, 4, 4) at the moment of the lidar, with pitch and roll.
        global_from_frame: (F, 4, 4) level poses of the frame in which examples are made.
    """

    samples: tuple[Row, ...]
    timestamps_ns: Int[np.ndarray, " f"]
    global_from_ego: Float[np.ndarray, "f 4 4"]
    global_from_frame: Float[np.ndarray, "f 4 4"]

    @property
    def frame_from_ego(self) -> Float[np.ndarray, "f 4 4"]:
        """Pose of the vehicle in the frame of examples, in the vehicle's own plane; the identity for frame "ego"."""
        return relative_pose(self.global_from_frame, level_poses(self.global_from_ego))


def level_poses(
    global_from_ego: Float[np.ndarray, "f 4 4"], ego_from_lidar: Float[np.ndarray, "f 4 4"] | None = None
) -> Float[np.ndarray, "f 4 4"]:
    """Return x, y and yaw of the vehicle, or of MapTR's patch, as poses on the ground, x forward, y left.

    MapTR cuts its ground truth around the lidar, about 0.94 m ahead of the rear axle, and calls x right and y forward:
    a point of that frame is (-y, x) of this one.

    Args:
        global_from_ego: poses of the vehicle.
        ego_from_lidar: calibration of the lidar, for MapTR's frame.
    """
    if ego_from_lidar is None:
        return yaw_pose(global_from_ego[:, 0, 3], global_from_ego[:, 1, 3], pose_yaw(global_from_ego))
    lidar = global_from_ego @ ego_from_lidar
    return yaw_pose(lidar[:, 0, 3], lidar[:, 1, 3], pose_yaw(lidar) + np.pi / 2)


def scene_frames(tables: Tables, scene: Row, frame: ReferenceFrame = "ego") -> SceneFrames:
    """Return the key frames of a scene.

    Raises:
        UserError: the chain of samples is broken, the vehicle jumps, times are not in microseconds, or a sample has no
            lidar frame or no proper pose.
    """
    samples = tables.samples(scene)
    ego = np.stack([tables.ego_pose(sample) for sample in samples])
    where = tables.where("scene", scene["token"])
    if samples[-1]["timestamp"] > np.iinfo(np.int64).max // 1000:  # the latest
        raise UserError(f"{where}: a sample has the time {samples[-1]['timestamp']}: expected microseconds")
    times = np.array([sample["timestamp"] for sample in samples], np.int64) * 1000
    check_interval(times, "microseconds", where)
    check_motion(ego[:, :2, 3], times, [tables.where("sample", sample["token"]) for sample in samples])
    lidar = np.stack([tables.calibration(sample) for sample in samples]) if frame == "lidar" else None
    return SceneFrames(
        samples=tuple(samples),
        timestamps_ns=times,
        global_from_ego=ego,
        global_from_frame=level_poses(ego, lidar),
    )


def scene_log(
    tables: Tables,
    scene: Row,
    frames: SceneFrames,
    vector_map: VectorMap | None,
    *,
    least_visibility: Visibility = "v0-40",
) -> Log:
    """Return a scene as a log.

    Args:
        tables, scene, frames: see `scene_frames`.
        vector_map: around the scene, global metres; None leaves it empty.
        least_visibility: boxes of a lower level count as occluded, as those without lidar and radar points always do.

    Raises:
        UserError: a box is malformed, far from the vehicle, has an unknown category, or is a second one of its instance
            in a sample; or the vehicle never comes near a lane of the map, except in scenes that are known for it.
    """
    if vector_map is not None and scene["name"] not in MISPLACED:
        lanes = [lane.centerline for lane in vector_map.segments.values()]
        where = f"{scene['name']} on the map of {tables.location(scene)}"
        check_place(lanes, frames.global_from_frame[:, :2, 3], where)
    tracks = scene_tracks(tables, frames, CATEGORIES, least_visibility)
    log = Log(
        name=scene["name"],
        source="nuscenes",
        map=VectorMap({}) if vector_map is None else replace(vector_map, side=side_of(tables.location(scene))),
        timestamps_ns=frames.timestamps_ns,
        global_from_ego=frames.global_from_frame,
        tracks=tracks,
        actors=tracks,
        keyframes=key_frames(frames),
        seed=zlib.crc32(scene["name"].encode()),
        area=tables.location(scene),
    )
    return with_gaps(log)


def with_gaps(log: Log) -> Log:
    """Return a log with empty track frames where frames are missing, so that a number of frames is a time.

    The empty frames have the pose before the gap (see `missing_frames`); there are at most as many as any history has.
    """
    missing = np.clip(missing_frames(log.timestamps_ns), 0, _LONGEST_GAP)
    if not missing.any():
        return log
    frame = np.concatenate([[0], np.cumsum(missing + 1)])  # of each recorded frame: its number in the result
    every = np.arange(frame[-1] + 1)
    source = np.searchsorted(frame, every, side="right") - 1  # the recorded frame at or before each
    recorded = np.isin(every, frame)
    tracks = replace(
        log.tracks,
        position=log.tracks.position[source],
        yaw=log.tracks.yaw[source],
        occluded=log.tracks.occluded[source],
        valid=log.tracks.valid[source] & recorded[:, None],
    )
    first = log.timestamps_ns[0]
    times = np.interp(every, frame, (log.timestamps_ns - first).astype(float))
    return replace(
        log,
        timestamps_ns=first + np.round(times).astype(np.int64),
        global_from_ego=log.global_from_ego[source],
        tracks=tracks,
        actors=tracks,
        keyframes=tuple(replace(moment, track_frame=int(frame[moment.track_frame])) for moment in log.keyframes),
    )


def key_frames(frames: SceneFrames) -> tuple[KeyFrame, ...]:
    """Return the moments that become examples: all of them."""
    poses = zip(frames.timestamps_ns.tolist(), frames.global_from_frame, strict=True)
    return tuple(KeyFrame(time, pose, number) for number, (time, pose) in enumerate(poses))


def side_of(location: str) -> Side | None:
    """Return the side on which traffic keeps in a city of nuScenes; None for any other."""
    sides: dict[str, Side] = {"singapore": "left", "boston": "right"}
    return sides.get(location.partition("-")[0])


def scene_tracks(
    tables: Tables,
    frames: SceneFrames,
    categories: Mapping[str, RoadUser | None] = CATEGORIES,
    least_visibility: Visibility = "v0-40",
) -> Tracks:
    """Return the boxes of a scene: a track for each instance token, without a box where a sample has none of it."""
    found = [
        (number, row)
        for number, sample in enumerate(frames.samples)
        for row in tables.annotations.get(sample["token"], ())
        if _category(tables, row, categories) is not None
    ]
    rows = [row for _, row in found]
    where = [tables.where("sample_annotation", row["token"]) for row in rows]
    pose, size = poses_of(rows, where), vectors(rows, "size", 3, where)
    if (size <= 0.0).any():
        bad = int((size <= 0.0).any(-1).argmax())
        raise UserError(f"{where[bad]}: size {size[bad].tolist()} is not positive")
    instance, first, k = np.unique([row["instance_token"] for row in rows], return_index=True, return_inverse=True)
    f = np.array([number for number, _ in found], int)
    _check_once(f, k, rows, where)
    tracks = Tracks.empty(len(frames.samples), instance)
    tracks.size[:] = size[first][:, [1, 0, 2]]  # the table has width, length, height
    tracks.category[:] = [_category(tables, rows[i], categories) for i in first]
    global_from_ego, frame_from_ego = frames.global_from_ego[f], frames.frame_from_ego[f]
    ego_center = transform_points(invert_pose(global_from_ego), pose[:, None, :3, 3])
    check_distance(ego_center[:, 0], where)
    tracks.position[f, k] = transform_points(frame_from_ego, ego_center)[:, 0]
    yaw = pose_yaw(pose) - pose_yaw(global_from_ego) + pose_yaw(frame_from_ego)
    tracks.yaw[f, k] = wrap_angle(yaw)
    tracks.occluded[f, k] = _unseen(tables, rows, where, least_visibility)
    tracks.valid[f, k] = True
    place = f"{tables.folder / 'sample_annotation'}.json: boxes from sample {frames.samples[0]['token']} on"
    check_headings(tracks, frames.global_from_frame, frames.timestamps_ns, place)
    return tracks


def road_user(category: str, where: str, categories: Mapping[str, RoadUser | None] = CATEGORIES) -> RoadUser | None:
    """Return the road user of a category such as "vehicle.bus.bendy", by the longest entry that it starts with.

    Raises UserError, which names the place, for a category that no entry covers.
    """
    parts = category.split(".")
    for length in range(len(parts), 0, -1):
        if (name := ".".join(parts[:length])) in categories:
            return categories[name]
    raise UserError(
        f"{where}: unknown category {category!r}: name it below a known one there, such as vehicle.car.{parts[-1]}, or "
        "add it to CATEGORIES of tflane_jax/datasets/nuscenes_log.py with its road user"
    )


def _category(tables: Tables, annotation: Row, categories: Mapping[str, RoadUser | None]) -> RoadUser | None:
    token = tables.rows["instance"][annotation["instance_token"]]["category_token"]
    return road_user(tables.rows["category"][token]["name"], tables.where("category", token), categories)


def _check_once(f: np.ndarray, k: np.ndarray, rows: Sequence[Row], where: Sequence[str]) -> None:
    """Raise UserError where an instance has two boxes in a sample."""
    _, first, count = np.unique(np.stack([f, k]), axis=1, return_index=True, return_counts=True)
    if (count > 1).any():
        row = int(first[count.argmax()])
        raise UserError(
            f"{where[row]}: instance {rows[row]['instance_token']} has {count.max()} boxes in sample "
            f"{rows[row]['sample_token']}"
        )


def _unseen(tables: Tables, rows: Sequence[Row], where: Sequence[str], least: Visibility) -> Bool[np.ndarray, " n"]:
    """Return which boxes the sensors did not see: no points, or a known visibility below the least one."""
    points = np.array([row["num_lidar_pts"] + row["num_radar_pts"] for row in rows], int)
    known = tables.rows["visibility"]
    levels = [known[row["visibility_token"]]["level"] if row["visibility_token"] else "" for row in rows]
    rank = {"": len(VISIBILITY), **{level: number for number, level in enumerate(VISIBILITY)}}
    for level, place in zip(levels, where, strict=True):
        if level not in rank:
            raise UserError(f"{place}: unknown visibility level {level!r}, expected one of {', '.join(VISIBILITY)}")
    return (points == 0) | (np.array([rank[level] for level in levels], int) < VISIBILITY.index(least))

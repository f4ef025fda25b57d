"""Small logs and maps that can be drawn on paper."""

import numpy as np

from tflane_jax.geometry import yaw_pose
from tflane_jax.scene import LineType, RoadUser
from tflane_jax.scene.logs import KeyFrame, LaneSegment, Log, Tracks, VectorMap


def segment(number, centerline, successors=(), *, width=3.5, left=LineType.DASHED, right=LineType.SOLID, **other):
    """Return a lane segment whose boundaries run beside the centerline (n, 2)."""
    line = np.column_stack([np.asarray(centerline, float), np.zeros(len(centerline))])
    heading = np.gradient(line[:, :2], axis=0)
    heading /= np.linalg.norm(heading, axis=-1, keepdims=True)
    side = np.column_stack([-heading[:, 1], heading[:, 0], np.zeros(len(line))]) * width / 2
    return LaneSegment(
        number,
        line,
        line + side,
        line - side,
        left,
        right,
        other.pop("is_intersection", False),
        tuple(successors),
        **other,
    )


def lane_map(*segments, **other):
    return VectorMap({s.id: s for s in segments}, **other)


def tracks(position, yaw=None, *, valid=None, occluded=None, size=(4.0, 2.0, 1.5), category=RoadUser.CAR):
    """Return tracks from positions (F, K, 3)."""
    position = np.asarray(position, float)
    f, k = position.shape[:2]
    return Tracks(
        position=position,
        yaw=np.zeros((f, k)) if yaw is None else np.asarray(yaw, float),
        size=np.tile(np.asarray(size, float), (k, 1)),
        category=np.full(k, category, np.int32),
        occluded=np.zeros((f, k), bool) if occluded is None else np.asarray(occluded, bool),
        valid=np.ones((f, k), bool) if valid is None else np.asarray(valid, bool),
        uuid=np.array([f"track {i}" for i in range(k)]),
    )


def log(vector_map, recorded, poses, keyframes, **other):
    """Return a log whose key frames are (track frame, pose)."""
    frames = len(poses)
    return Log(
        name="small",
        source="test",
        map=vector_map,
        timestamps_ns=np.arange(frames) * 100_000_000,
        global_from_ego=np.asarray(poses, float).reshape(frames, 4, 4),
        tracks=recorded,
        actors=recorded,
        keyframes=tuple(KeyFrame(frame * 100_000_000, np.asarray(pose), frame) for frame, pose in keyframes),
        **other,
    )


def drive(frames, *, start=(1000.0, -2000.0), step=0.7, turn=0.03):
    """Return the poses (F, 4, 4) of an ego vehicle far from the origin that drives and turns."""
    yaw = 0.4 + turn * np.arange(frames)
    x = start[0] + np.cumsum(step * np.cos(yaw))
    y = start[1] + np.cumsum(step * np.sin(yaw))
    return yaw_pose(x, y, yaw)

"""Which boards a vehicle's cameras see: in the image, and not behind a body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import invert_pose, pose_yaw, relative_pose, transform_points, yaw_pose
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.scene.logs import KeyFrame, Log
from tflane_jax.world.bev.line_of_sight import hidden_points, occluders_from
from tflane_jax.world.cameras.ring import CameraMount, CameraRigConfig, draw_rig
from tflane_jax.world.render.camera import PinholeCamera

# Points of a square of side 1 at which it is looked at: the middles of 7 x 7 cells.
_CELLS = (np.arange(7) + 0.5) / 7.0 - 0.5
_POINTS = np.array([(x, y, 0.0) for y in _CELLS for x in _CELLS])
# Nearer than this a camera sees no board, metres.
_NEAR = 0.5


def seen_fraction(
    log: Log,
    moment: KeyFrame,
    ego_from_marker: Float[np.ndarray, "m 4 4"],
    size: float,
    mounts: Sequence[CameraMount],
    bodies: Float[np.ndarray, "b 7"] | None,
) -> Float[np.ndarray, " m"]:
    """Return the largest fraction of each square that one of the cameras sees; 0 if no image has the whole square.

    Args:
        log, moment: scene, whose road users hide boards too.
        ego_from_marker: poses of the boards.
        size: side of the black square, metres.
        mounts: cameras, with the calibration that the log has.
        bodies: static boxes as `Bodies.boxes`, global frame; None: nothing hides a board.
    """
    boxes = None if bodies is None else _boxes_around(log, moment, bodies)
    points = transform_points(ego_from_marker[:, None], size * _POINTS)
    best = np.zeros(len(ego_from_marker))
    for camera in _cameras(log, mounts):
        rows = np.flatnonzero(in_image(ego_from_marker, size, camera))
        best[rows] = np.maximum(best[rows], _in_sight(camera, points[rows], boxes))
    return best


def fraction_in_sight(
    log: Log,
    moment: KeyFrame,
    ego_from_marker: Float[np.ndarray, "m 4 4"],
    size: float,
    mounts: Sequence[CameraMount],
    bodies: Float[np.ndarray, "b 7"],
) -> Float[np.ndarray, " m"]:
    """Return the fraction of each square that nothing hides from the first camera's place, wherever it looks.

    Arguments are those of `seen_fraction`.
    """
    points = transform_points(ego_from_marker[:, None], size * _POINTS)
    return _in_sight(_cameras(log, mounts)[0], points, _boxes_around(log, moment, bodies))


def _cameras(log: Log, mounts: Sequence[CameraMount]) -> tuple[PinholeCamera, ...]:
    return tuple(draw_rig(log.seed, CameraRigConfig(cameras=tuple(mounts), scale=1.0)))


def _in_sight(
    camera: PinholeCamera, points: Float[np.ndarray, "m p 3"], boxes: Float[np.ndarray, "b 7"] | None
) -> Float[np.ndarray, " m"]:
    """Return the fraction of each square's points that no box hides from a camera."""
    if boxes is None or not len(points):
        return np.ones(len(points))
    eye = invert_pose(camera.camera_from_ego)[:3, 3]
    hidden = hidden_from(eye, points.reshape(-1, 3), boxes)
    return 1.0 - hidden.reshape(len(points), -1).mean(-1)


def in_image(ego_from_marker: Float[np.ndarray, "m 4 4"], size: float, camera: PinholeCamera) -> Bool[np.ndarray, " m"]:
    """Return which squares lie in an image as a whole."""
    depth = (camera.camera_from_ego @ ego_from_marker)[:, 2, 3]
    inside = np.zeros(len(depth), bool)
    for row in np.flatnonzero(depth > _NEAR + size):
        outline = marker_outline(ego_from_marker[row], size, camera.intrinsics, camera.camera_from_ego)
        inside[row] = bool(((outline > 0.0) & (outline < [camera.width, camera.height])).all())
    return inside


def in_images(
    ego_from_marker: Float[np.ndarray, "m 4 4"], size: float, cameras: Sequence[PinholeCamera]
) -> Bool[np.ndarray, " m"]:
    """Return which squares lie as a whole in an image of one of the cameras."""
    nowhere = np.zeros(len(ego_from_marker), bool)
    return np.any([nowhere, *(in_image(ego_from_marker, size, camera) for camera in cameras)], axis=0)


def hidden_from(
    eye: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 3"], boxes: Float[np.ndarray, "b 7"]
) -> Bool[np.ndarray, " n"]:
    """Return which points the boxes (as `Bodies.boxes`) hide from an eye, all in one frame."""
    return hidden_points(
        points[:, :2] - eye[:2],
        occluders_from(boxes, eye),
        np.zeros((0, 5)),
        sensor_height=float(eye[2]),
        target_height=points[:, 2],
    )


def _boxes_around(log: Log, moment: KeyFrame, bodies: Float[np.ndarray, "b 7"]) -> Float[np.ndarray, "k 7"]:
    """Return static bodies and road users as rows of `Bodies.boxes`, ego frame."""
    pose = relative_pose(moment.global_from_ego, yaw_pose(bodies[:, 0], bodies[:, 1], bodies[:, 4]))
    static = np.column_stack([pose[:, :2, 3], bodies[:, 2:4], pose_yaw(pose), bodies[:, 5:]])
    actors, frame = log.actors, moment.track_frame
    there = actors.valid[frame]
    ego_from_track = relative_pose(moment.global_from_ego, log.global_from_ego[frame])
    size, place = actors.size[there], transform_points(ego_from_track, actors.position[frame, there])
    yaw, ground = actors.yaw[frame, there] + pose_yaw(ego_from_track), np.zeros(len(size))
    users = np.column_stack([place[:, :2], size[:, :2], yaw, ground, size[:, 2]])
    return np.concatenate([static.reshape(-1, 7), users.reshape(-1, 7)])

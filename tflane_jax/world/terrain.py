"""Slopes: a simulated scene is laid over hilly ground.

Roads and traffic are simulated on the level. Then every point moves up by the height of the ground below it, and
vehicles stand on the slope. Speeds and sight lines stay those of the level world: hills hide nothing from the tracker
and from the evidence sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, pose_yaw, transform_points
from tflane_jax.limits import ASCENDING, Count, at_least, within
from tflane_jax.scene.logs import KeyFrame, Log, Relief, Tracks
from tflane_jax.scene.terrain import Terrain
from tflane_jax.world.moving import moved_boxes, moved_map, with_vertices

_Hill = Annotated[float, at_least(50)]


@dataclass(frozen=True)
class TerrainConfig:
    """Hills.

    Attributes:
        grade: root mean square of the slope in the steepest direction, metres a metre; 0.05 is 5 %.
        wavelength: shortest and longest distance from hill to hill, metres.
        waves: how many waves are added up.
    """

    grade: Annotated[float, within(0, 0.2)] = 0.05
    wavelength: Annotated[tuple[_Hill, _Hill], ASCENDING] = (150.0, 400.0)
    waves: Count = 6

    def draw(self, rng: np.random.Generator) -> Terrain:
        """Return random ground; raises UserError for settings that give none."""
        low, high = self.wavelength
        if not (0.0 <= self.grade <= 0.2 and 50.0 <= low <= high and self.waves >= 1):
            raise UserError(
                "terrain needs a grade from 0 to 0.2, wavelengths from 50 m upwards and at least one wave, not "
                f"{self.grade:g}, {low:g} to {high:g} m and {self.waves}"
            )
        length = np.exp(rng.uniform(np.log(low), np.log(high), self.waves))
        turn, phase = rng.uniform(0.0, 2.0 * np.pi, (2, self.waves))
        number = 2.0 * np.pi / length
        waves = number[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
        # The mean square of a cosine is a half.
        return Terrain(waves, phase, self.grade * np.sqrt(2.0 / self.waves) / number)


def on_terrain(log: Log, terrain: Terrain) -> Log:
    """Return the scene of a level world on hilly ground.

    Args:
        log: level, with poses on the plane z = 0.
        terrain: the ground.
    """
    level = log.global_from_ego
    poses = terrain.pose(level[:, :2, 3], pose_yaw(level))
    moments = (replace(moment, global_from_ego=poses[moment.track_frame]) for moment in log.keyframes)
    tracks, actors = moved_boxes(log, lambda boxes: _raised_tracks(boxes, level, poses, terrain))
    return replace(
        log,
        map=moved_map(log.map, lambda line: terrain.raised(with_vertices(line)), terrain.raised),
        global_from_ego=poses,
        tracks=tracks,
        actors=actors,
        keyframes=tuple[KeyFrame, ...](moments),
        markers=None if log.markers is None else replace(log.markers, pose=_raised_poses(log.markers.pose, terrain)),
        relief=Relief(terrain, log),
    )


def _raised_tracks(
    tracks: Tracks, old_poses: Float[np.ndarray, "f 4 4"], new_poses: Float[np.ndarray, "f 4 4"], terrain: Terrain
) -> Tracks:
    """Return boxes of vehicles that stand on the ground; poses are global_from_ego of the frames, before and after."""
    places = terrain.raised(transform_points(old_poses, tracks.position))  # global
    position = transform_points(invert_pose(new_poses), places)
    yaw = tracks.yaw + pose_yaw(old_poses)[:, None]
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    ahead = np.concatenate([ahead, (terrain.slope(places[..., :2]) * ahead).sum(-1, keepdims=True)], -1)
    ahead = ahead @ new_poses[:, :3, :3]  # into the ego frame
    yaw = np.arctan2(ahead[..., 1], ahead[..., 0])
    return replace(
        tracks,
        position=np.where(tracks.valid[..., None], position, tracks.position),
        yaw=np.where(tracks.valid, yaw, tracks.yaw),
    )


def _raised_poses(poses: Float[np.ndarray, "m 4 4"], terrain: Terrain) -> Float[np.ndarray, "m 4 4"]:
    """Return boards moved up; they stay upright."""
    found = poses.copy()
    found[:, :3, 3] = terrain.raised(poses[:, :3, 3])
    return found

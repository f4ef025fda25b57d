"""A drive on bent ground plans: the same roads and traffic, stretched, sheared and bent.

Junctions get other angles, straight roads bend, lanes and distances get other widths and lengths. Everything moves with
the ground: lanes, kerbs, road users, the ego vehicle. Vehicles keep their sizes. Detections and occlusions of the
tracker are those of the scene before it was bent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import invert_pose, pose_yaw, transform_points, yaw_pose
from tflane_jax.limits import ASCENDING, Count, Fraction, Positive, Rules
from tflane_jax.scene.logs import Log, Tracks, VectorMap
from tflane_jax.world.moving import moved_boxes, moved_map, with_vertices
from tflane_jax.world.traffic.tracker import wrap_outside


@dataclass(frozen=True, eq=False)
class Warp:
    """A smooth map of the plane onto itself that keeps left and right, global metres.

    x -> matrix x + sum_i shift_i sin(waves_i x + phase_i)

    Attributes:
        matrix: (2, 2).
        waves: (n, 2) wave vectors, radians a metre.
        phase: (n,) radians.
        shift: (n, 2) amplitudes, metres.
    """

    matrix: Float[np.ndarray, "2 2"]
    waves: Float[np.ndarray, "n 2"]
    phase: Float[np.ndarray, " n"]
    shift: Float[np.ndarray, "n 2"]

    def moved(self, points: Float[np.ndarray, "*b d"]) -> Float[np.ndarray, "*b d"]:
        """Return where points are now; heights stay."""
        xy = points[..., :2]
        there = xy @ self.matrix.T + np.sin(xy @ self.waves.T + self.phase) @ self.shift
        return np.concatenate([there, points[..., 2:]], -1)

    def jacobian(self, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2 2"]:
        """Return the derivative at points: [..., i, j] is that of coordinate i by x_j."""
        slope = np.cos(xy @ self.waves.T + self.phase)
        return self.matrix + np.einsum("...n,ni,nj->...ij", slope, self.shift, self.waves)

    def along(self, xy: Float[np.ndarray, "*b 2"], yaw: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b 2"]:
        """Return what a step of one metre in a direction at a point becomes."""
        return (self.jacobian(xy) @ np.stack([np.cos(yaw), np.sin(yaw)], -1)[..., None])[..., 0]

    def turned(self, xy: Float[np.ndarray, "*b 2"], yaw: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
        """Return the new heading of what has a heading at a point, radians."""
        step = self.along(xy, yaw)
        return np.arctan2(step[..., 1], step[..., 0])

    @property
    def least_scale(self) -> float:
        """A lower bound on how much a distance shrinks."""
        strain = np.linalg.norm(self.shift, axis=-1) * np.linalg.norm(self.waves, axis=-1)
        return float(np.linalg.svd(self.matrix)[1].min() - strain.sum())


@dataclass(frozen=True)
class WarpConfig:
    """How much ground plans are bent.

    Attributes:
        stretch: of lengths, drawn for each of two axes at right angles, in a random direction.
        shear: largest metres along one axis for a metre along the other.
        strain: root mean square of what the waves add to a metre, metres.
        wavelength: shortest and longest wave, metres.
        waves: how many are added up.
    """

    stretch: Annotated[tuple[Positive, Positive], ASCENDING] = (0.85, 1.2)
    shear: Fraction = 0.2
    strain: Fraction = 0.08
    wavelength: Annotated[tuple[Positive, Positive], ASCENDING] = (60.0, 300.0)
    waves: Count = 4

    def limits(self) -> Rules:
        """The ground never folds."""
        left = self.stretch[0] ** 2 / (self.stretch[1] + self.shear) - math.sqrt(2.0 * self.waves) * self.strain
        yield "strain", left > 0.2, "less: the ground would fold, with this stretch, shear and number of waves"

    def draw(self, rng: np.random.Generator) -> Warp:
        """Return a random one."""
        (least, most), (low, high) = np.log(self.stretch), self.wavelength
        a, b = np.exp(rng.uniform(least, most, 2))
        axis, shear = rng.uniform(0.0, np.pi), rng.uniform(-self.shear, self.shear)
        turn = np.array([[np.cos(axis), -np.sin(axis)], [np.sin(axis), np.cos(axis)]])
        number = 2.0 * np.pi / np.exp(rng.uniform(np.log(low), np.log(high), self.waves))
        heading, across, phase = rng.uniform(0.0, 2.0 * np.pi, (3, self.waves))
        # The mean square of a cosine is a half.
        amplitude = self.strain * np.sqrt(2.0 / self.waves) / number
        return Warp(
            turn @ np.array([[a, shear], [0.0, b]]) @ turn.T,
            number[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1),
            phase,
            amplitude[:, None] * np.stack([np.cos(across), np.sin(across)], -1),
        )


def warped(log: Log, warp: Warp) -> Log:
    """Return a level drive on a bent ground plan."""
    assert log.relief is None
    at, yaw = log.global_from_ego[:, :2, 3], pose_yaw(log.global_from_ego)
    there = warp.moved(at)
    poses = yaw_pose(there[:, 0], there[:, 1], warp.turned(at, yaw))
    tracks, actors = moved_boxes(log, lambda boxes: _warped_tracks(boxes, log.global_from_ego, poses, warp))
    markers = log.markers
    return replace(
        log,
        map=warped_map(log.map, warp),
        global_from_ego=poses,
        tracks=tracks,
        actors=actors,
        keyframes=tuple(replace(moment, global_from_ego=poses[moment.track_frame]) for moment in log.keyframes),
        markers=None if markers is None else replace(markers, pose=_warped_boards(markers.pose, warp)),
    )


def warped_map(found: VectorMap, warp: Warp) -> VectorMap:
    """Return a map on a bent ground plan."""
    moved = moved_map(found, lambda line: warp.moved(with_vertices(line)), warp.moved)
    xy, (length, width), yaw = found.buildings[:, :2], found.buildings[:, 2:4].T, found.buildings[:, 4]
    sides = [np.linalg.norm(warp.along(xy, yaw + turn), axis=-1) for turn in (0.0, 0.5 * np.pi)]
    blocks = np.column_stack([warp.moved(xy), sides[0] * length, sides[1] * width, warp.turned(xy, yaw)])
    elements = (
        replace(new, yaw=float(warp.turned(np.asarray(old.position[:2], float), np.asarray(old.yaw))))
        for old, new in zip(found.elements, moved.elements, strict=True)
    )
    return replace(moved, buildings=blocks, elements=tuple(elements))


def _warped_tracks(
    tracks: Tracks, old_poses: Float[np.ndarray, "f 4 4"], new_poses: Float[np.ndarray, "f 4 4"], warp: Warp
) -> Tracks:
    """Return boxes that moved and turned with the ground; poses are global_from_ego of the frames, before and after."""
    old = transform_points(old_poses, tracks.position)  # global
    position = transform_points(invert_pose(new_poses), warp.moved(old))
    yaw = warp.turned(old[..., :2], tracks.yaw + pose_yaw(old_poses)[:, None]) - pose_yaw(new_poses)[:, None]
    return replace(
        tracks,
        position=np.where(tracks.valid[..., None], position, tracks.position),
        yaw=np.where(tracks.valid, wrap_outside(yaw), tracks.yaw),
    )


def _warped_boards(poses: Float[np.ndarray, "m 4 4"], warp: Warp) -> Float[np.ndarray, "m 4 4"]:
    """Return boards that have moved, and turned with the direction in which they face."""
    xy, yaw = poses[:, :2, 3], np.arctan2(poses[:, 1, 2], poses[:, 0, 2])
    turn = warp.turned(xy, yaw) - yaw
    found = yaw_pose(np.zeros_like(turn), np.zeros_like(turn), turn) @ poses
    found[:, :3, 3] = warp.moved(poses[:, :3, 3])
    return found

"""Simulated marker detections without images: the noise model of the marker paper (section IV-A).

A marker is visible to a vehicle that approaches its face without occlusion. Detection and pose errors are drawn from a
separate random stream for each log, moment and marker, so they do not depend on which other detections are simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import pose_matrix, pose_yaw, relative_pose, transform_points, yaw_pose
from tflane_jax.limits import ASCENDING, Count, Fraction, Positive, PositiveOrZero, counted, within
from tflane_jax.markers.observe import frame_before
from tflane_jax.markers.pixels import PixelConfig
from tflane_jax.markers.visibility import fraction_in_sight, in_images, seen_fraction
from tflane_jax.scene.logs import KeyFrame, Log, PlacedMarkers
from tflane_jax.world.bev.line_of_sight import hidden_points
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraMount
from tflane_jax.world.cameras.stage import static_boxes
from tflane_jax.world.render.camera import PinholeCamera

ROOT = 20_251_123


@dataclass(frozen=True)
class MarkerSimulationConfig:
    """Visibility, detection probability and pose noise of simulated markers.

    Attributes:
        forward_sigma: standard deviation of the error along the ego x axis at `reference`, metres (paper: 3 m at 60 m).
        yaw_sigma, pitch_sigma: of the orientation at `reference`, degrees (paper: 2 degrees at 60 m). The marker
            rotates about its own center.
        reference: distance to which the three values refer, metres.
        growth: how all three grow with the distance from 0: "linear" or "quadratic". The paper states only that they
            grow; the error of a depth estimated from the marker's size in pixels grows with the square.
        jump: probability of an abrupt jump (paper: 0.05 a frame), on top of the other errors.
        jump_distance: of a jump, in a random direction in the ground plane, metres (paper: about 25).
        jump_yaw: of a jump, degrees (paper: about 90), to the left or right by the octant of its direction.
        jump_spread: relative standard deviation of the jump in position and in yaw.
        detection_sigma: sigma_d of P = exp(-d^2 / (2 sigma_d^2)), metres. The paper fits it but does not report it. The
            default puts P = 1/2 at 47 m, where a 1 m marker is 38 pixels wide in the front camera of Argoverse 2, some
            5 pixels for each of the 7 cells of a 5x5 ArUco marker.
        range: largest distance at which a marker is visible, metres (the paper gives its errors at 60 m).
        field_of_view: full angle of view ahead, degrees.
        cameras: the whole square must lie in the image of one of them, as mounted for the log's seed (recorded images
            of a log have a calibration of their own, which is not used); None asks for the field of view alone, which
            has no upper end.
        frontal: largest angle, from straight at the face, of both the line of sight and the vehicle's heading, degrees:
            a marker is visible only to a vehicle that approaches it frontally.
        occlusion: "bodies": road users, buildings, masts, signs, lamp posts and trees hide markers (needs OpenCV; of
            real logs the first two are known); "line_of_sight": road users and buildings hide the middle of a marker;
            "none": nothing does.
        least_seen: with "bodies", smallest visible fraction of a square that is detected.
        score: range from which the detection score is drawn (uniform).
        residual_interval: r compares with the observation this many seconds before (the paper's frames come at 2 Hz);
            None compares with the previous key frame.
        first_residual: r of a marker that was not detected in that earlier frame, metres.
    """

    forward_sigma: PositiveOrZero = 3.0
    yaw_sigma: PositiveOrZero = 2.0
    pitch_sigma: PositiveOrZero = 2.0
    reference: Positive = 60.0
    growth: Literal["linear", "quadratic"] = "linear"
    jump: Fraction = 0.05
    jump_distance: PositiveOrZero = 25.0
    jump_yaw: PositiveOrZero = 90.0
    jump_spread: PositiveOrZero = 0.1
    detection_sigma: Positive = 40.0
    range: Positive = 60.0
    field_of_view: Annotated[float, within(0, 360)] = 120.0
    frontal: Annotated[float, within(0, 180)] = 60.0
    cameras: tuple[CameraMount, ...] | None = None
    occlusion: Literal["bodies", "line_of_sight", "none"] = "line_of_sight"
    least_seen: Fraction = 0.75
    score: Annotated[tuple[Fraction, Fraction], ASCENDING] = (1.0, 1.0)
    residual_interval: Positive | None = 0.5
    first_residual: PositiveOrZero = 0.0

    def growth_at(self, distance: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
        """Return the factor on the standard deviations at a distance (metres); 1 at `reference`."""
        fraction = distance / self.reference
        return fraction if self.growth == "linear" else fraction**2

    def detection_probability(self, distance: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
        """Return P_detect of a visible marker at a distance (metres)."""
        return np.exp(-(distance**2) / (2.0 * self.detection_sigma**2))


# A simulation without noise, in which every visible marker is detected.
PERFECT = MarkerSimulationConfig(forward_sigma=0.0, yaw_sigma=0.0, pitch_sigma=0.0, jump=0.0, detection_sigma=1e9)


@dataclass(frozen=True)
class MarkerConfig:
    """The marker prior of an example: detections are simulated, or found in images with `pixels`.

    Attributes:
        markers, lanes, points: capacities: M markers, J lanes of each, and P points on each lane. With boards on both
            sides of junctions, no frame of 320 had more than two in sight (docs/markers.md); a marker has at most 34
            lanes in range. Beyond the capacities the farthest markers, and the lanes farthest from their marker, are
            dropped.
        radius: lanes within this distance of a marker are stored, metres.
        simulation: simulation of the detections; with `pixels` only its residual settings apply.
        pixels: detect the boards in native images of the built-in world's cameras instead; None simulates.
    """

    markers: Count = 2
    lanes: Count = 48
    points: Annotated[int, counted(2)] = 11
    radius: Positive = 50.0
    simulation: MarkerSimulationConfig = MarkerSimulationConfig()
    pixels: PixelConfig | None = None


class SimulatedMarkers(NamedTuple):
    """Simulated detections: a row for each marker of the log, in its order.

    Attributes:
        marker_id: (M,) identity.
        pose: (M, 4, 4) float64 noisy ego_from_marker, metres; the identity where not valid.
        score: (M,) detection score.
        jump: (M,) the pose has jumped. For evaluation only, never a model input.
        valid: (M,) detected.
    """

    marker_id: Int[np.ndarray, " m"]
    pose: Float[np.ndarray, "m 4 4"]
    score: Float[np.ndarray, " m"]
    jump: Bool[np.ndarray, " m"]
    valid: Bool[np.ndarray, " m"]


def simulate_detections(
    log: Log,
    moment: KeyFrame,
    markers: PlacedMarkers,
    config: MarkerSimulationConfig,
    *,
    cameras: Sequence[PinholeCamera] | None = None,
) -> SimulatedMarkers:
    """Return which markers are detected at a moment of a log, and their noisy poses.

    The same log seed, track frame and marker id give the same bits, whatever else is simulated.

    Args:
        log, moment, markers, config: see above.
        cameras: calibrated cameras of a real frame, one of which must see the whole square, besides those of `config`;
            None: no such cameras.
    """
    true = relative_pose(moment.global_from_ego, markers.pose)
    seen = visible(true, config)
    if cameras is not None:
        seen[seen] = in_images(true[seen], markers.size, cameras)
    mounts = config.cameras or ARGOVERSE2_RING
    if config.occlusion == "bodies":
        fraction = fraction_in_sight if config.cameras is None else seen_fraction
        shown = fraction(log, moment, true[seen], markers.size, mounts, static_boxes(log))
        # A square outside all images is not seen, even where `least_seen` is 0.
        seen[seen] = (shown > 0.0) & (shown >= config.least_seen)
    elif config.cameras is not None:
        seen[seen] = seen_fraction(log, moment, true[seen], markers.size, mounts, None) > 0.0
    if config.occlusion == "line_of_sight":
        seen[seen] = ~_hidden(log, moment, true[seen])
    count = len(seen)
    drawn = _draws(log.seed, moment.track_frame, markers.marker_id, seen)
    distance = np.hypot(true[:, 0, 3], true[:, 1, 3])
    jump = drawn.uniform[:, 1] < config.jump
    valid = seen & (drawn.uniform[:, 0] < config.detection_probability(distance))
    low, high = config.score
    return SimulatedMarkers(
        marker_id=np.asarray(markers.marker_id),
        pose=np.where(valid[:, None, None], _perturbed(true, distance, jump, drawn, config), np.eye(4)),
        score=np.where(valid, low + (high - low) * drawn.uniform[:, 2], 0.0).reshape(count),
        jump=jump & valid,
        valid=valid,
    )


def visible(ego_from_marker: Float[np.ndarray, "m 4 4"], config: MarkerSimulationConfig) -> Bool[np.ndarray, " m"]:
    """Return which markers are visible without occlusion: within range, ahead, and approached frontally."""
    place, face = ego_from_marker[:, :2, 3], ego_from_marker[:, :2, 2]
    distance = np.hypot(place[:, 0], place[:, 1])
    ahead = np.abs(np.arctan2(place[:, 1], place[:, 0])) <= np.deg2rad(config.field_of_view) / 2
    to_vehicle = -(face * place).sum(-1) / np.where(distance > 0.0, distance, 1.0)
    least = np.cos(np.deg2rad(config.frontal))
    return (distance > 0.0) & (distance <= config.range) & ahead & (to_vehicle >= least) & (-face[:, 0] >= least)


def moment_before(log: Log, keyframe: int, interval: float | None) -> KeyFrame | None:
    """Return the earlier moment of the residual; None if the log has none.

    It is the track frame nearest to `interval` seconds before the key frame, or the previous key frame for `interval`
    None.
    """
    moment = log.keyframes[keyframe]
    if interval is None:
        return log.keyframes[keyframe - 1] if keyframe > 0 else None
    earlier = log.timestamps_ns[: moment.track_frame]
    frame = frame_before(earlier, moment.timestamp_ns, interval)
    if frame is None:
        return None
    return KeyFrame(int(earlier[frame]), log.global_from_ego[frame], frame)


class _Draws(NamedTuple):
    """Random numbers of each marker: (M, 4) in [0, 1) and (M, 5) standard normal; 0 for invisible markers."""

    uniform: Float[np.ndarray, "m 4"]
    normal: Float[np.ndarray, "m 5"]


def _draws(seed: int, frame: int, marker_id: Int[np.ndarray, " m"], wanted: Bool[np.ndarray, " m"]) -> _Draws:
    uniform, normal = np.zeros((len(wanted), 4)), np.zeros((len(wanted), 5))
    for row in np.flatnonzero(wanted):
        rng = np.random.default_rng([ROOT, seed, frame, int(marker_id[row])])
        uniform[row], normal[row] = rng.random(4), rng.standard_normal(5)
    return _Draws(uniform, normal)


def _perturbed(
    true: Float[np.ndarray, "m 4 4"],
    distance: Float[np.ndarray, " m"],
    jump: Bool[np.ndarray, " m"],
    drawn: _Draws,
    config: MarkerSimulationConfig,
) -> Float[np.ndarray, "m 4 4"]:
    """Return poses with the errors of section IV-A: shift along x, jump, and rotation about the marker's center."""
    growth = config.growth_at(distance)
    forward, yaw, pitch, further, turned = drawn.normal.T
    yaw, pitch = growth * config.yaw_sigma * yaw, growth * config.pitch_sigma * pitch
    # One number gives the direction of a jump and, by its octant, the sign of its yaw.
    angle = 2.0 * np.pi * drawn.uniform[:, 3]
    length = np.where(jump, config.jump_distance * (1.0 + config.jump_spread * further), 0.0)
    side = np.where(drawn.uniform[:, 3] * 8.0 % 2.0 < 1.0, 1.0, -1.0)
    yaw += np.where(jump, side * config.jump_yaw * (1.0 + config.jump_spread * turned), 0.0)
    place = true[:, :3, 3] + np.stack(
        [growth * config.forward_sigma * forward + length * np.cos(angle), length * np.sin(angle), 0.0 * angle], -1
    )
    turn = yaw_pose(0.0 * yaw, 0.0 * yaw, np.deg2rad(yaw))[:, :3, :3] @ _about_y(np.deg2rad(pitch))
    return pose_matrix(turn @ true[:, :3, :3], place)


def _about_y(angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 3 3"]:
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = ([cos, zero, sin], [zero, one, zero], [-sin, zero, cos])
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _hidden(log: Log, moment: KeyFrame, ego_from_marker: Float[np.ndarray, "m 4 4"]) -> Bool[np.ndarray, " m"]:
    """Return which markers are hidden by road users or buildings; the ground is flat."""
    actors, frame = log.actors, moment.track_frame
    ego_from_track = relative_pose(moment.global_from_ego, log.global_from_ego[frame])
    there = actors.valid[frame]
    size, position = actors.size[there], transform_points(ego_from_track, actors.position[frame, there])
    yaw = actors.yaw[frame, there] + pose_yaw(ego_from_track)
    boxes = np.column_stack([position[:, :2], size[:, :2], yaw, size[:, 2], np.zeros(len(size))]).reshape(-1, 7)
    blocks = log.map.buildings
    stand = relative_pose(moment.global_from_ego, yaw_pose(blocks[:, 0], blocks[:, 1], blocks[:, 4]))
    buildings = np.column_stack([stand[:, :2, 3], blocks[:, 2:4], pose_yaw(stand)]).reshape(-1, 5)
    return hidden_points(ego_from_marker[:, :2, 3], boxes, buildings, target_height=ego_from_marker[:, 2, 3])

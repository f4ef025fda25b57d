"""The scene at one key frame: road users, traffic elements and scenery in the ego frame, and the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.geometry import invert_pose, pose_yaw
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import Log
from tflane_jax.world.cameras.elements import element_bodies
from tflane_jax.world.cameras.ground import Ground, draw_ground
from tflane_jax.world.cameras.ground_window import window_around
from tflane_jax.world.cameras.light import seen_from_ego
from tflane_jax.world.cameras.ring import CameraRigConfig
from tflane_jax.world.cameras.solids import Bodies, join, pack
from tflane_jax.world.cameras.stage import LARGE, Stage, Stream, log_stream
from tflane_jax.world.cameras.surface import Surface, surface_at
from tflane_jax.world.cameras.vehicles import road_user
from tflane_jax.world.render.weather import Weather

# Large images get finer texels up to this distance from the vehicle, metres.
NEAR_REACH, _NEAR_TEXEL = 22.0, 0.02
# Bodies farther from the vehicle than this are not drawn, metres.
_HORIZON = 130.0
# Poses of a walker's legs.
_STEPS = 8


@dataclass(frozen=True)
class Moment:
    """One moment of a log.

    Attributes:
        place, yaw: position and heading of the vehicle in the global frame, metres and radians.
        weather: with its sun in the ego frame.
        bodies: static and moving bodies nearby, ego frame.
        users: (u, 7) boxes of the road users, as `Bodies.boxes`.
        grounds: ground windows, the coarsest first.
        surface: hilly ground, on which `bodies` are; all else is that of the level scene. None on level ground.
    """

    place: Float[np.ndarray, "2"]
    yaw: float
    weather: Weather
    bodies: Bodies
    users: Float[np.ndarray, "u 7"]
    grounds: list[Ground]
    surface: Surface | None = None


def moment_of(log: Log, keyframe: int, stage: Stage, config: CameraRigConfig) -> Moment:
    """Return the scene around the vehicle at a key frame; `stage` is that of the level log."""
    pose = log.keyframes[keyframe].global_from_ego
    surface = surface_at(log, pose)
    if surface is not None and log.relief is not None:
        level = replace(
            log.relief.level, keyframes=(replace(log.keyframes[keyframe], global_from_ego=surface.global_from_level),)
        )
        moment = moment_of(level, 0, stage, config)
        return replace(moment, bodies=surface.bodies(moment.bodies), surface=surface)
    yaw = float(pose_yaw(pose))
    return Moment(
        place=pose[:2, 3],
        yaw=yaw,
        weather=seen_from_ego(stage.weather, yaw),
        bodies=_bodies_around(stage, log, keyframe),
        users=user_boxes(log, keyframe),
        grounds=_grounds(stage, log, pose[:2, 3], config),
    )


def _grounds(stage: Stage, log: Log, place: Float[np.ndarray, "2"], config: CameraRigConfig) -> list[Ground]:
    """Return the ground, the coarsest first: large images get finer texels near the vehicle."""
    if config.scale <= LARGE:
        return [stage.ground]
    fine = draw_ground(
        log_stream(log, Stream.GROUND),
        log.map,
        stage.paint,
        window_around(place[None], NEAR_REACH, _NEAR_TEXEL),
        dirt=stage.weather.dirt,
        wet=stage.weather.rain,
        urban=stage.scenery.urban,
        levels=3,
    )
    return [stage.ground, fine]


def _bodies_around(stage: Stage, log: Log, keyframe: int) -> Bodies:
    """Return all bodies near the vehicle, ego frame."""
    pose = log.keyframes[keyframe].global_from_ego
    static = stage.static
    near = np.hypot(*(static.boxes[:, :2] - pose[:2, 3]).T) < _HORIZON
    groups = [in_ego(static.chosen(near), pose)]
    if log.map.elements:
        groups.append(in_ego(element_bodies(log.map.elements, attributes_at(log, keyframe)), pose))
    users = _users(stage, log, keyframe)
    return join([*groups, users])


def in_ego(bodies: Bodies, global_from_ego: Float[np.ndarray, "4 4"]) -> Bodies:
    """Return bodies of the global frame in the ego frame of a vehicle on level ground."""
    pose = invert_pose(global_from_ego)
    return bodies.placed(pose[None, :2, 3], np.array([pose_yaw(pose)]))


def _users(stage: Stage, log: Log, keyframe: int) -> Bodies:
    actors, frame = log.actors, log.keyframes[keyframe].track_frame
    position = actors.position[frame]
    near = actors.valid[frame] & (np.hypot(position[:, 0], position[:, 1]) < _HORIZON)
    numbers = np.flatnonzero(near)
    bodies = [_local_bodies(stage, log, frame, int(number)) for number in numbers]
    if not bodies:
        return pack([], [])
    who = np.repeat(numbers, [len(body.boxes) for body in bodies])
    return join(bodies).placed(position[who, :2], actors.yaw[frame, who])


def _local_bodies(stage: Stage, log: Log, frame: int, number: int) -> Bodies:
    """Return the bodies of one road user in the frame of its box, cached by user and phase of the step."""
    step = int(_pace(log, frame, number) * _STEPS)
    if (number, step) not in stage.users:
        actors = log.actors
        solids, boxes = zip(
            *road_user(
                int(actors.category[number]),
                actors.size[number],
                stage.looks[number],
                stage.weather.night,
                pace=step / _STEPS,
            ),
            strict=True,
        )
        stage.users[number, step] = pack(solids, boxes)
    return stage.users[number, step]


def _pace(log: Log, frame: int, number: int) -> float:
    """Return the phase of a walker's step, 0 to 1, from its distance to its start."""
    if log.actors.category[number] != RoadUser.PEDESTRIAN:
        return 0.0
    first = int(np.argmax(log.actors.valid[:, number]))
    there = [
        log.global_from_ego[f, :2, :2] @ log.actors.position[f, number, :2] + log.global_from_ego[f, :2, 3]
        for f in (first, frame)
    ]
    return float(np.linalg.norm(there[1] - there[0]) / 1.4 % 1.0)


def user_boxes(log: Log, keyframe: int) -> Float[np.ndarray, "u 7"]:
    """Return the road users of a key frame as rows of `Bodies.boxes`, ego frame."""
    actors, frame = log.actors, log.keyframes[keyframe].track_frame
    there = actors.valid[frame]
    size, position = actors.size[there], actors.position[frame, there]
    flat = np.zeros(len(size))
    return np.column_stack([position[:, :2], size[:, :2], actors.yaw[frame, there], flat, size[:, 2]]).reshape(-1, 7)


def attributes_at(log: Log, keyframe: int) -> Int[np.ndarray, " e"]:
    """Return the attribute of each map element at a key frame."""
    if log.element_attribute is not None:
        return np.asarray(log.element_attribute[log.keyframes[keyframe].track_frame], int)
    return np.array([element.attribute for element in log.map.elements], int)

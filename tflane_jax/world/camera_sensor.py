"""Sensor 2 of the world: what a ring of calibrated cameras sees at a moment of a log, and which traffic elements.

What does not move is drawn once for each log (`_Stage`): the ground as a picture from above, the scenery, the sky. A
frame places the road users, and every camera looks at all of it. Everything random is seeded by the log and by the
camera's name, so that an image does not depend on which others are drawn.
"""

from __future__ import annotations

import enum
import functools
import weakref
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.geometry import invert_pose, pose_yaw
from tflane_jax.logs import Log
from tflane_jax.scene import CameraViews, RoadUser
from tflane_jax.world.camera_elements import element_bodies, element_boxes, mast_bodies, unhidden
from tflane_jax.world.camera_ground import Ground, draw_ground, sample_ground, window_around
from tflane_jax.world.camera_light import (
    View,
    cast,
    draw_panorama,
    light_ground,
    log_weather,
    look,
    seen_from_ego,
    show_sky,
    vehicle_shadows,
)
from tflane_jax.world.camera_paint import Paint, paint_of
from tflane_jax.world.camera_scenery import Scenery, draw_scenery
from tflane_jax.world.camera_solids import Bodies, draw_bodies, footprints, join, pack
from tflane_jax.world.camera_vehicles import road_user
from tflane_jax.world.front_view_camera import FrontCamera
from tflane_jax.world.front_view_picture import develop
from tflane_jax.world.front_view_weather import Weather
from tflane_jax.world.ring_cameras import ROOT, CameraRigConfig, camera_stream, draw_rig, enlarged

# The ground is drawn to this distance from the key frames, with texels of this size; large images get finer ones up to
# a distance from the vehicle, metres.
_REACH, _TEXEL, _NEAR_REACH, _NEAR_TEXEL = 90.0, 0.08, 22.0, 0.02
_LARGE = 0.25
# Bodies farther from the vehicle than this are not drawn, metres.
_HORIZON = 130.0
_SHADE_TEXEL = 0.25
_MOST_WORN = 0.88
# Poses of a walker's legs.
_STEPS = 8
# What a front-view picture of width 640 is to the rain and the lens.
_PICTURE = 640.0


class Stream(enum.IntEnum):
    """What is drawn from which stream of a log."""

    WEATHER = 0
    PAINT = 1
    GROUND = 2
    SCENERY = 3
    SKY = 4
    LOOKS = 5
    PICTURE = 6


@dataclass(frozen=True)
class ElementViews:
    """Traffic elements of the map in the image of camera 0.

    Attributes:
        box: (E, 2, 2) top-left and bottom-right corners in pixels, cut at the border; arbitrary where not visible.
        attribute: (E,) what each shows at this moment.
        visible: (E,) in the image, facing the camera, not hidden for the most part, and large enough.
    """

    box: Float[np.ndarray, "e 2 2"]
    attribute: Int[np.ndarray, " e"]
    visible: Bool[np.ndarray, " e"]


def render_cameras(log: Log, keyframe: int, config: CameraRigConfig) -> CameraViews:
    """Return the images of one key frame, all cameras of the rig in its order.

    Images smaller than the largest lie in the top-left corner of their array; the rest is black.
    Raises UserError where the rig can make no images.
    """
    cameras = draw_rig(log.seed, config)
    stage, moment = _stage(log, config), log.keyframes[keyframe]
    yaw = float(pose_yaw(moment.global_from_ego))
    frame = _Frame(
        place=moment.global_from_ego[:2, 3],
        yaw=yaw,
        weather=seen_from_ego(stage.weather, yaw),
        bodies=_bodies_around(stage, log, keyframe),
        users=_user_boxes(log, keyframe),
        grounds=_grounds(stage, log, moment.global_from_ego[:2, 3], config),
    )
    size = np.array([[camera.width, camera.height] for camera in cameras], np.int32)
    image = np.zeros((len(cameras), size[:, 1].max(), size[:, 0].max(), 3), np.uint8)
    for number, (camera, mount) in enumerate(zip(cameras, config.cameras, strict=True)):
        view = _view(camera, config.supersample)
        picture = _draw(stage, frame, view, config)
        rng = camera_stream(log.seed, mount, Stream.PICTURE, keyframe)
        image[number, : camera.height, : camera.width] = _develop(rng, picture, camera, stage.weather)
    return CameraViews(
        image=image,
        size=size,
        intrinsics=np.stack([camera.intrinsics for camera in cameras]).astype(np.float32),
        camera_from_ego=np.stack([camera.camera_from_ego for camera in cameras]).astype(np.float32),
        valid=np.ones(len(cameras), bool),
    )


def visible_elements(log: Log, keyframe: int, config: CameraRigConfig) -> ElementViews:
    """Return where the map's lights and signs lie in the image of the rig's first camera, and which are seen.

    The answer comes from the geometry alone: it is the same at every scale, in every weather. Raises UserError where
    the rig can make no images.
    """
    elements, attribute = log.map.elements, _attributes(log, keyframe)
    camera = draw_rig(log.seed, config)[0]
    moment, stage = log.keyframes[keyframe], _stage(log, config)
    if not elements:
        return ElementViews(np.zeros((0, 2, 2)), attribute, np.zeros(0, bool))
    ego_from_global = invert_pose(moment.global_from_ego)
    box, visible = element_boxes(elements, ego_from_global, camera)
    standing = _in_ego(stage.static, moment.global_from_ego).boxes
    shown = _in_ego(element_bodies(elements, attribute), moment.global_from_ego).boxes
    occluders = np.concatenate([_user_boxes(log, keyframe), standing, shown])
    visible &= unhidden(elements, ego_from_global, camera, occluders, len(occluders) - len(shown))
    visible &= (box[:, 1, 1] - box[:, 0, 1]) >= config.element_pixels * config.scale
    return ElementViews(box, attribute, visible)


@dataclass(frozen=True)
class _Stage:
    """What does not move in a log.

    Attributes:
        weather: with its sun in the global frame.
        paint, scenery: of the map.
        static: scenery and masts, global frame.
        panorama: of the sky.
        shade: (h, w) uint8 share of sunlight that buildings and trees let pass, and `lamps` the light of street lamps;
            both with texels of `_SHADE_TEXEL` from `low`.
        looks: (K, 8) what tells road users apart.
        ground: of the surroundings of all key frames.
        users: bodies of road users that were needed so far.
    """

    weather: Weather
    paint: Paint
    scenery: Scenery
    static: Bodies
    panorama: UInt8[np.ndarray, "p q 3"]
    low: Float[np.ndarray, "2"]
    shade: UInt8[np.ndarray, "h w"]
    lamps: UInt8[np.ndarray, "h w"] | None
    looks: Float[np.ndarray, "k 8"]
    ground: Ground
    users: dict[tuple[int, int], Bodies] = field(default_factory=dict)


_STAGES: dict[tuple[int, CameraRigConfig], _Stage] = {}


def _stage(log: Log, config: CameraRigConfig) -> _Stage:
    """Return what does not move in a log, remembered for as long as the log lives."""
    # Cameras and their calibration do not change the world.
    key = id(log), replace(config, cameras=(), jitter=0.0, multiple=1, element_pixels=0.0)
    if key not in _STAGES:
        _STAGES[key] = _set_stage(log, config)
        weakref.finalize(log, _STAGES.pop, key)
    return _STAGES[key]


def _set_stage(log: Log, config: CameraRigConfig) -> _Stage:
    weather = log_weather(
        _stream(log, Stream.WEATHER), config.weather, weather=log.weather, severity=config.severity
    )
    # However worn, some paint is left in the pores of the asphalt.
    wear = min(log.paint_wear * config.severity, 1.0) * _MOST_WORN
    paint = paint_of(_stream(log, Stream.PAINT), log.map, paint_wear=wear, log_seed=log.seed)
    scenery = draw_scenery(_stream(log, Stream.SCENERY), log.map, weather.night)
    places = np.stack([keyframe.global_from_ego[:2, 3] for keyframe in log.keyframes])
    ground = draw_ground(
        _stream(log, Stream.GROUND), log.map, paint, window_around(places, _REACH, _TEXEL),
        dirt=weather.dirt, wet=weather.rain, urban=scenery.urban,
    )  # fmt: skip
    low, shade, lamps = _static_light(places, scenery, weather)
    return _Stage(
        weather=weather,
        paint=paint,
        scenery=scenery,
        static=join([scenery.bodies, mast_bodies(log.map.elements, log.map.road_boundaries)]),
        panorama=draw_panorama(_stream(log, Stream.SKY), weather, 3072 if config.scale > _LARGE else 1024),
        low=low,
        shade=shade,
        lamps=lamps,
        looks=_stream(log, Stream.LOOKS).random((len(log.actors.size), 8)),
        ground=ground,
    )


def _stream(log: Log, stream: Stream) -> np.random.Generator:
    return np.random.default_rng([ROOT, log.seed, stream])


def _static_light(
    places: Float[np.ndarray, "n 2"], scenery: Scenery, weather: Weather
) -> tuple[Float[np.ndarray, "2"], UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"] | None]:
    """Return the shadows of buildings and trees and the light of street lamps on the ground, as `_Stage` keeps them."""
    import cv2

    window = window_around(places, _REACH, _SHADE_TEXEL)
    shade = np.full((window.rows, window.columns), 255, np.uint8)
    if weather.direct > 0.1:
        boxes = np.pad(scenery.towers[:, :5], ((0, 0), (0, 2)))
        for ring in cast(footprints(boxes), scenery.towers[:, 5], weather.sun):
            cv2.fillPoly(shade, [window.fixed(ring)], 20, cv2.LINE_8, 4)
        toward = weather.sun[:2] / max(float(weather.sun[2]), 0.35)
        angle = np.linspace(0.0, 2.0 * np.pi, 15)[:-1]
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        for x, y, height, radius in scenery.crowns:
            ragged = 1.0 + 0.18 * np.sin(5.0 * angle + x)[:, None]
            stretched = circle + 0.5 * (circle @ toward)[:, None] * toward
            ring = np.array([x, y]) - toward * height + 0.85 * radius * ragged * stretched
            cv2.fillPoly(shade, [window.fixed(ring)], 60, cv2.LINE_8, 4)
        shade = cv2.GaussianBlur(shade, (3, 3), 0)
    lamps = None
    if weather.night:
        lamps = np.zeros_like(shade)
        for centre in window.fixed(scenery.lamps).tolist():
            cv2.circle(lamps, centre, round(9.0 / _SHADE_TEXEL * 16), 130, -1, cv2.LINE_8, 4)
            cv2.circle(lamps, centre, round(4.5 / _SHADE_TEXEL * 16), 230, -1, cv2.LINE_8, 4)
        lamps = cv2.GaussianBlur(lamps, (0, 0), 2.5 / _SHADE_TEXEL)
    return np.array(window.low), shade, lamps


@dataclass(frozen=True)
class _Frame:
    """One moment: place and heading of the vehicle, and what is around it in the ego frame."""

    place: Float[np.ndarray, "2"]
    yaw: float
    weather: Weather
    bodies: Bodies
    users: Float[np.ndarray, "u 7"]
    grounds: list[Ground]


def _grounds(stage: _Stage, log: Log, place: Float[np.ndarray, "2"], config: CameraRigConfig) -> list[Ground]:
    """Return the ground, the coarsest first: large images get finer texels near the vehicle."""
    if config.scale <= _LARGE:
        return [stage.ground]
    fine = draw_ground(
        _stream(log, Stream.GROUND), log.map, stage.paint, window_around(place[None], _NEAR_REACH, _NEAR_TEXEL),
        dirt=stage.weather.dirt, wet=stage.weather.rain, urban=stage.scenery.urban, levels=3,
    )  # fmt: skip
    return [stage.ground, fine]


def _bodies_around(stage: _Stage, log: Log, keyframe: int) -> Bodies:
    """Return all bodies near the vehicle, ego frame."""
    pose = log.keyframes[keyframe].global_from_ego
    static = stage.static
    near = np.hypot(*(static.boxes[:, :2] - pose[:2, 3]).T) < _HORIZON
    groups = [_in_ego(static.chosen(near), pose)]
    if log.map.elements:
        groups.append(_in_ego(element_bodies(log.map.elements, _attributes(log, keyframe)), pose))
    users = _users(stage, log, keyframe)
    return join([*groups, users])


def _in_ego(bodies: Bodies, global_from_ego: Float[np.ndarray, "4 4"]) -> Bodies:
    """Return bodies of the global frame in the ego frame of a vehicle on level ground."""
    pose = invert_pose(global_from_ego)
    return bodies.placed(pose[None, :2, 3], np.array([pose_yaw(pose)]))


def _users(stage: _Stage, log: Log, keyframe: int) -> Bodies:
    actors, frame = log.actors, log.keyframes[keyframe].track_frame
    position = actors.position[frame]
    near = actors.valid[frame] & (np.hypot(position[:, 0], position[:, 1]) < _HORIZON)
    numbers = np.flatnonzero(near)
    bodies = [_local_bodies(stage, log, frame, int(number)) for number in numbers]
    if not bodies:
        return pack([], [])
    who = np.repeat(numbers, [len(body.boxes) for body in bodies])
    return join(bodies).placed(position[who, :2], actors.yaw[frame, who])


def _local_bodies(stage: _Stage, log: Log, frame: int, number: int) -> Bodies:
    """Return the bodies of one road user in the frame of its box; each is made once for a log, and each step."""
    step = int(_pace(log, frame, number) * _STEPS)
    if (number, step) not in stage.users:
        actors = log.actors
        solids, boxes = zip(
            *road_user(
                int(actors.category[number]), actors.size[number], stage.looks[number], stage.weather.night,
                pace=step / _STEPS,
            ),
            strict=True,
        )  # fmt: skip
        stage.users[number, step] = pack(solids, boxes)
    return stage.users[number, step]


def _pace(log: Log, frame: int, number: int) -> float:
    """Return where in its step a walker is, 0 to 1: by how far it is from where it started."""
    if log.actors.category[number] != RoadUser.PEDESTRIAN:
        return 0.0
    first = int(np.argmax(log.actors.valid[:, number]))
    there = [
        log.global_from_ego[f, :2, :2] @ log.actors.position[f, number, :2] + log.global_from_ego[f, :2, 3]
        for f in (first, frame)
    ]
    return float(np.linalg.norm(there[1] - there[0]) / 1.4 % 1.0)


def _user_boxes(log: Log, keyframe: int) -> Float[np.ndarray, "u 7"]:
    """Return the road users of a key frame as rows of `Bodies.boxes`, ego frame."""
    actors, frame = log.actors, log.keyframes[keyframe].track_frame
    there = actors.valid[frame]
    size, position = actors.size[there], actors.position[frame, there]
    flat = np.zeros(len(size))
    return np.column_stack([position[:, :2], size[:, :2], actors.yaw[frame, there], flat, size[:, 2]]).reshape(-1, 7)


def _attributes(log: Log, keyframe: int) -> Int[np.ndarray, " e"]:
    if log.element_attribute is not None:
        return np.asarray(log.element_attribute[log.keyframes[keyframe].track_frame], int)
    return np.array([element.attribute for element in log.map.elements], int)


@functools.lru_cache(maxsize=32)
def _cached_view(pixels: tuple[int, int, int], intrinsics: bytes, pose: bytes) -> View:
    width, height, factor = pixels
    camera = FrontCamera(width, height, np.frombuffer(intrinsics).reshape(3, 3), np.frombuffer(pose).reshape(4, 4))
    return look(enlarged(camera, factor))


def _view(camera: FrontCamera, factor: int) -> View:
    """Return what the pixels of an enlarged camera look at; the last few small cameras are remembered."""
    arguments = (
        (camera.width, camera.height, factor), camera.intrinsics.tobytes(), camera.camera_from_ego.tobytes()
    )  # fmt: skip
    if camera.width * camera.height > 500_000:
        return _cached_view.__wrapped__(*arguments)
    return _cached_view(*arguments)


def _draw(stage: _Stage, frame: _Frame, view: View, config: CameraRigConfig) -> UInt8[np.ndarray, "H W 3"]:
    """Draw sky, ground and bodies as one camera sees them."""
    import cv2

    weather = frame.weather
    image = show_sky(view, stage.panorama, frame.yaw)
    if len(view.x):
        cos, sin = np.float32(np.cos(frame.yaw)), np.float32(np.sin(frame.yaw))
        x, y = cos * view.x - sin * view.y, sin * view.x + cos * view.y
        colour = _ground_colour(frame, view, x, y)
        sunny, open_sky = vehicle_shadows(view, frame.users, weather)
        shift = (frame.place - stage.low).astype(np.float32)
        u = (x + shift[0]) * np.float32(1.0 / _SHADE_TEXEL) - np.float32(0.5)
        v = (y + shift[1]) * np.float32(1.0 / _SHADE_TEXEL) - np.float32(0.5)
        lamps = np.zeros_like(sunny)
        if weather.direct > 0.1:
            still = cv2.remap(stage.shade, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            sunny *= still * np.float32(1.0 / 255.0)
        if stage.lamps is not None:
            lamps = cv2.remap(stage.lamps, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            lamps = lamps * np.float32(1.0 / 255.0)
        light_ground(colour, view, weather, sunny, open_sky, lamps)
        cv2.copyTo(cv2.convertScaleAbs(colour), view.seen, image[view.first_row :])
    edges = "hard" if config.supersample > 1 else "smooth"
    draw_bodies(image, frame.bodies, view.camera, weather, edges)
    return image


def _ground_colour(frame: _Frame, view: View, x: np.ndarray, y: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Return the ground's own colours; a finer ground replaces the coarser one near the vehicle."""
    colour = None
    for ground in frame.grounds:
        shift = (frame.place - np.array(ground.window.low)).astype(np.float32)
        if colour is None:
            colour = sample_ground(ground, x + shift[0], y + shift[1], view.across, view.along)
            continue
        reach = np.maximum(np.abs(x), np.abs(y))
        rows = np.flatnonzero(reach.min(1) < _NEAR_REACH)
        if not len(rows):
            continue
        part = slice(rows[0], rows[-1] + 1)
        fine = sample_ground(
            ground, x[part] + shift[0], y[part] + shift[1], view.across[part], view.along[part]
        )
        share = np.clip((_NEAR_REACH - 1.0 - reach[part]) * 0.25, 0.0, 1.0)[..., None]
        colour[part] += share * (fine - colour[part])
    assert colour is not None
    return colour


def _develop(
    rng: np.random.Generator, picture: UInt8[np.ndarray, "H W 3"], camera: FrontCamera, weather: Weather
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture at its own size as the camera delivers it."""
    import cv2

    if picture.shape[0] != camera.height:
        picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    scale = max(camera.width, camera.height) / _PICTURE
    return develop(rng, picture, replace(weather, blur=weather.blur * min(scale, 2.0)), scale)

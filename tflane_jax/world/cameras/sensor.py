"""The camera sensor of the world: images of a ring of calibrated cameras, and the visible traffic elements.

Static content is drawn once per log (`stage`): the ground texture, the scenery and the sky. A key frame adds the road
users (`moment`), and each camera renders all of it. Random draws are seeded by the log and the camera's name, so an
image does not depend on which others are drawn.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose
from tflane_jax.geometry.cameras import crop_intrinsics
from tflane_jax.scene import CameraViews
from tflane_jax.scene.logs import KeyFrame, Log
from tflane_jax.world.cameras.depth import render_depth
from tflane_jax.world.cameras.elements import element_bodies, element_boxes, unhidden
from tflane_jax.world.cameras.ground import sample_ground
from tflane_jax.world.cameras.light import View, light_ground, look, show_sky, vehicle_shadows
from tflane_jax.world.cameras.moment import NEAR_REACH, Moment, attributes_at, in_ego, moment_of, user_boxes
from tflane_jax.world.cameras.ring import CameraRigConfig, camera_stream, draw_rig, enlarged
from tflane_jax.world.cameras.solids import draw_bodies
from tflane_jax.world.cameras.stage import SHADE_TEXEL, Stage, Stream, stage_of
from tflane_jax.world.render.camera import PinholeCamera
from tflane_jax.world.render.exposure import Window, develop
from tflane_jax.world.render.weather import Weather

# Image width to which the strengths of rain streaks and lens blur refer, pixels.
_PICTURE = 640.0
# The rays of images up to this many pixels are cached.
_FEW_PIXELS = 500_000
# Added to a track frame's number in the random stream of a moment that is given by its track frame.
_BETWEEN = 1_000_000


@dataclass(frozen=True)
class ElementViews:
    """Traffic elements of the map in the image of camera 0.

    Attributes:
        box: (E, 2, 2) top-left and bottom-right corners in pixels, cut at the border; arbitrary where not visible.
        visible: (E,) in the image, facing the camera, not mostly occluded, and large enough.
    """

    box: Float[np.ndarray, "e 2 2"]
    visible: Bool[np.ndarray, " e"]


def render_cameras(log: Log, keyframe: int, config: CameraRigConfig) -> CameraViews:
    """Return the images of one key frame, all cameras of the rig in its order.

    Images smaller than the largest lie in the top-left corner of their array; the rest is black.
    Raises UserError for an invalid rig.
    """
    cameras = draw_rig(log.seed, config)
    stage = stage_of(log, config)
    moment = moment_of(log, keyframe, stage, config)
    size = np.array([[camera.width, camera.height] for camera in cameras], np.int32)
    image = np.zeros((len(cameras), size[:, 1].max(), size[:, 0].max(), 3), np.uint8)
    for number, (camera, mount) in enumerate(zip(cameras, config.cameras, strict=True)):
        view = _view(camera, config.supersample, moment)
        picture = _draw(stage, moment, view, config)
        rng = camera_stream(log.seed, mount, Stream.PICTURE, keyframe)
        image[number, : camera.height, : camera.width] = _develop(
            rng, picture, camera, stage.weather, Window((camera.width, camera.height), (0, 0))
        )
    depth, depth_valid = None, None
    if config.depth_cell is not None:
        # Of the whole array: a smaller image has cells without depth.
        rows, columns = (-(-side // config.depth_cell) for side in image.shape[1:3])
        depth = np.zeros((len(cameras), rows, columns), np.float32)
        depth_valid = np.zeros(depth.shape, bool)
        for number, camera in enumerate(cameras):
            near, seen = render_depth(moment.bodies, camera, config.depth_cell, moment.surface)
            depth[number, : len(near), : near.shape[1]] = near
            depth_valid[number, : len(near), : near.shape[1]] = seen
    return CameraViews(
        image=image,
        size=size,
        intrinsics=np.stack([camera.intrinsics for camera in cameras]).astype(np.float32),
        camera_from_ego=np.stack([camera.camera_from_ego for camera in cameras]).astype(np.float32),
        valid=np.ones(len(cameras), bool),
        depth=depth,
        depth_valid=depth_valid,
    )


def render_window(
    log: Log,
    keyframe: int | KeyFrame,
    config: CameraRigConfig,
    corner: tuple[int, int],
    size: tuple[int, int],
    *,
    camera: int = 0,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a part of one camera's image: as drawn by `render_cameras`, but with other rain and noise.

    Args:
        log, config: as for `render_cameras`.
        keyframe: number of the key frame, or any moment of the log.
        corner: column and row of the part's upper left pixel.
        size: its width and height.
        camera: index in the rig.

    Raises UserError for an invalid rig or a part that is not inside the image.
    """
    whole = draw_rig(log.seed, config)[camera]
    (left, top), (width, height) = corner, size
    if not (0 <= left < left + width <= whole.width and 0 <= top < top + height <= whole.height):
        raise UserError(
            f"a window of {width} x {height} pixels at column {left}, row {top} is not within the image of "
            f"{whole.width} x {whole.height} pixels: choose a smaller one"
        )
    part = replace(whole, width=width, height=height, intrinsics=crop_intrinsics(whole.intrinsics, corner))
    stage = stage_of(log, config)
    if isinstance(keyframe, KeyFrame):
        number = _BETWEEN + keyframe.track_frame
        moment = moment_of(replace(log, keyframes=(keyframe,)), 0, stage, config)
    else:
        number, moment = keyframe, moment_of(log, keyframe, stage, config)
    picture = _draw(stage, moment, _view(part, config.supersample, moment), config)
    rng = camera_stream(log.seed, config.cameras[camera], Stream.PICTURE, number, left, top)
    return _develop(rng, picture, part, stage.weather, Window((whole.width, whole.height), corner))


def visible_elements(log: Log, keyframe: int, config: CameraRigConfig) -> ElementViews:
    """Return the boxes of the map's lights and signs in the image of the rig's first camera, and which are visible.

    Visibility depends on geometry alone, not on scale or weather. Raises UserError for an invalid rig.
    """
    elements, attribute = log.map.elements, attributes_at(log, keyframe)
    camera = draw_rig(log.seed, config)[0]
    moment, stage = log.keyframes[keyframe], stage_of(log, config)
    if not elements:
        return ElementViews(np.zeros((0, 2, 2)), np.zeros(0, bool))
    ego_from_global = invert_pose(moment.global_from_ego)
    box, visible = element_boxes(elements, ego_from_global, camera)
    if log.relief is not None:
        # What hides an element is the same on level ground: all of it moves up together.
        log = log.relief.level
        elements, moment = log.map.elements, log.keyframes[keyframe]
        ego_from_global = invert_pose(moment.global_from_ego)
    standing = in_ego(stage.static, moment.global_from_ego).boxes
    shown = in_ego(element_bodies(elements, attribute), moment.global_from_ego).boxes
    occluders = np.concatenate([user_boxes(log, keyframe), standing, shown])
    visible &= unhidden(elements, ego_from_global, camera, occluders, len(occluders) - len(shown))
    visible &= (box[:, 1, 1] - box[:, 0, 1]) >= config.element_pixels * config.scale
    return ElementViews(box, visible)


@functools.lru_cache(maxsize=32)
def _cached_view(pixels: tuple[int, int, int], intrinsics: bytes, pose: bytes) -> View:
    width, height, factor = pixels
    camera = PinholeCamera(width, height, np.frombuffer(intrinsics).reshape(3, 3), np.frombuffer(pose).reshape(4, 4))
    return look(enlarged(camera, factor))


def _view(camera: PinholeCamera, factor: int, moment: Moment) -> View:
    """Return the rays and ground points of an enlarged camera; on level ground, the last few small ones are cached."""
    if moment.surface is not None:
        return moment.surface.look(enlarged(camera, factor))
    arguments = ((camera.width, camera.height, factor), camera.intrinsics.tobytes(), camera.camera_from_ego.tobytes())
    if camera.width * camera.height > _FEW_PIXELS:
        return _cached_view.__wrapped__(*arguments)
    return _cached_view(*arguments)


def _draw(stage: Stage, moment: Moment, view: View, config: CameraRigConfig) -> UInt8[np.ndarray, "H W 3"]:
    """Draw sky, ground and bodies for one camera."""
    import cv2

    weather = moment.weather
    image = show_sky(view, stage.panorama, moment.yaw)
    if len(view.x):
        cos, sin = np.float32(np.cos(moment.yaw)), np.float32(np.sin(moment.yaw))
        x, y = cos * view.x - sin * view.y, sin * view.x + cos * view.y
        colour = _ground_colour(moment, view, x, y)
        sunny, open_sky = vehicle_shadows(view, moment.users, weather)
        shift = (moment.place - stage.low).astype(np.float32)
        u = (x + shift[0]) * np.float32(1.0 / SHADE_TEXEL) - np.float32(0.5)
        v = (y + shift[1]) * np.float32(1.0 / SHADE_TEXEL) - np.float32(0.5)
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
    draw_bodies(image, moment.bodies, view.camera, weather, edges)
    return image


def _ground_colour(moment: Moment, view: View, x: np.ndarray, y: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Return the ground's albedo; near the vehicle a finer ground replaces the coarser one."""
    colour = None
    for ground in moment.grounds:
        shift = (moment.place - np.array(ground.window.low)).astype(np.float32)
        if colour is None:
            colour = sample_ground(ground, x + shift[0], y + shift[1], view.across, view.along)
            continue
        reach = np.maximum(np.abs(x), np.abs(y))
        rows = np.flatnonzero(reach.min(1) < NEAR_REACH)
        if not len(rows):
            continue
        part = slice(rows[0], rows[-1] + 1)
        fine = sample_ground(ground, x[part] + shift[0], y[part] + shift[1], view.across[part], view.along[part])
        fraction = np.clip((NEAR_REACH - 1.0 - reach[part]) * 0.25, 0.0, 1.0)[..., None]
        colour[part] += fraction * (fine - colour[part])
    assert colour is not None
    return colour


def _develop(
    rng: np.random.Generator,
    picture: UInt8[np.ndarray, "H W 3"],
    camera: PinholeCamera,
    weather: Weather,
    window: Window,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the delivered image at the size of `camera`, which may be a part (`window`) of a larger one."""
    import cv2

    if picture.shape[0] != camera.height:
        picture = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    scale = max(window.whole) / _PICTURE
    return develop(rng, picture, replace(weather, blur=weather.blur * min(scale, 2.0)), scale, window)

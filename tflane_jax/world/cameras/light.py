"""Light for the ring cameras: weather of a log, sky panorama, light and shadows on the ground.

Directions are in the global frame unless stated otherwise: sun and hills are fixed while the vehicle turns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.geometry import invert_pose
from tflane_jax.world.cameras.solids import footprints
from tflane_jax.world.render.camera import NEAR, PinholeCamera, lift
from tflane_jax.world.render.noise import noise_tile
from tflane_jax.world.render.polygons import HEADLIGHTS, SHIFT, clipped, fixed_point
from tflane_jax.world.render.weather import FrontWeatherConfig, Weather, draw_weather

# Elevations covered by the panorama, radians; higher elevations repeat its upper border.
_LOWEST, _HIGHEST = -0.05, 0.95
# Lower limit of the tangent of the sun's elevation, which bounds the length of shadows.
_STEEPEST_SHADOW = 0.35


def log_weather(rng: np.random.Generator, config: FrontWeatherConfig, *, weather: float, severity: float) -> Weather:
    """Return light and weather of a log.

    Args:
        rng: stream.
        config: kinds and strengths.
        weather: how bad it is, 0 to 1, as `logs.Log.weather`.
        severity: of the whole sensor, 0 to 1; 0 also gives a perfect camera.
    """
    # Factor 1.6: a log with weather around 0.5 then has rain or fog more often than not.
    return draw_weather(rng, config, min(1.6 * weather * severity, 1.0))


def seen_from_ego(weather: Weather, yaw: float) -> Weather:
    """Return the weather with its sun in the ego frame of a vehicle with heading `yaw`."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y, z = weather.sun
    return replace(weather, sun=np.array([cos * x + sin * y, cos * y - sin * x, z]))


def draw_panorama(rng: np.random.Generator, weather: Weather, columns: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return the sky panorama: columns from azimuth 0 counter-clockwise, rows from the highest elevation down."""
    import cv2

    rows = columns // 6
    azimuth = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    elevation = (_HIGHEST - (np.arange(rows) + 0.5) / rows * (_HIGHEST - _LOWEST))[:, None]
    above = np.clip(elevation / 0.55, 0.0, 1.0)[..., None]
    sky = weather.horizon + above**0.6 * (weather.zenith - weather.horizon)
    # Clouds lie on a high plane, so they get smaller and denser towards the horizon.
    reach = 1.0 / np.maximum(np.tan(np.maximum(elevation, 0.01)), 0.06)
    shift = rng.uniform(0.0, 256.0, 2)
    u, v = reach * np.cos(azimuth) * 9.0 + shift[0], reach * np.sin(azimuth) * 9.0 + shift[1]
    tile = cv2.remap(
        noise_tile(), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    cover = weather.cloud * np.clip(0.55 * tile + 0.2, 0.0, 1.0)[..., None] * np.clip(8.0 * above, 0.0, 1.0)
    sky = sky + cover * (np.minimum(1.12 * weather.horizon + 0.03, 1.0) - sky)
    if weather.direct > 0.1:
        direction = np.stack(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.broadcast_to(np.sin(elevation), (rows, columns)),
            ],
            -1,
        )
        away = np.arccos(np.clip(direction @ weather.sun, -1.0, 1.0))[..., None]
        sky = sky + np.array([1.0, 0.94, 0.8]) * (0.5 * np.exp(-away / 0.2) + 1.2 * (away < 0.02))
    for distance, tallest, colour in ((4000.0, 0.05, (0.36, 0.41, 0.43)), (500.0, 0.035, (0.19, 0.24, 0.15))):
        amount, row = rng.uniform(0.2, 1.0), rng.integers(256)
        knots = np.append(noise_tile()[row], noise_tile()[row, 0])
        waves = np.interp(np.linspace(0.0, 256.0, columns), np.arange(257), knots)
        skyline = tallest * amount * np.clip(0.5 + 0.35 * waves, 0.03, 1.4)
        clear = np.exp(-0.35 * distance / weather.visibility)
        tone = clear * (weather.ambient + 0.5 * weather.direct) * np.array(colour) + (1.0 - clear) * weather.horizon
        sky = np.where((elevation < skyline)[..., None], tone, sky)
    return (255.0 * np.clip(sky, 0.0, 1.0)).astype(np.uint8)


@dataclass(frozen=True)
class View:
    """Ray and ground point of each pixel of a camera, in the ego frame; arrays are float32.

    Attributes:
        camera: of the image.
        azimuth, elevation: (H, W) of the rays, radians.
        first_row: rows from here on may show ground; the ground arrays begin there.
        x, y: (h, w) ground, metres.
        distance: (h, w) from the ego origin, metres.
        seen: (h, w) uint8, 255 where there is ground.
        across, along: (h,) size of a pixel's footprint, metres.
        raised: from points of the level scene to the ego frame, on hilly ground; x and y are then those of the level
            scene.
    """

    camera: PinholeCamera
    azimuth: Float[np.ndarray, "H W"]
    elevation: Float[np.ndarray, "H W"]
    first_row: int
    x: Float[np.ndarray, "h w"]
    y: Float[np.ndarray, "h w"]
    distance: Float[np.ndarray, "h w"]
    seen: UInt8[np.ndarray, "h w"]
    across: Float[np.ndarray, " h"]
    along: Float[np.ndarray, " h"]
    raised: Callable[[np.ndarray], np.ndarray] | None = None


# Ground farther away than this is not drawn, metres.
FAR = 500.0


def look(camera: PinholeCamera) -> View:
    """Return the rays and ground points of a camera's pixels."""
    w, h = camera.width, camera.height
    u, v = np.arange(w) + 0.5, (np.arange(h) + 0.5)[:, None]
    # Rays in the ego frame are linear in the pixel.
    turn = camera.camera_from_ego[:3, :3].T @ np.linalg.inv(camera.intrinsics)
    ray = [(row[0] * u + row[2]).astype(np.float32) + (row[1] * v).astype(np.float32) for row in turn]
    azimuth = np.arctan2(ray[1], ray[0])
    elevation = np.arctan2(ray[2], np.hypot(ray[0], ray[1]))
    eye = invert_pose(camera.camera_from_ego)[:3, 3]
    falls = elevation < -1e-5
    first = int(np.argmax(falls.any(1))) if falls.any() else h
    reach = np.float32(eye[2]) / np.where(falls, -ray[2], np.inf)[first:]
    x, y = (np.float32(eye[axis]) + reach * ray[axis][first:] for axis in range(2))
    distance = np.hypot(x, y)
    seen = falls[first:] & (distance < FAR)
    depth = np.median(camera.ground_depth(u, v[first:, 0], FAR), -1)
    focal = float(camera.intrinsics[0, 0])
    return View(
        camera,
        azimuth,
        elevation,
        first,
        np.where(seen, x, 0.0),
        np.where(seen, y, 0.0),
        np.where(seen, distance, np.float32(FAR)),
        np.where(seen, 255, 0).astype(np.uint8),
        depth / focal,
        depth**2 / (focal * float(eye[2])),
    )


def show_sky(view: View, panorama: UInt8[np.ndarray, "k l 3"], yaw: float) -> UInt8[np.ndarray, "H W 3"]:
    """Return the part of the panorama seen by a camera of a vehicle with heading `yaw`.

    Rows with ground only are black: all of them where a camera looks down.
    """
    import cv2

    rows, columns = panorama.shape[:2]
    needed = np.flatnonzero(~view.seen.all(1))
    part = slice(0, view.first_row + (int(needed[-1]) + 1 if len(needed) else 0))
    image = np.zeros((view.camera.height, view.camera.width, 3), np.uint8)
    if not part.stop:
        return image
    u = (view.azimuth[part] + np.float32(yaw)) * np.float32(columns / (2.0 * np.pi)) - np.float32(0.5)
    v = (_HIGHEST - view.elevation[part]) * np.float32(rows / (_HIGHEST - _LOWEST)) - np.float32(0.5)
    np.clip(v, 0.0, rows - 1.0, out=v)
    image[part] = cv2.remap(panorama, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return image


def light_ground(
    colour: Float[np.ndarray, "h w 3"],
    view: View,
    weather: Weather,
    sunny: Float[np.ndarray, "h w"],
    open_sky: Float[np.ndarray, "h w"],
    lamps: Float[np.ndarray, "h w"],
) -> None:
    """Apply light, shadows, haze and wet reflections to the ground's albedo, in place.

    Args:
        colour: 0 to 255.
        view: positions of the pixels on the ground.
        weather: with its sun in the ego frame.
        sunny, open_sky: fractions of direct and of ambient light that arrive.
        lamps: light of street lamps.
    """
    light = weather.direct * sunny + weather.ambient * open_sky
    if weather.night:
        ahead = np.maximum(view.x, 0.0)
        beam = np.exp(-((ahead / HEADLIGHTS) ** 2) - (view.y / (2.2 + 0.2 * ahead)) ** 2)
        light += weather.night * (0.75 * beam * (view.x > 1.0) + 0.4 * lamps)
    clear = np.exp(view.distance * np.float32(-1.0 / weather.visibility))
    light *= clear
    hidden = 1.0 - clear
    if weather.rain:
        # Wet asphalt mirrors the sky at grazing angles.
        mirror = 0.45 * weather.rain * np.minimum(view.distance * (1.0 / 60.0), 1.0)
        light *= 1.0 - mirror
        hidden += 0.8 * mirror * clear
    colour *= light[..., None].astype(np.float32)
    colour += hidden[..., None] * (255.0 * weather.horizon).astype(np.float32)


def cast(corners: Float[np.ndarray, "b 4 2"], height: Float[np.ndarray, " b"], sun: Float[np.ndarray, "3"]) -> list:
    """Return the outlines of the shadows of upright prisms on the ground, (k, 2) each, metres."""
    import cv2

    shift = -sun[:2] / max(float(sun[2]), _STEEPEST_SHADOW) * height[:, None]
    both = np.concatenate([corners, corners + shift[:, None]], 1).astype(np.float32)
    return [cv2.convexHull(points)[:, 0].astype(np.float64) for points in both]


def vehicle_shadows(
    view: View, boxes: Float[np.ndarray, "b 7"], weather: Weather
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Return the fractions of direct and ambient light left by the shadows of road users.

    Args:
        view: of the camera.
        boxes: of road users, ego frame.
        weather: with its sun in the ego frame.
    """
    import cv2

    shape = view.x.shape
    sunny, open_sky = np.full(shape, 255, np.uint8), np.full(shape, 255, np.uint8)
    boxes = boxes[_may_be_seen(view.camera, boxes)]
    corners = footprints(boxes)
    if weather.direct > 0.1:
        for ring in cast(corners, boxes[:, 6], weather.sun):
            _fill(sunny, ring, view, 30)
    for ring in corners:
        _fill(open_sky, ring, view, 90)
    blur = (5, 3)
    scale = np.float32(1.0 / 255.0)
    return cv2.GaussianBlur(sunny, blur, 0) * scale, cv2.GaussianBlur(open_sky, blur, 0) * scale


def _may_be_seen(camera: PinholeCamera, boxes: Float[np.ndarray, "b 7"]) -> Bool[np.ndarray, " b"]:
    """Return which bodies may cast a shadow into the image: those not far beyond its left and right borders."""
    local = boxes[:, :3] * [1.0, 1.0, 0.0] @ camera.camera_from_ego[:3, :3].T + camera.camera_from_ego[:3, 3]
    margin = boxes[:, 2] + boxes[:, 6] / _STEEPEST_SHADOW
    half = 0.6 * camera.width / camera.intrinsics[0, 0]
    depth = local[:, 2]
    return (depth > -margin) & (depth < 120.0) & (np.abs(local[:, 0]) < half * np.maximum(depth, 0.0) + margin)


def _fill(mask: UInt8[np.ndarray, "h w"], ring: Float[np.ndarray, "k 2"], view: View, value: int) -> None:
    """Fill a polygon on the ground."""
    import cv2

    points = lift(ring) if view.raised is None else view.raised(lift(ring))
    pixels, depth = view.camera.image_of(points)
    if depth.max() <= NEAR:
        return
    if depth.min() <= NEAR:
        pixels, _ = view.camera.image_of(clipped(points, depth))
    if (pixels.max(0) < 0.0).any() or (pixels.min(0) > [view.camera.width, view.camera.height]).any():
        return
    cv2.fillPoly(mask, [fixed_point(pixels - [0.0, view.first_row])], value, cv2.LINE_8, SHIFT)

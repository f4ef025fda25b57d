"""Light and shadow on the ground of a front view, and the backdrop: sky, hills and woods."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.world.front_view.ground import FAR, Ground
from tflane_jax.world.front_view.road import Highway
from tflane_jax.world.front_view.roadside import Roadside
from tflane_jax.world.front_view.traffic import FrontTraffic, ground_shadows
from tflane_jax.world.render.camera import NEAR, PinholeCamera, lift
from tflane_jax.world.render.noise import noise_tile
from tflane_jax.world.render.polygons import HEADLIGHTS, SHIFT, fixed_point
from tflane_jax.world.render.weather import Weather


def light_ground(
    colour: Float[np.ndarray, "3 h w"],
    traffic: FrontTraffic,
    roadside: Roadside,
    road: Highway,
    camera: PinholeCamera,
    ground: Ground,
    weather: Weather,
) -> None:
    """Apply light, shadows, haze and wet reflections to the ground's albedo, in place."""
    light, open_sky = _shadows(traffic, roadside, road, camera, ground, weather)
    light *= weather.direct
    open_sky *= weather.ambient
    light += open_sky
    if weather.night:
        # The headlight beam on the road ahead of the ego widens with distance.
        near = ground.depth / HEADLIGHTS
        lateral = (ground.offset - np.float32(road.ego_offset)) / (3.0 + 0.12 * ground.depth)
        light += weather.night * 0.75 * np.exp(-near * near - lateral * lateral)
    clear = np.exp(ground.depth * (-1.0 / weather.visibility))
    light *= clear
    hidden = 1.0 - clear
    if weather.rain:
        # Wet asphalt mirrors the sky at grazing angles.
        mirror = 0.45 * weather.rain * np.minimum(ground.depth * (1.0 / 60.0), 1.0)
        light *= 1.0 - mirror
        hidden += 0.8 * mirror * clear
    for channel, sky in zip(colour, weather.horizon.tolist(), strict=True):
        channel *= light
        channel += sky * hidden


def show_ground(image: UInt8[np.ndarray, "h w 3"], colour: Float[np.ndarray, "3 k w"], ground: Ground) -> None:
    """Copy the ground's colours into the image, below the horizon."""
    import cv2

    shown = cv2.convertScaleAbs(cv2.merge(list(colour)), alpha=255.0)
    cv2.copyTo(shown, ground.seen.view(np.uint8), image[ground.first_row :])


def _shadows(
    traffic: FrontTraffic, roadside: Roadside, road: Highway, camera: PinholeCamera, ground: Ground, weather: Weather
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fractions of direct and of ambient light that reach the ground (0 to 1)."""
    import cv2

    shape = (camera.height - ground.first_row, camera.width)
    sunny, open_sky = np.full(shape, 255, np.uint8), np.full(shape, 255, np.uint8)
    cast, below = ground_shadows(traffic, weather.sun)
    offset = np.array([0.0, ground.first_row])
    if weather.direct > 0.1:
        toward = weather.sun[:2] / max(weather.sun[2], 0.05)
        angle = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        for x, y, height, radius in roadside.crowns:
            middle = np.array([x, y]) - toward * height
            stretch = np.eye(2) + np.outer(toward, toward) / max(np.hypot(*toward), 1e-6) * 0.8
            for k in range(4):
                shift = radius * 0.5 * np.array([np.cos(2.4 * k + x), np.sin(2.4 * k + y)])
                _fill(sunny, middle + (0.6 * radius * circle + shift) @ stretch, camera, offset, 30)
        for corners in cast:
            hull = cv2.convexHull(corners.astype(np.float32))[:, 0]
            _fill(sunny, hull.astype(np.float64), camera, offset, 0)
    for station, half in roadside.bridges:
        sides = np.array([-60.0, 60.0])
        s = np.clip(station + np.array([-half, -half, half, half]), 2.0, FAR)
        deck = road.at(s, np.concatenate([sides, sides[::-1]]))
        _fill(open_sky, deck, camera, offset, 115)
        if weather.direct > 0.1:
            _fill(sunny, deck - weather.sun[:2] / max(weather.sun[2], 0.3) * 6.0, camera, offset, 0)
    for corners in below:
        _fill(open_sky, corners, camera, offset, 70)
    sunny, open_sky = (cv2.GaussianBlur(mask, (5, 3), 0) for mask in (sunny, open_sky))
    return sunny * np.float32(1.0 / 255.0), open_sky * np.float32(1.0 / 255.0)


def _fill(
    mask: UInt8[np.ndarray, "h w"],
    ring: Float[np.ndarray, "k 2"],
    camera: PinholeCamera,
    offset: np.ndarray,
    value: int,
) -> None:
    """Fill a polygon on the ground."""
    import cv2

    if ring[:, 0].max() < 1.5 or ring[:, 0].min() > FAR:
        return
    ring = lift(ring)
    ring[:, 0] = np.maximum(ring[:, 0], 1.5)
    pixels, depth = camera.image_of(ring)
    if depth.min() > NEAR:
        cv2.fillPoly(mask, [fixed_point(pixels - offset)], value, cv2.LINE_AA, SHIFT)


def draw_backdrop(rng: np.random.Generator, camera: PinholeCamera, weather: Weather) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image of the sky with clouds and the sun's glow, and of hills and woods on the horizon."""
    import cv2

    w, h = camera.width, camera.height
    columns = np.arange(w) + 0.5
    horizon = camera.horizon_rows(columns)
    image = cv2.resize(_sky(rng, camera, weather), (w, h), interpolation=cv2.INTER_LINEAR)
    for distance, tallest, colour in ((3000.0, 0.075, (0.38, 0.42, 0.42)), (700.0, 0.05, (0.2, 0.25, 0.16))):
        absent, height, row = rng.random() < 0.25, rng.uniform(0.3, 1.0), rng.integers(256)
        if absent:
            continue
        waves = np.interp(np.linspace(0, 90, w), np.arange(256), noise_tile()[row])
        skyline = horizon - h * tallest * height * np.clip(0.45 + 0.35 * waves, 0.02, 1.2)
        clear = np.exp(-0.35 * distance / weather.visibility)
        light = weather.ambient + 0.5 * weather.direct
        tone = clear * light * np.array(colour) + (1.0 - clear) * weather.horizon
        ring = np.concatenate([np.stack([columns, skyline], -1), np.stack([columns, horizon + 3.0], -1)[::-1]])
        cv2.fillPoly(image, [fixed_point(ring)], (255.0 * tone).tolist(), cv2.LINE_AA, SHIFT)
    return image


def _sky(rng: np.random.Generator, camera: PinholeCamera, weather: Weather) -> UInt8[np.ndarray, "k l 3"]:
    """Return the sky at a quarter of the image's size."""
    import cv2

    h, w = camera.height // 4, camera.width // 4
    columns, rows = 4.0 * np.arange(w) + 2.0, 4.0 * np.arange(h)[:, None] + 2.0
    above = np.clip((camera.horizon_rows(columns) - rows) / (0.45 * camera.height), 0.0, 1.0)[..., None]
    sky = weather.horizon + above**0.7 * (weather.zenith - weather.horizon)
    top, left = rng.integers(0, 128, 2)
    tile = noise_tile()[top : top + 40, left : left + 60]
    clouds = cv2.resize(tile, (w, h), interpolation=cv2.INTER_CUBIC)[..., None]
    cover = weather.cloud * np.clip(0.5 * clouds + 0.2, 0.0, 1.0) * np.minimum(1.0, 4.0 * above)
    sky += cover * (np.minimum(1.1 * weather.horizon, 1.0) - sky)
    (sun,), (depth,) = camera.image_of(1e4 * weather.sun[None])
    if weather.direct > 0.1 and depth > NEAR:
        away = np.hypot(columns - sun[0], rows - sun[1]) / (0.16 * camera.width)
        sky += 0.75 * np.exp(-away)[..., None] * [1.0, 0.93, 0.8]
    return (255.0 * np.clip(sky, 0.0, 1.0)).astype(np.uint8)

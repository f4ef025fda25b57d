"""Static content of a log, drawn once for all key frames: weather, paint, ground, scenery, sky, shadows."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.files.images import opencv
from tflane_jax.recent import KeptWith
from tflane_jax.scene.logs import Log, VectorMap
from tflane_jax.world.cameras.elements import element_bodies, mast_bodies
from tflane_jax.world.cameras.ground import Ground, draw_ground
from tflane_jax.world.cameras.ground_window import window_around
from tflane_jax.world.cameras.light import cast, draw_panorama, log_weather
from tflane_jax.world.cameras.markers import marker_bodies
from tflane_jax.world.cameras.paint import Paint, paint_of
from tflane_jax.world.cameras.ring import ROOT, CameraRigConfig
from tflane_jax.world.cameras.scenery import Scenery, draw_scenery
from tflane_jax.world.cameras.solids import Bodies, footprints, join
from tflane_jax.world.render.polygons import SHIFT
from tflane_jax.world.render.weather import Weather

# Distance from the key frames up to which the ground is drawn, and its texel size; light and shadow have coarser
# texels; metres.
_REACH, _TEXEL = 90.0, 0.08
SHADE_TEXEL = 0.25
# Above this image scale the sky, and the ground near the vehicle, are drawn at a finer resolution.
LARGE = 0.25
_MOST_WORN = 0.88
# Height of the buildings of a real log, metres.
_TOWER = 100.0


class Stream(enum.IntEnum):
    """The random streams of a log."""

    WEATHER = 0
    PAINT = 1
    GROUND = 2
    SCENERY = 3
    SKY = 4
    LOOKS = 5
    PICTURE = 6


@dataclass(frozen=True)
class Stage:
    """Static content of a log.

    Attributes:
        weather: with its sun in the global frame.
        paint, scenery: of the map.
        static: scenery, masts and fiducial markers, global frame.
        panorama: of the sky.
        low: global x and y of the corner of `shade` and `lamps`, whose texels are `SHADE_TEXEL` metres.
        shade: (h, w) uint8 fraction of sunlight left by buildings and trees.
        lamps: (h, w) uint8 light of street lamps; None by day.
        looks: (K, 8) random numbers that choose shape and colours of the road users.
        ground: around all key frames.
        users: cache of road users' bodies.
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


_STAGES: KeptWith[Stage] = KeptWith()


def stage_of(log: Log, config: CameraRigConfig) -> Stage:
    """Return the static content of a log, on level ground, cached for the lifetime of the log object."""
    log = log if log.relief is None else log.relief.level
    # Cameras and their calibration do not change the static content.
    key = replace(config, cameras=(), jitter=0.0, multiple=1, element_pixels=0.0, depth_cell=None)
    return _STAGES(log, key, lambda: _set_stage(log, config))


def _set_stage(log: Log, config: CameraRigConfig) -> Stage:
    weather = log_weather(
        log_stream(log, Stream.WEATHER), config.weather, weather=log.weather, severity=config.severity
    )
    # Even fully worn lines keep some paint in the pores of the asphalt.
    wear = min(log.paint_wear * config.severity, 1.0) * _MOST_WORN
    paint = paint_of(log_stream(log, Stream.PAINT), log.map, paint_wear=wear, log_seed=log.seed)
    scenery = draw_scenery(log_stream(log, Stream.SCENERY), log.map, weather.night)
    places = np.stack([keyframe.global_from_ego[:2, 3] for keyframe in log.keyframes])
    ground = draw_ground(
        log_stream(log, Stream.GROUND),
        log.map,
        paint,
        window_around(places, _REACH, _TEXEL),
        dirt=weather.dirt,
        wet=weather.rain,
        urban=scenery.urban,
    )
    low, shade, lamps = _static_light(places, scenery, weather)
    masts = mast_bodies(log.map.elements, log.map.road_boundaries)
    return Stage(
        weather=weather,
        paint=paint,
        scenery=scenery,
        static=join([scenery.bodies, masts, marker_bodies(log.markers if config.markers else None)]),
        panorama=draw_panorama(log_stream(log, Stream.SKY), weather, 3072 if config.scale > LARGE else 1024),
        low=low,
        shade=shade,
        lamps=lamps,
        looks=log_stream(log, Stream.LOOKS).random((len(log.actors.size), 8)),
        ground=ground,
    )


_BOXES: KeptWith[np.ndarray] = KeptWith()


def static_boxes(log: Log) -> Float[np.ndarray, "b 7"]:
    """Return the boxes of all that stands beside the roads of a log but boards: as `Bodies.boxes`, global frame.

    Nothing is drawn, but OpenCV is needed. Of real logs, which have no scenery, buildings alone are known. All
    stands on level ground.
    """
    return map_boxes(log.map, log.seed) if log.markers is not None else _buildings(log)


def map_boxes(vector_map: VectorMap, seed: int) -> Float[np.ndarray, "b 7"]:
    """Return `static_boxes` of the world's scene with this map and seed; cached for the lifetime of the map."""
    return _BOXES(vector_map, seed, lambda: _map_boxes(vector_map, seed))


def _map_boxes(vector_map: VectorMap, seed: int) -> Float[np.ndarray, "b 7"]:
    opencv()
    scenery = draw_scenery(np.random.default_rng([ROOT, seed, Stream.SCENERY]), vector_map, 0.0)
    masts = mast_bodies(vector_map.elements, vector_map.road_boundaries)
    shown = np.array([element.attribute for element in vector_map.elements], int)
    boxes = [scenery.bodies.boxes, masts.boxes]
    if len(shown):
        boxes.append(element_bodies(vector_map.elements, shown).boxes)
    return np.concatenate(boxes)


def _buildings(log: Log) -> Float[np.ndarray, "b 7"]:
    blocks = np.asarray(log.map.buildings, np.float64).reshape(-1, 5)
    return np.column_stack([blocks, np.zeros(len(blocks)), np.full(len(blocks), _TOWER)])


def log_stream(log: Log, stream: Stream) -> np.random.Generator:
    return np.random.default_rng([ROOT, log.seed, stream])


def _static_light(
    places: Float[np.ndarray, "n 2"], scenery: Scenery, weather: Weather
) -> tuple[Float[np.ndarray, "2"], UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"] | None]:
    """Return `low`, `shade` and `lamps` of `Stage`."""
    import cv2

    window = window_around(places, _REACH, SHADE_TEXEL)
    shade = np.full((window.rows, window.columns), 255, np.uint8)
    if weather.direct > 0.1:
        boxes = np.pad(scenery.towers[:, :5], ((0, 0), (0, 2)))
        for ring in cast(footprints(boxes), scenery.towers[:, 5], weather.sun):
            cv2.fillPoly(shade, [window.fixed(ring)], 20, cv2.LINE_8, SHIFT)
        toward = weather.sun[:2] / max(float(weather.sun[2]), 0.35)
        angle = np.linspace(0.0, 2.0 * np.pi, 15)[:-1]
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        for x, y, height, radius in scenery.crowns:
            ragged = 1.0 + 0.18 * np.sin(5.0 * angle + x)[:, None]
            stretched = circle + 0.5 * (circle @ toward)[:, None] * toward
            ring = np.array([x, y]) - toward * height + 0.85 * radius * ragged * stretched
            cv2.fillPoly(shade, [window.fixed(ring)], 60, cv2.LINE_8, SHIFT)
        shade = cv2.GaussianBlur(shade, (3, 3), 0)
    lamps = None
    if weather.night:
        lamps = np.zeros_like(shade)
        for center in window.fixed(scenery.lamps).tolist():
            cv2.circle(lamps, center, round(9.0 / SHADE_TEXEL * (1 << SHIFT)), 130, -1, cv2.LINE_8, SHIFT)
            cv2.circle(lamps, center, round(4.5 / SHADE_TEXEL * (1 << SHIFT)), 230, -1, cv2.LINE_8, SHIFT)
        lamps = cv2.GaussianBlur(lamps, (0, 0), 2.5 / SHADE_TEXEL)
    return np.array(window.low), shade, lamps

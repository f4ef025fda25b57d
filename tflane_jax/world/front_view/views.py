"""Front views of the built-in world: an image of a highway and its lane lines for every scene number.

Random draws come from streams `np.random.default_rng([ROOT, scene id, stream])`, one each for camera, road, traffic,
roadside, weather, texture and noise, so that a change of one part does not change the others.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from tflane_jax.errors import UserError
from tflane_jax.limits import Fraction, Positive
from tflane_jax.scene import LaneLines, RoadImage
from tflane_jax.world.front_view.ground import look_at_ground
from tflane_jax.world.front_view.lines import label_lines
from tflane_jax.world.front_view.picture import draw_backdrop, light_ground, show_ground
from tflane_jax.world.front_view.road import Highway, HighwayConfig, draw_highway
from tflane_jax.world.front_view.roadside import Roadside, draw_roadside
from tflane_jax.world.front_view.surface import paint_ground
from tflane_jax.world.front_view.traffic import FrontTraffic, FrontTrafficConfig, draw_traffic
from tflane_jax.world.front_view.vehicles import vehicle_solids
from tflane_jax.world.render.camera import FrontCameraConfig, PinholeCamera, draw_camera
from tflane_jax.world.render.exposure import develop
from tflane_jax.world.render.polygons import draw_solids
from tflane_jax.world.render.weather import FrontWeatherConfig, Weather, draw_weather

ROOT = 20_250_713


class Stream(enum.IntEnum):
    """The random streams of a scene."""

    CAMERA = 0
    ROAD = 1
    TRAFFIC = 2
    ROADSIDE = 3
    WEATHER = 4
    GROUND = 5
    SKY = 6
    PICTURE = 7


@dataclass(frozen=True)
class FrontWorldConfig:
    """Front views of the built-in world.

    Attributes:
        camera, road, traffic, weather: parts of the scene: camera, road, traffic, weather.
        severity: 0 (clear sky, fresh paint, clean asphalt, a perfect camera) to 1 (all degradations at full strength).
        reach: lane lines are annotated up to this distance along the road, metres.
    """

    camera: FrontCameraConfig = FrontCameraConfig()
    road: HighwayConfig = HighwayConfig()
    traffic: FrontTrafficConfig = FrontTrafficConfig()
    weather: FrontWeatherConfig = FrontWeatherConfig()
    severity: Fraction = 0.5
    reach: Positive = 90.0


@dataclass(frozen=True)
class FrontScene:
    """The content of one image, in the ego frame."""

    camera: PinholeCamera
    road: Highway
    traffic: FrontTraffic
    roadside: Roadside
    weather: Weather


def draw_front_scene(scene_id: int, config: FrontWorldConfig = FrontWorldConfig()) -> FrontScene:
    """Return the scene with this number (not negative).

    Raises UserError if the severity is not between 0 and 1.
    """
    weather = scene_weather(scene_id, config)
    road = draw_highway(_stream(scene_id, Stream.ROAD), config.road, weather.wear)
    return FrontScene(
        camera=draw_camera(_stream(scene_id, Stream.CAMERA), config.camera),
        road=road,
        traffic=draw_traffic(_stream(scene_id, Stream.TRAFFIC), road, config.traffic),
        roadside=draw_roadside(_stream(scene_id, Stream.ROADSIDE), road),
        weather=weather,
    )


def scene_weather(scene_id: int, config: FrontWorldConfig = FrontWorldConfig()) -> Weather:
    """Return light and weather of the scene with this number; raise UserError like `draw_front_scene`."""
    if not 0.0 <= config.severity <= 1.0:
        raise UserError(f"severity must be between 0 and 1, not {config.severity}")
    return draw_weather(_stream(scene_id, Stream.WEATHER), config.weather, config.severity)


def front_view(scene_id: int, config: FrontWorldConfig = FrontWorldConfig()) -> RoadImage:
    """Return the picture of the scene with this number, and its lane lines."""
    scene = draw_front_scene(scene_id, config)
    image = render(scene, scene_id)
    return RoadImage(image, np.ones(image.shape[:2], bool), scene_lines(scene, config.reach))


def scene_lines(scene: FrontScene, reach: float) -> LaneLines:
    """Return the scene's lane lines up to a distance along the road (metres)."""
    return label_lines(scene.camera, scene.road, reach)


def render(scene: FrontScene, scene_id: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture of a scene; `scene_id` seeds texture and noise."""
    camera, road, weather = scene.camera, scene.road, scene.weather
    ground = look_at_ground(camera, road.axis)
    colour = paint_ground(_stream(scene_id, Stream.GROUND), camera, road, ground, dirt=weather.dirt, wet=weather.rain)
    light_ground(colour, scene.traffic, scene.roadside, road, camera, ground, weather)
    image = draw_backdrop(_stream(scene_id, Stream.SKY), camera, weather)
    show_ground(image, colour, ground)
    solids = [*scene.roadside.solids, *vehicle_solids(scene.traffic, weather.night)]
    draw_solids(image, solids, camera, weather)
    return develop(_stream(scene_id, Stream.PICTURE), image, weather)


def _stream(scene_id: int, stream: Stream) -> np.random.Generator:
    return np.random.default_rng([ROOT, scene_id, stream])

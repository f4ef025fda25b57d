"""Settings of the built-in world that cannot be are named before a scene is made of them."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.limits import check_settings
from tflane_jax.world.cameras.ring import NUSCENES_RING, CameraRigConfig
from tflane_jax.world.front_view.road import HighwayConfig
from tflane_jax.world.front_view.traffic import FrontTrafficConfig
from tflane_jax.world.front_view.views import FrontWorldConfig
from tflane_jax.world.presets import CITY
from tflane_jax.world.render.camera import FrontCameraConfig
from tflane_jax.world.render.weather import FrontWeatherConfig, Sky
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.roads.networks import build_road_network
from tflane_jax.world.simulate import WorldConfig
from tflane_jax.world.terrain import TerrainConfig
from tflane_jax.world.traffic.simulation import TrafficConfig


@pytest.mark.parametrize(
    ("config", "setting"),
    [
        (RoadConfig(ego_reach=140.0), "ego_reach"),
        (RoadConfig(pocket=(20.0, 46.0)), "pocket"),
        (RoadConfig(taper=(0.0, 26.0)), "taper"),
        (RoadConfig(driveway_depth=(2.0, 9.0)), "driveway_depth"),
        (RoadConfig(lane_width=(0.0, 3.0)), "lane_width"),
        (RoadConfig(bend_radius=(5.0, 50.0)), "bend_radius"),
        (RoadConfig(urban_speed=(0.0, 0.0)), "urban_speed"),
        (RoadConfig(vertex_spacing=50.0), "vertex_spacing"),
        (TrafficConfig(step_s=2.0), "step_s"),
        (TerrainConfig(grade=0.5), "grade"),
        (TerrainConfig(wavelength=(10.0, 200.0)), "wavelength"),
        (WorldConfig(view_turn=400.0), "view_turn"),
        (FrontWorldConfig(severity=2.0), "severity"),
        (FrontWorldConfig(reach=-5.0), "reach"),
        (HighwayConfig(lanes=(0.0, 0.0, 0.0, 0.0)), "lanes"),
        (HighwayConfig(lanes=(-1.0, 1.0, 1.0, 1.0)), "lanes"),
        (HighwayConfig(radius=(0.0, 4000.0)), "radius"),
        (HighwayConfig(two_way=7.0), "two_way"),
        (FrontTrafficConfig(categories=(0.0, 0.0, 0.0, 0.0)), "categories"),
        (FrontTrafficConfig(empty=3.0), "empty"),
        (FrontWeatherConfig(kinds=((Sky.RAIN, 1.0), (Sky.FOG, 1.0))), "kinds"),
        (PlacementConfig(dictionary=500), "dictionary"),
        (FrontCameraConfig(width=0), "width"),
        (FrontCameraConfig(focal=(0.0, 0.0)), "focal"),
        (FrontCameraConfig(above_ground=(0.0, 0.0)), "above_ground"),
    ],
)
def test_impossible_settings_are_named(config, setting):
    check_settings(type(config)())
    with pytest.raises(UserError, match=rf"^{setting} is "):
        check_settings(config)


def test_a_camera_below_the_road_is_named():
    below = CameraRigConfig(cameras=(NUSCENES_RING[1], replace(NUSCENES_RING[0], z=-1.0)))
    with pytest.raises(UserError, match=r"^cameras\[1\]\.z is -1\.0: it must be"):
        check_settings(below)


@pytest.mark.parametrize(
    ("kind", "settings", "remedy"),
    [
        (SceneKind.TWO_JUNCTIONS, {"corner_radius": (30.0, 30.0)}, "raise reach or junction_distance"),
        (SceneKind.ROAD, {"reach": 60.0, "ego_reach": 50.0}, "raise ego_reach and reach"),
        (SceneKind.FOUR_WAY, {"pocket": (200.0, 200.0)}, "do not fit into a street of .* m: lower pocket"),
        (
            SceneKind.FOUR_WAY,
            {"reach": 80.0, "ego_reach": 70.0, "pocket": (63.0, 63.0)},
            "do not fit into a street of .* m: lower pocket",
        ),
    ],
)
def test_roads_without_room_say_what_gives_them_some(kind, settings, remedy):
    roads = replace(CITY.roads, kinds=((kind, 1.0),), **settings)
    check_settings(roads)
    with pytest.raises(UserError, match=remedy):
        _ = [build_road_network(np.random.default_rng([5, seed]), roads) for seed in range(8)]

"""Fixed worlds: `CITY` and `STREET`, on which models are compared; `HILLS`; `REAL_LIKE`, close to recorded logs;
`REAL_MAPS`, for recorded maps.

All hold enough of a drive for a history of 10 s (20 frames at 2 Hz) before every key frame, and about as many road
users as real logs (docs/world.md compares them; bicycles are rarer). `CITY` and `STREET` differ in their roads alone.
`WorldData.city` and `WorldData.street` add the ranges and capacities of the examples.
"""

from __future__ import annotations

from dataclasses import replace

from tflane_jax.scene import LineType
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.simulate import WorldConfig
from tflane_jax.world.terrain import TerrainConfig
from tflane_jax.world.traffic.simulation import TrafficConfig
from tflane_jax.world.traffic.tracker import TrackerConfig

CITY = WorldConfig(
    # The ego vehicle drives up to 160 m before its first key frame.
    roads=RoadConfig(reach=190.0, ego_reach=178.0, parking=0.85, bike=0.35),
    traffic=TrafficConfig(
        vehicles_per_metre=0.055,
        bicycles_per_metre=0.016,
        parked_share=0.9,
        pedestrians_per_metre=0.08,
        crossers_per_minute=8.0,
        variety=0.6,
        ego_top_speed=12.0,
        ego_passes_s=13.0,
        range=80.0,
        warm_up_s=12.0,
        early_s=70.0,
        step_s=0.4,
    ),
    # Like labelled tracks: they bridge an occlusion of 2 s, and a glimpse of a road user is enough.
    tracker=TrackerConfig(
        range=60.0, falloff=15.0, view_needed=0.1, drop=0.01, coast=20, switch_rate=0.01, look_every_s=0.5
    ),
    # 10 s of history, then key frames 2 s apart.
    duration_s=16.1,
    keyframes=4,
)
"""Roads and junctions of the default world (`WorldConfig()`), with traffic, tracker and history as above."""

STREET = replace(
    CITY,
    roads=replace(
        CITY.roads,
        kinds=(
            (SceneKind.ROAD, 0.15),
            (SceneKind.LANE_DROP, 0.17),
            (SceneKind.LANE_GAIN, 0.18),
            (SceneKind.ON_RAMP, 0.15),
            (SceneKind.EXIT_RAMP, 0.13),
            (SceneKind.T_JUNCTION, 0.22),
        ),
        junction_lanes=1,
    ),
)
"""Roads that bend, split and merge, and T junctions of streets with one lane in each direction."""

HILLS = replace(CITY, terrain=TerrainConfig())
"""`CITY` on hilly ground: the same roads and traffic, scene by scene, with heights."""

REAL_LIKE = replace(
    CITY,
    roads=replace(
        CITY.roads,
        kinds=(
            (SceneKind.ROAD, 0.03),
            (SceneKind.T_JUNCTION, 0.3),
            (SceneKind.FOUR_WAY, 0.3),
            (SceneKind.TWO_JUNCTIONS, 0.13),
            (SceneKind.FIVE_LEGS, 0.1),
            (SceneKind.STAGGERED, 0.14),
        ),
        lane_width=(3.0, 4.2),
        single_lane_width=(3.2, 6.5),
        # Recorded maps have no lines at kerbs and medians, and nearly all others.
        kerb_marking=((LineType.NONE, 0.96), (LineType.SOLID, 0.04)),
        inner_marking=((LineType.SOLID, 0.6), (LineType.DASHED, 0.34), (LineType.NONE, 0.06)),
        outer_marking=((LineType.SOLID, 0.6), (LineType.DASHED, 0.25), (LineType.NONE, 0.15)),
        divider_marking=((LineType.DASHED, 0.85), (LineType.NONE, 0.07), (LineType.SOLID, 0.08)),
        solid_before_stop=10.0,
        corner_radius=(3.5, 7.0),
        junction_distance=(60.0, 70.0),
        side_lean=3.0,
        second_sides=0.6,
        another_lane=0.2,
        wide_turns=0.65,
        lane_changes=0.15,
        change_distance=(8.0, 45.0),
        driveways=3.0,
        access_share=0.2,
        cut_setback=0.4,
        one_way=0.12,
        median=0.5,
        bike=0.12,
        parking=0.1,
        gutter=(0.0, 0.25),
        car_parks=0.9,
        crossings=0.3,
    ),
    traffic=replace(
        CITY.traffic,
        vehicles_per_metre=0.08,
        pedestrians_per_metre=0.048,
        crossers_per_minute=5.0,
        # Examples are made near the junction, where the box still shows it.
        ego_top_speed=8.0,
        ego_passes_s=14.0,
    ),
    # Recorded evidence is rendered in fine weather.
    severity=0.3,
    longer_s=20.0,
    keyframe_spacing="distance",
    mirrored=0.5,
    # In a fifth of recorded frames all roads are oblique: the vehicle turns, or changes lanes.
    view_turn=45.0,
    view_turned=0.2,
)
"""Generated roads whose frames hold about as much as those of nine recorded logs: lanes and their widths, connectors,
road users, and how often the vehicle is inside a junction. In every second scene traffic keeps to the left, as in five
of the logs.

Fitted by hand to the means of these logs (docs/real_roads.md), whose maps it does not contain.
"""

REAL_MAPS = replace(
    CITY,
    traffic=replace(
        CITY.traffic,
        vehicles_per_metre=0.06,
        bicycles_per_metre=0.015,
        pedestrians_per_metre=0.034,
        crossers_per_minute=5.0,
        early_s=90.0,
    ),
    mirrored=0.5,
)
"""Traffic on recorded maps: they have more road, and more kerb to walk along, than the generated ones. Every second
scene is on the mirror image of its map: twice as many places, and both sides of the road."""

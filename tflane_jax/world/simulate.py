"""A scene of the built-in world from its number: roads, traffic, tracker -> `Log`.

Random draws come from streams `np.random.default_rng([ROOT, scene id, stream])`: a scene is the same on any machine,
up to the last bit of sine and cosine, and a change of one part (for example the tracker) does not change the others.
"""

from __future__ import annotations

import enum
import functools
import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import yaw_pose
from tflane_jax.limits import Count, Fraction, above_at_most, within
from tflane_jax.scene.logs import KeyFrame, Log, Tracks, VectorMap
from tflane_jax.world.cameras.marker_sites import visible_places
from tflane_jax.world.excerpt import excerpt
from tflane_jax.world.mirror import mirrored, mirrored_map, mirrored_road_map
from tflane_jax.world.roads.map_networks import build_map_network
from tflane_jax.world.roads.markers import PlacementConfig, Visible, place_markers
from tflane_jax.world.roads.networks import RoadConfig, RoadNetwork, build_road_network
from tflane_jax.world.roads.road_map import RoadMap, drives_on_left
from tflane_jax.world.terrain import TerrainConfig, on_terrain
from tflane_jax.world.traffic.signals import element_states, show_signals
from tflane_jax.world.traffic.simulation import EGO_JOINS, Traffic, TrafficConfig, simulate_traffic
from tflane_jax.world.traffic.tracker import TrackerConfig, track, wrap_outside
from tflane_jax.world.view import turned_view
from tflane_jax.world.warp import Warp, WarpConfig, warped, warped_map

ROOT = 20_250_711
# Frames that a scene has before its first key frame, unless its examples look back farther.
HISTORY = 20
# Drives that are tried for a scene, and frames that one must offer for each key frame.
_DRIVES, _LEAST_STEP = 40, 4
# Where key frames are spaced by distance, a vehicle that stands counts as moving so far in each frame, metres.
_CREEP = 0.01


class Stream(enum.IntEnum):
    """The random streams of a scene."""

    ROADS = 0
    TRAFFIC = 1
    TRACKER = 2
    CONDITIONS = 3
    TERRAIN = 4
    MIRROR = 5
    WARP = 6
    VIEW = 7
    EXCERPT = 8


@dataclass(frozen=True)
class WorldConfig:
    """The built-in world.

    Attributes:
        roads, traffic, tracker: parts of the world: roads, traffic, and the tracker that observes it.
        markers: placement of fiducial markers. They change nothing else in a scene.
        severity: 0 (clear) to 1 (worst): scales weather and paint wear and, weakly, traffic density and tracker
            noise.
        duration_s, rate_hz: length of a scene and its frame rate.
        longer_s: by how much the drive is longer than the scene, seconds. The scene then shows the part around a
            moment in which the vehicle is inside an intersection, if there is one.
        keyframes: moments at which examples are made, from the end of the first history to the end of the scene.
        keyframe_spacing: "time": evenly spaced in time; "distance": along the drive, so that a vehicle that waits
            gives no frame again and again, and the middle of its route is passed more often.
        terrain: hills; None: level ground. They change nothing else in a scene.
        mirrored: fraction of the scenes that are seen in a mirror: generated roads then have left-hand traffic, and
            recorded maps change sides. Roads and traffic are mirror images; paint wear, sensor noise and scenery are
            drawn anew.
        warp: how ground plans are stretched, sheared and bent, map, road users and drive alike; None: not at all.
        view_turn: largest angle between the frame in which a scene is perceived and the vehicle's heading, degrees;
            each scene has its own. Cameras turn with it.
        view_turned: fraction of the scenes that are perceived so; in the others the angle is 0.
    """

    roads: RoadConfig = RoadConfig()
    traffic: TrafficConfig = TrafficConfig()
    tracker: TrackerConfig = TrackerConfig()
    markers: PlacementConfig = PlacementConfig()
    severity: Fraction = 0.5
    duration_s: Annotated[float, above_at_most(0, 3600)] = 8.0
    rate_hz: Annotated[float, above_at_most(0, 1000)] = 10.0
    longer_s: Annotated[float, within(0, 3600)] = 0.0
    keyframes: Count = 4
    keyframe_spacing: Literal["time", "distance"] = "time"
    terrain: TerrainConfig | None = None
    mirrored: Fraction = 0.0
    warp: WarpConfig | None = None
    view_turn: Annotated[float, within(0, 180)] = 0.0
    view_turned: Fraction = 1.0

    @property
    def frames(self) -> int:
        """Number of frames of a scene."""
        return round(self.duration_s * self.rate_hz)


@dataclass(frozen=True)
class Place:
    """A recorded map to simulate on, instead of generated roads.

    Attributes:
        road_map: the map.
        sees: distance up to which an example must be complete, metres: half the diagonal of the perceived box.
    """

    road_map: RoadMap
    sees: float


def _sight_test(
    vector_map: VectorMap, scene_id: int, config: WorldConfig, warp: Warp | None, mirror: bool
) -> Visible | None:
    """Return how well drivers see a board at a place, for boards placed by that (site "clear"); None for other sites.

    It is judged on the map as shown, bent and mirrored, because that determines the trees.
    """
    if config.markers.site != "clear":
        return None
    shown = vector_map if warp is None else warped_map(vector_map, warp)
    seen = visible_places(mirrored_map(shown) if mirror else shown, scene_id, config.markers.size, on_left=mirror)

    def visible(place: Float[np.ndarray, "3"], heading: float) -> float:
        if warp is not None:
            place, heading = warp.moved(place), float(warp.turned(place[:2], np.asarray(heading)))
        return seen(place * [1.0, -1.0, 1.0], -heading) if mirror else seen(place, heading)

    return visible


def simulate(
    scene_id: int, config: WorldConfig = WorldConfig(), history: int = HISTORY, place: Place | None = None
) -> Log:
    """Return the scene with this number (not negative).

    Key frames are spread over the frames before the ego vehicle comes to the end of the roads. On a recorded map, it is
    those in which the map is complete around it; where it has left-hand traffic, the scene is simulated on its mirror
    image and mirrored back.

    Args:
        scene_id: its number.
        config: the world.
        history: frames before the first key frame.
        place: a recorded map; None generates roads.

    Raises UserError if the scene is too short for its key frames, if its drive comes to the end of the roads too soon,
    or if the severity is not between 0 and 1.
    """
    frames = config.frames
    if not 0.0 <= config.severity <= 1.0:
        raise UserError(f"severity must be between 0 and 1, not {config.severity}")
    if config.keyframes > max(frames - history, 0):
        raise UserError(
            f"{config.keyframes} key frames with {history} frames of history each do not fit in the {frames} frames of "
            f"{config.duration_s} s at {config.rate_hz} Hz: raise duration_s or lower keyframes"
        )
    mirror = _stream(scene_id, Stream.MIRROR).random() < config.mirrored
    warp = None if config.warp is None else config.warp.draw(_stream(scene_id, Stream.WARP))
    if place is not None:
        road_map, is_mirror_image = _driven_on_right(place.road_map)
        if is_mirror_image:
            mirror = not mirror
        place = Place(road_map, place.sees if warp is None else place.sees / warp.least_scale)
    density = 0.8 + 0.4 * config.severity
    amounts = replace(config.traffic, vehicles_per_metre=density * config.traffic.vehicles_per_metre)
    if place is None:
        network, traffic, eligible = _drive(scene_id, config, amounts, history)
    else:
        network, traffic, eligible = _drive_on(place, scene_id, config, amounts, history)
    moments = eligible[_spaced(traffic.ego[eligible, :2], config)]
    global_from_ego = yaw_pose(*traffic.ego.T)
    actors = _in_ego_frames(traffic)
    tracks = track(
        _stream(scene_id, Stream.TRACKER),
        actors,
        global_from_ego,
        network.map.buildings,
        config.tracker.with_noise(0.7 + 0.6 * config.severity),
        rate_hz=config.rate_hz,
    )
    weather, paint_wear = np.clip(config.severity * _stream(scene_id, Stream.CONDITIONS).uniform(0.4, 1.6, 2), 0.0, 1.0)
    attribute = element_states(network, traffic.signals, np.arange(frames) / config.rate_hz)
    timestamps = np.round(np.arange(frames) * (1e9 / config.rate_hz)).astype(np.int64)
    log = Log(
        name=f"world-{scene_id:09d}" if place is None else f"{place.road_map.name}-{scene_id:09d}",
        source="procedural",
        map=replace(network.map, elements=show_signals(network, attribute[0])),
        timestamps_ns=timestamps,
        global_from_ego=global_from_ego,
        tracks=tracks,
        actors=actors,
        keyframes=tuple(KeyFrame(int(timestamps[f]), global_from_ego[f], int(f)) for f in moments),
        element_attribute=attribute,
        weather=float(weather),
        paint_wear=float(paint_wear),
        seed=scene_id,
        markers=place_markers(
            network.map,
            scene_id,
            config.markers,
            _sight_test(network.map, scene_id, config, warp, mirror),
            global_from_ego,
        ),
    )
    return _shown(log, scene_id, config, warp, mirror)


def _shown(log: Log, scene_id: int, config: WorldConfig, warp: Warp | None, mirror: bool) -> Log:
    """Return a scene, simulated level and with right-hand traffic, bent, mirrored, turned and raised as configured."""
    log = log if warp is None else warped(log, warp)
    log = mirrored(log) if mirror else log
    if config.view_turn > 0.0:
        stream = _stream(scene_id, Stream.VIEW)
        degrees = stream.uniform(-config.view_turn, config.view_turn)
        if stream.random() < config.view_turned:
            log = turned_view(log, math.radians(degrees))
    if config.terrain is not None:
        log = on_terrain(log, config.terrain.draw(_stream(scene_id, Stream.TERRAIN)))
    return log


@functools.lru_cache(maxsize=64)
def _driven_on_right(road_map: RoadMap) -> tuple[RoadMap, bool]:
    """Return a map whose traffic keeps to the right, and whether it is the mirror image of the given one."""
    return (mirrored_road_map(road_map), True) if drives_on_left(road_map.map) else (road_map, False)


def _drive(
    scene_id: int, config: WorldConfig, amounts: TrafficConfig, history: int
) -> tuple[RoadNetwork, Traffic, Int[np.ndarray, " k"]]:
    """Return the roads and the traffic of a scene on generated roads, and the frames that may become key frames.

    Of a drive that comes to the end of the roads, these are the frames on its route, beyond which an example may see
    the border of the map; all frames before the end if those are too few; and if these are too few, it is drawn again.

    Raises UserError if no drive is long enough.
    """
    network = build_road_network(_stream(scene_id, Stream.ROADS), config.roads)
    for attempt in range(_DRIVES):
        traffic = _traffic(scene_id, attempt, network, amounts, config, history)
        on_roads, on_route = (np.arange(history, end) for end in (traffic.on_roads, traffic.on_route))
        if traffic.on_roads < config.frames and len(on_route) >= _needed(config, history):
            return network, traffic, on_route
        if len(on_roads) >= _needed(config, history):
            return network, traffic, on_roads
    raise UserError(
        f"the roads of scene {scene_id} are too short: in {_DRIVES} drives, the vehicle was at their end before "
        f"{config.keyframes} key frames with {history} frames ({history / config.rate_hz:g} s) of history. Raise "
        "roads.reach and roads.ego_reach, or rate_hz, or lower duration_s or traffic.ego_top_speed"
    )


def _needed(config: WorldConfig, history: int) -> int:
    """Return how many frames a drive must offer for key frames."""
    return min(config.keyframes * _LEAST_STEP, config.frames - history)


def _drive_on(
    place: Place, scene_id: int, config: WorldConfig, amounts: TrafficConfig, history: int
) -> tuple[RoadNetwork, Traffic, Int[np.ndarray, " k"]]:
    """Return the roads and the traffic of a scene on a recorded map, and the frames that may become key frames.

    A drive that leaves the complete part of the map too soon is drawn again.

    Raises UserError if no drive stays there long enough.
    """
    passes = amounts.ego_passes_s
    if passes is None:
        passes = 0.5 * (history / config.rate_hz + config.duration_s + config.longer_s)
    amounts = replace(amounts, ego_passes_s=passes)
    needed = _needed(config, history)
    for attempt in range(_DRIVES):
        network = build_map_network(
            np.random.default_rng([ROOT, scene_id, Stream.ROADS, attempt]),
            place.road_map,
            config.roads,
            sees=place.sees,
            leads_s=passes + EGO_JOINS,
        )
        traffic = _traffic(scene_id, attempt, network, amounts, config, history)
        assert network.drive is not None
        complete = history + np.flatnonzero(network.drive.covers(traffic.ego[history : traffic.on_roads, :2]))
        if len(complete) >= needed:
            return network, traffic, complete
    raise UserError(
        f"{place.road_map.source} {place.road_map.name} is too small a map: in {_DRIVES} drives, no {needed} frames "
        f"saw {place.sees:.0f} m of it in every direction. Leave it out (data.without), or perceive a smaller range"
        f"{' or bend it less (world.warp)' if config.warp is not None else ''}"
    )


def _traffic(
    scene_id: int, attempt: int, network: RoadNetwork, amounts: TrafficConfig, config: WorldConfig, history: int
) -> Traffic:
    """Return the traffic that a scene shows: of a drive that is longer, an excerpt.

    The streams of attempt 0 are those of `_stream`.
    """
    longer = round(config.longer_s * config.rate_hz)
    drive = np.random.default_rng([ROOT, scene_id, Stream.TRAFFIC, attempt])
    traffic = simulate_traffic(drive, network, amounts, frames=config.frames + longer, rate_hz=config.rate_hz)
    if not longer:
        return traffic
    cut = np.random.default_rng([ROOT, scene_id, Stream.EXCERPT, attempt])
    return excerpt(cut, network.traffic_lanes, traffic, frames=config.frames, history=history, rate_hz=config.rate_hz)


def _spaced(xy: Float[np.ndarray, "n 2"], config: WorldConfig) -> Int[np.ndarray, " k"]:
    """Return indices of `config.keyframes` of n places, in order, evenly spaced as configured; none twice."""
    count = config.keyframes
    if config.keyframe_spacing == "time" or count == 1:
        return np.linspace(0, len(xy) - 1, count).round().astype(int)
    # Time counts a little, for vehicles that stand.
    way = np.cumsum(np.linalg.norm(np.diff(xy, axis=0, prepend=xy[:1]), axis=-1) + _CREEP)
    found = np.searchsorted(way, np.linspace(way[0], way[-1], count))
    number = np.arange(count)
    return np.minimum(np.maximum.accumulate(found - number) + number, len(xy) - count + number)


def _stream(scene_id: int, stream: Stream) -> np.random.Generator:
    return np.random.default_rng([ROOT, scene_id, stream])


def _in_ego_frames(traffic: Traffic) -> Tracks:
    """Return the truth with each frame's boxes in that frame's ego frame, whose origin is on the ground."""
    x, y, heading = traffic.ego.T
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    dx, dy = traffic.xy[..., 0] - x[:, None], traffic.xy[..., 1] - y[:, None]
    up: Float[np.ndarray, "f n"] = np.broadcast_to(0.5 * traffic.size[:, 2], dx.shape)
    position = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, up], -1)
    position[~traffic.present] = 0.0
    return Tracks(
        position=position,
        yaw=np.where(traffic.present, wrap_outside(traffic.yaw - heading[:, None]), 0.0),
        size=traffic.size,
        category=traffic.category,
        occluded=np.zeros(traffic.present.shape, bool),
        valid=traffic.present,
        uuid=np.array([f"actor-{i:03d}" for i in range(len(traffic.size))], dtype="<U16"),
    )

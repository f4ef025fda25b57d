"""A scene of the built-in world from its number: roads, traffic, tracker -> `Log`.

Random draws come from streams `np.random.default_rng([ROOT, scene id, stream])`: a scene is the same on any machine,
and a change of one part (for example the tracker) does not change the others.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import yaw_pose
from tflane_jax.scene.logs import KeyFrame, Log, Tracks
from tflane_jax.world.roads.markers import PlacementConfig, place_markers
from tflane_jax.world.roads.networks import RoadConfig, build_road_network
from tflane_jax.world.traffic.signals import element_states, show_signals
from tflane_jax.world.traffic.simulation import Traffic, TrafficConfig, simulate_traffic
from tflane_jax.world.traffic.tracker import TrackerConfig, track, wrap_angle

ROOT = 20_250_711
# Frames that a scene has before its first key frame, unless its examples look back farther.
HISTORY = 20


class Stream(enum.IntEnum):
    """The random streams of a scene."""

    ROADS = 0
    TRAFFIC = 1
    TRACKER = 2
    CONDITIONS = 3


@dataclass(frozen=True)
class WorldConfig:
    """The built-in world.

    Attributes:
        roads, traffic, tracker: its parts.
        markers: placement of fiducial markers. They change nothing else in a scene.
        severity: 0 (clear) to 1 (worst): scales weather and paint wear and, weakly, traffic density and tracker
            noise.
        duration_s, rate_hz: length of a scene and its frame rate.
        keyframes: moments at which examples are made, evenly spaced from the end of the first history to the end of
            the scene.
    """

    roads: RoadConfig = RoadConfig()
    traffic: TrafficConfig = TrafficConfig()
    tracker: TrackerConfig = TrackerConfig()
    markers: PlacementConfig = PlacementConfig()
    severity: float = 0.5
    duration_s: float = 8.0
    rate_hz: float = 10.0
    keyframes: int = 4

    @property
    def frames(self) -> int:
        """Number of frames of a scene."""
        return round(self.duration_s * self.rate_hz)


def simulate(scene_id: int, config: WorldConfig = WorldConfig(), history: int = HISTORY) -> Log:
    """Return the scene with this number (not negative).

    Args:
        scene_id: its number.
        config: the world.
        history: frames before the first key frame.

    Raises UserError if the scene is too short for its key frames or the severity is not between 0 and 1.
    """
    frames = config.frames
    if not 0.0 <= config.severity <= 1.0:
        raise UserError(f"severity must be between 0 and 1, not {config.severity}")
    if config.keyframes > max(frames - history, 0):
        raise UserError(
            f"{config.keyframes} key frames with {history} frames of history each do not fit in the {frames} frames of "
            f"{config.duration_s} s at {config.rate_hz} Hz: raise duration_s or lower keyframes"
        )
    network = build_road_network(_stream(scene_id, Stream.ROADS), config.roads)
    density = 0.8 + 0.4 * config.severity
    traffic = simulate_traffic(
        _stream(scene_id, Stream.TRAFFIC),
        network,
        replace(config.traffic, vehicles_per_metre=density * config.traffic.vehicles_per_metre),
        frames=frames,
        rate_hz=config.rate_hz,
    )
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
    return Log(
        name=f"world-{scene_id:09d}",
        source="procedural",
        map=replace(network.map, elements=show_signals(network, attribute[0])),
        timestamps_ns=timestamps,
        global_from_ego=global_from_ego,
        tracks=tracks,
        actors=actors,
        keyframes=tuple(
            KeyFrame(int(timestamps[f]), global_from_ego[f], int(f))
            for f in np.linspace(history, frames - 1, config.keyframes).round().astype(int)
        ),
        element_attribute=attribute,
        weather=float(weather),
        paint_wear=float(paint_wear),
        seed=scene_id,
        markers=place_markers(network.map, scene_id, config.markers),
    )


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
        yaw=np.where(traffic.present, wrap_angle(traffic.yaw - heading[:, None]), 0.0),
        size=traffic.size,
        category=traffic.category,
        occluded=np.zeros(traffic.present.shape, bool),
        valid=traffic.present,
        uuid=np.array([f"actor-{i:03d}" for i in range(len(traffic.size))], dtype="<U16"),
    )

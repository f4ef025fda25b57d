"""The marker prior at a log's key frames: its markers, their store of lanes, and detections, simulated or of images."""

from __future__ import annotations

import datetime
import warnings

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.prepared_map import prepare_map
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, relative_pose
from tflane_jax.markers.detection import DetectedMarkers
from tflane_jax.markers.observe import Detected, observe
from tflane_jax.markers.pixels import PixelConfig, detect_in_world
from tflane_jax.markers.simulation import MarkerConfig, moment_before, simulate_detections
from tflane_jax.markers.store import MarkerStore, store_of
from tflane_jax.recent import KeptWith
from tflane_jax.scene import MarkerObservations
from tflane_jax.scene.logs import KeyFrame, Log, PlacedMarkers
from tflane_jax.world.cameras.ring import CameraRigConfig
from tflane_jax.world.mirror import markers_beside
from tflane_jax.world.roads.markers import PlacementConfig

# Detections in images by log, track frame and settings: key frames are also the earlier moment of later ones.
_DETECTED: KeptWith[DetectedMarkers] = KeptWith()
_REMEMBERED: KeptWith[tuple[PlacedMarkers, MarkerStore]] = KeptWith()


def markers_of(log: Log) -> PlacedMarkers:
    """Return the markers of a log; real logs have none and get virtual ones (marker paper, section IV-A)."""
    return markers_beside(log.map, log.seed, PlacementConfig()) if log.markers is None else log.markers


def store_of_log(
    log: Log,
    *,
    radius: float,
    bike_lanes: bool,
    surveyed: datetime.date | None = None,
    expires: datetime.date | None = None,
) -> MarkerStore:
    """Return the store of a log's markers: merged centerlines within `radius` metres of each.

    Args:
        log: of the built-in world, or real.
        radius: of the circle around each marker, metres.
        bike_lanes: whether to keep bicycle lanes.
        surveyed, expires: dates written to all entries.
    """
    lanes = prepare_map(log.map, bike_lanes=bike_lanes).centerlines.lanes
    return store_of(
        {lane.id: lane for lane in lanes},
        markers_of(log),
        radius=radius,
        surveyed=surveyed,
        expires=expires,
        source=log.name,
    )


def _remembered(log: Log, radius: float, bike_lanes: bool) -> tuple[PlacedMarkers, MarkerStore]:
    """Return the markers of a log and their store, made once for all its frames. Threads may call it."""

    def make() -> tuple[PlacedMarkers, MarkerStore]:
        return markers_of(log), store_of_log(log, radius=radius, bike_lanes=bike_lanes)

    return _REMEMBERED(log, (radius, bike_lanes), make)


def _detected(
    log: Log, moment: KeyFrame, markers: PlacedMarkers, rig: CameraRigConfig, config: PixelConfig
) -> DetectedMarkers:
    """Return the detections in the images of a moment, made once."""
    key = moment.track_frame, rig, config
    return _DETECTED(log, key, lambda: detect_in_world(log, moment, markers, rig, config))


def marker_observations(
    log: Log,
    keyframe: int,
    config: MarkerConfig,
    range_: PerceptionRange,
    *,
    bike_lanes: bool,
    cameras: CameraRigConfig | None = None,
) -> MarkerObservations:
    """Return the detected markers with their lanes from the store at a key frame.

    Detections are simulated, or found in native images of `cameras` (`MarkerConfig.pixels`). Warns
    (`TruncationWarning`) if more markers or lanes are in range than a capacity.
    """
    if log.relief is not None:
        raise UserError(
            "fiducial markers are simulated on level ground only: set data.world.terrain to None, or leave out "
            "data.example.markers"
        )
    simulation, (markers, store) = config.simulation, _remembered(log, config.radius, bike_lanes)
    moment, before = log.keyframes[keyframe], moment_before(log, keyframe, simulation.residual_interval)

    def detected(then: KeyFrame) -> Detected:
        if config.pixels is None:
            return simulate_detections(log, then, markers, simulation)
        return _detected(log, then, markers, config.pixels.native(cameras), config.pixels)

    return observations(
        detected(moment),
        store,
        config,
        range_,
        previous=None if before is None else detected(before),
        now_from_previous=None if before is None else relative_pose(moment.global_from_ego, before.global_from_ego),
    )


def observations(
    detected: Detected,
    store: MarkerStore,
    config: MarkerConfig,
    range_: PerceptionRange,
    *,
    previous: Detected | None,
    now_from_previous: Float[np.ndarray, "4 4"] | None,
) -> MarkerObservations:
    """Return detections with their lanes from the store, at the capacities of a configuration; see `observe`.

    Warns (`TruncationWarning`) if more markers or lanes are in range than a capacity.
    """
    observed = observe(
        detected,
        store,
        range_,
        markers=config.markers,
        lanes=config.lanes,
        points=config.points,
        first_residual=config.simulation.first_residual,
        previous=previous,
        now_from_previous=now_from_previous,
    )
    for name, dropped in (("markers", observed.markers_dropped), ("lanes", observed.lanes_dropped)):
        if dropped:
            warnings.warn(
                f"more {name} in range than MarkerConfig.{name} = {getattr(config, name)}: the farthest are left out",
                TruncationWarning,
                stacklevel=4,
            )
    return observed.markers

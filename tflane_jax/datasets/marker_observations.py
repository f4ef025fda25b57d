"""The marker prior at a log's key frames: its markers, their store of lanes, and simulated detections."""

from __future__ import annotations

import datetime
import warnings
import weakref

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.prepared_map import prepare_map
from tflane_jax.geometry import PerceptionRange, relative_pose
from tflane_jax.markers.observe import observe
from tflane_jax.markers.simulation import MarkerConfig, moment_before, simulate_detections
from tflane_jax.markers.store import MarkerStore, store_of
from tflane_jax.scene import MarkerObservations
from tflane_jax.scene.logs import Log, PlacedMarkers
from tflane_jax.world.roads.markers import place_markers

_REMEMBERED: dict[tuple[int, float, bool], tuple[PlacedMarkers, MarkerStore]] = {}


def markers_of(log: Log) -> PlacedMarkers:
    """Return the markers of a log; real logs have none and get virtual ones (marker paper, section IV-A)."""
    return place_markers(log.map, log.seed) if log.markers is None else log.markers


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
    """Return the markers of a log and their store, made once for all its frames."""
    key = (id(log), radius, bike_lanes)
    if key not in _REMEMBERED:
        _REMEMBERED[key] = markers_of(log), store_of_log(log, radius=radius, bike_lanes=bike_lanes)
        weakref.finalize(log, _REMEMBERED.pop, key)
    return _REMEMBERED[key]


def marker_observations(
    log: Log, keyframe: int, config: MarkerConfig, range_: PerceptionRange, *, bike_lanes: bool
) -> MarkerObservations:
    """Return the detected markers with their lanes from the store at a key frame; detections are simulated.

    Warns (`TruncationWarning`) if more markers or lanes are in range than a capacity.
    """
    simulation, (markers, store) = config.simulation, _remembered(log, config.radius, bike_lanes)
    moment, before = log.keyframes[keyframe], moment_before(log, keyframe, simulation.residual_interval)
    observed = observe(
        simulate_detections(log, moment, markers, simulation),
        store,
        range_,
        markers=config.markers,
        lanes=config.lanes,
        points=config.points,
        first_residual=simulation.first_residual,
        previous=None if before is None else simulate_detections(log, before, markers, simulation),
        now_from_previous=None if before is None else relative_pose(moment.global_from_ego, before.global_from_ego),
    )
    for name, dropped in (("markers", observed.markers_dropped), ("lanes", observed.lanes_dropped)):
        if dropped:
            warnings.warn(
                f"more {name} in range than MarkerConfig.{name} = {getattr(config, name)}: the farthest are left out",
                TruncationWarning,
                stacklevel=3,
            )
    return observed.markers

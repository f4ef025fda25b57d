"""One key frame of a `Log` -> `Example`: sensor evidence, priors and ground truth."""

from __future__ import annotations

import warnings
from functools import partial
from operator import attrgetter

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.datasets.areas import crop_areas
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.ground_truth import lane_graph, traffic_elements
from tflane_jax.datasets.map_lines import crop_map_lines
from tflane_jax.datasets.marker_observations import marker_observations
from tflane_jax.datasets.prepared_map import PreparedMap, prepare_map
from tflane_jax.geometry import (
    PerceptionRange,
    invert_pose,
    pose_yaw,
    relative_pose,
    transform_points,
    wrap_angle,
    yaw_pose,
)
from tflane_jax.scene import Example, MarkerObservations, TrafficFlow
from tflane_jax.scene.logs import Log, Tracks
from tflane_jax.world.bev.sensor import BevSensorConfig, hidden_cells, render_bev
from tflane_jax.world.cameras.moment import attributes_at
from tflane_jax.world.cameras.sensor import render_cameras, visible_elements
from tflane_jax.world.roads.sd_map import make_sd_map


def traffic_flow(
    log: Log, keyframe: int, *, history: int, capacity: int, stride: int = 1, region: PerceptionRange | None = None
) -> tuple[TrafficFlow, int]:
    """Return the tracks in `history` frames before the key frame, and how many exceeded the capacity.

    The frames are `stride` track frames apart, the latest one `stride` before the key frame. The log holds each frame's
    boxes in the ego frame of that frame; TF-Lane Eq. (1) moves them into the ego frame of the key frame. Where the log
    starts later, the first frames of the result are invalid. Of more instances than `capacity`, those whose nearest
    position is farthest are left out. Logs reach farther than models see: with `region`, only those are counted that
    were inside it (x and y, ego frame of the key frame).
    """
    moment, tracks = log.keyframes[keyframe], log.tracks
    frames = np.arange(moment.track_frame - history * stride, moment.track_frame, stride)
    frames = frames[frames >= 0]
    flow = TrafficFlow.empty(capacity, history)
    found = np.flatnonzero(tracks.valid[frames].any(0))
    if not len(found):
        return flow, 0
    position, yaw = _moved(tracks, frames, found, log.global_from_ego, moment.global_from_ego)
    valid = tracks.valid[frames[:, None], found]
    distance = np.where(valid, np.linalg.norm(position[..., :2], axis=-1), np.inf).min(0)
    nearest = np.argsort(distance, kind="stable")
    kept, beyond = np.sort(nearest[:capacity]), nearest[capacity:]
    if region is not None:
        beyond = beyond[(valid & region.contains(position[..., :2]))[:, beyond].any(0)]
    n, rows = len(kept), found[kept]
    window = slice(history - len(frames), history)
    flow.position[:n, window] = position[:, kept].swapaxes(0, 1)
    flow.yaw[:n, window] = yaw[:, kept].T
    flow.size[:n] = tracks.size[rows]
    flow.category[:n] = tracks.category[rows]
    flow.occluded[:n, window] = tracks.occluded[frames[:, None], rows].T
    flow.valid[:n, window] = valid[:, kept].T
    return flow, len(beyond)


def occluder_boxes(log: Log, keyframe: int) -> Float[np.ndarray, "k 7"]:
    """Return every actor at the key frame as rows x, y, length, width, yaw, height, base_z = 0, ego frame.

    The boxes are put on flat ground, on which line of sight is tested, whatever the slope of the real road.
    """
    moment, actors = log.keyframes[keyframe], log.actors
    present = np.flatnonzero(actors.valid[moment.track_frame])
    frames = np.array([moment.track_frame])
    position, yaw = _moved(actors, frames, present, log.global_from_ego, moment.global_from_ego)
    length, width, height = actors.size[present].T
    return np.stack([*position[0, :, :2].T, length, width, yaw[0], height, np.zeros(len(present))], -1)


def _moved(
    tracks: Tracks, frames: np.ndarray, rows: np.ndarray, poses: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (F, K, 3) and yaws (F, K) of tracks `rows` in `frames`, in the ego frame of pose `target`."""
    target_from_frame = relative_pose(target, poses[frames])  # Eq. (1)
    position = transform_points(target_from_frame, tracks.position[frames[:, None], rows])
    yaw = tracks.yaw[frames[:, None], rows] + pose_yaw(target_from_frame)[:, None]
    return position, wrap_angle(yaw)


def make_example(log: Log, keyframe: int, config: ExampleConfig) -> Example:
    """Return the example of one key frame: numpy arrays of the sizes in `config`, no batch axis.

    The traffic flow is empty at the first frame of a log and in a log without road users. Warns (`TruncationWarning`)
    if more is in range than a capacity. Raises UserError if the configured cameras can make no images.
    """
    moment = log.keyframes[keyframe]
    ego_from_global = invert_pose(moment.global_from_ego)
    prepared = prepare_map(log.map, bike_lanes=config.bike_lanes == "include")
    boxes = occluder_boxes(log, keyframe)
    buildings = _buildings(log, ego_from_global)
    rig = config.cameras
    bev, hidden = _bev(log, keyframe, config.sensor, prepared, ego_from_global, boxes, buildings)
    crop = partial(lane_graph, ego_from_global=ego_from_global, range_=config.range, boxes=boxes, buildings=buildings)
    lanes = crop(prepared.centerlines, capacity=config.lanes, points=config.lane_points)
    segments = crop(prepared.segments, capacity=config.segments, points=config.segment_points)
    areas, areas_dropped = crop_areas(
        prepared,
        ego_from_global,
        config.range,
        capacity=config.areas,
        points=config.area_points,
        crossings=config.crossings,
    )
    map_lines, map_lines_dropped = None, 0
    if config.map_lines is not None:
        map_lines, map_lines_dropped = crop_map_lines(
            prepared.geometry, ego_from_global, config.range, config.map_lines, boxes=boxes, buildings=buildings
        )
    governed, number_of = segments, prepared.segment_of
    if config.elements_of == "centerlines":
        governed, number_of = lanes, prepared.chain_of
    elements, elements_dropped = traffic_elements(
        log.map.elements,
        attributes_at(log, keyframe),
        number_of,
        governed,
        ego_from_global,
        config.range,
        capacity=config.elements,
        of=config.elements_of,
        seen=None if rig is None else visible_elements(log, keyframe, rig),
    )
    stride = 1 if log.rate_hz is None else config.history_stride(log.rate_hz)
    flow, tracks_dropped = traffic_flow(
        log, keyframe, history=config.history, capacity=config.tracks, stride=stride, region=config.ground
    )
    sd_map, sd_lines_dropped = None, 0
    if config.sd_map is not None:
        sd_map, sd_lines_dropped = make_sd_map(log, keyframe, config.sd_map)
    warn_dropped(
        config,
        lanes=lanes.dropped,
        segments=segments.dropped,
        areas=areas_dropped,
        elements=elements_dropped,
        tracks=tracks_dropped,
        **{"sd_map.lines": sd_lines_dropped, "map_lines.lines": map_lines_dropped},
    )
    previous = log.keyframes[keyframe - 1] if keyframe > 0 else moment
    return Example(
        bev=bev,
        hidden=hidden,
        traffic_flow=flow,
        markers=_markers(log, keyframe, config),
        sd_map=sd_map,
        lanes=lanes.graph,
        segments=segments.graph,
        areas=areas,
        traffic_elements=elements,
        previous_from_ego=relative_pose(previous.global_from_ego, moment.global_from_ego).astype(np.float32),
        has_previous=np.asarray(keyframe > 0),
        cameras=None if rig is None else render_cameras(log, keyframe, rig),
        map_lines=map_lines,
    )


def _bev(
    log: Log,
    keyframe: int,
    sensor: BevSensorConfig | None,
    prepared: PreparedMap,
    ego_from_global: Float[np.ndarray, "4 4"],
    boxes: Float[np.ndarray, "k 7"],
    buildings: Float[np.ndarray, "b 5"],
) -> tuple[UInt8[np.ndarray, "h w 4"] | None, Bool[np.ndarray, "h w"] | None]:
    """Return the BEV evidence and the cells out of sight; None for both without a sensor."""
    if sensor is None:
        return None, None
    hidden = hidden_cells(sensor.grid, boxes, buildings)
    bev = render_bev(
        prepared.samples,
        ego_from_global,
        boxes,
        buildings,
        hidden,
        weather=log.weather,
        paint_wear=log.paint_wear,
        log_seed=log.seed,
        frame=keyframe,
        config=sensor,
    )
    return bev, hidden


def _markers(log: Log, keyframe: int, config: ExampleConfig) -> MarkerObservations | None:
    """Return what is observed of the markers; None without their configuration."""
    if config.markers is None:
        return None
    bike_lanes, cameras = config.bike_lanes == "include", config.cameras
    return marker_observations(log, keyframe, config.markers, config.range, bike_lanes=bike_lanes, cameras=cameras)


def _buildings(log: Log, ego_from_global: np.ndarray) -> Float[np.ndarray, "b 5"]:
    blocks = log.map.buildings
    pose = ego_from_global @ yaw_pose(blocks[:, 0], blocks[:, 1], blocks[:, 4])
    return np.stack([pose[:, 0, 3], pose[:, 1, 3], blocks[:, 2], blocks[:, 3], pose_yaw(pose)], -1)


def warn_dropped(config: ExampleConfig, **dropped: int) -> None:
    """Warn of each capacity of `config` that was exceeded, by name."""
    for name, count in dropped.items():
        if count:
            # One text for all frames, so that Python's default filter shows it once.
            warnings.warn(
                f"more {name} in range than ExampleConfig.{name} = {attrgetter(name)(config)}: "
                "the farthest are left out",
                TruncationWarning,
                stacklevel=3,
            )

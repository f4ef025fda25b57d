"""Write the tracks and ego poses of logs as nuScenes' tables, without maps and sensor data.

With `openlane_export`, this makes a complete copy of what TF-Lane reads for subset B: OpenLane-V2's frames, and the
scenes of which its segments are parts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tflane_jax.datasets.nuscenes_tables import LIDAR, TABLES
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import replacing
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import Log

CATEGORY = {
    RoadUser.CAR: "vehicle.car",
    RoadUser.TRUCK: "vehicle.truck",
    RoadUser.BUS: "vehicle.bus.rigid",
    RoadUser.MOTORCYCLE: "vehicle.motorcycle",
    RoadUser.BICYCLE: "vehicle.bicycle",
    RoadUser.PEDESTRIAN: "human.pedestrian.adult",
}
"""nuScenes category that stands for each road user."""
_VERSION, _RATE_HZ, _LOCATION = "v1.0-trainval", 2.0, "generated"
_LEVELS = ("v0-40", "v40-60", "v60-80", "v80-100")

Tables = dict[str, list[dict[str, Any]]]


def export_scenes(logs: Iterable[Log], out: Path, time_offset: Callable[[int], int] = lambda _: 0) -> Path:
    """Write logs as the thirteen tables in `<out>/v1.0-trainval`, all or none of them.

    Samples are the key frames and track frames at 2 Hz before each of them. A box that its tracker did not see has no
    lidar points; every other has one. The lidar is at the vehicle's origin.

    Args:
        logs: of all splits; their names become those of the scenes.
        out: folder that does not exist yet or is empty.
        time_offset: of a log's last timestamp -> nanoseconds that are added to all of its timestamps.

    Raises:
        UserError: the folder is not empty or cannot be written.
    """
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f"{out} is not empty: choose another folder")
    tables = _fixed_rows()
    for log in logs:
        _add_scene(tables, log, time_offset(int(log.timestamps_ns[-1])))
    with replacing(out) as writing:
        folder = writing / _VERSION
        folder.mkdir(parents=True)
        for name in TABLES:
            (folder / f"{name}.json").write_text(json.dumps(tables[name]), encoding="utf-8")
    return out


def _fixed_rows() -> Tables:
    """Return the tables with the rows that all scenes share."""
    tables: Tables = {name: [] for name in TABLES}
    tables["category"] = [{"token": name, "name": name} for name in CATEGORY.values()]
    tables["visibility"] = [{"token": str(i), "level": level} for i, level in enumerate(_LEVELS, 1)]
    tables["log"] = [{"token": "log", "location": _LOCATION}]
    tables["map"] = [{"token": "map", "log_tokens": ["log"], "filename": ""}]
    tables["sensor"] = [{"token": LIDAR, "channel": LIDAR, "modality": "lidar"}]
    at_origin = {"translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0], "camera_intrinsic": []}
    tables["calibrated_sensor"] = [{"token": LIDAR, "sensor_token": LIDAR} | at_origin]
    return tables


def _add_scene(tables: Tables, log: Log, offset: int) -> None:
    """Add a log's scene, its samples, poses and boxes to the tables."""
    frames = _sample_frames(log)
    tokens = [f"{log.name}-{frame}" for frame in frames.tolist()]
    around = ["", *tokens, ""]
    ends = {"first_sample_token": tokens[0], "last_sample_token": tokens[-1]}
    tables["scene"].append(
        {"token": log.name, "name": log.name, "log_token": "log", "nbr_samples": len(tokens), **ends}
    )
    for i, (frame, token) in enumerate(zip(frames.tolist(), tokens, strict=True)):
        time = (int(log.timestamps_ns[frame]) + offset) // 1000
        pose = {"token": token, "timestamp": time, **_place(log.global_from_ego[frame])}
        tables["ego_pose"].append(pose)
        links = {"prev": around[i], "next": around[i + 2]}
        tables["sample"].append({"token": token, "timestamp": time, "scene_token": log.name, **links})
        file = {"filename": "", "timestamp": time, "is_key_frame": True, "width": 0, "height": 0}
        tokens_of = {"sample_token": token, "ego_pose_token": token, "calibrated_sensor_token": LIDAR}
        tables["sample_data"].append({"token": token, **tokens_of, **file})
        tables["sample_annotation"] += _boxes(log, frame, token)
    users = np.flatnonzero(log.tracks.valid[frames].any(0)).tolist()
    categories = {k: CATEGORY[RoadUser(int(log.tracks.category[k]))] for k in users}
    tables["instance"] += [{"token": _instance(log, k), "category_token": name} for k, name in categories.items()]


def _sample_frames(log: Log) -> np.ndarray:
    """Return the track frames that become samples: the key frames, 2 Hz before each of them, and after the last."""
    moments = [moment.track_frame for moment in log.keyframes]
    step = max(round((log.rate_hz or _RATE_HZ) / _RATE_HZ), 1)
    frames = [*moments, *range(moments[-1], len(log.timestamps_ns), step)]
    # Key frames need not be whole steps apart: the first step after one may be shorter or longer, by half at most.
    stop = -1
    for moment in moments:
        frames += range(moment, stop, -step)
        stop = moment + step // 2
    return np.unique(frames)


def _boxes(log: Log, frame: int, sample: str) -> list[dict[str, Any]]:
    """Return the boxes of a track frame, in the global frame."""
    tracks, pose, rows = log.tracks, log.global_from_ego[frame], []
    for k in np.flatnonzero(tracks.valid[frame]).tolist():
        box = np.eye(4)
        box[:3, :3] = Rotation.from_euler("z", tracks.yaw[frame, k]).as_matrix()
        box[:3, 3] = tracks.position[frame, k]
        length, width, height = (float(side) for side in tracks.size[k])
        rows.append(
            {
                "token": f"{sample}-{k}",
                "sample_token": sample,
                "instance_token": _instance(log, k),
                "visibility_token": "",
                "size": [width, length, height],
                "num_lidar_pts": 0 if tracks.occluded[frame, k] else 1,
                "num_radar_pts": 0,
                **_place(pose @ box),
            }
        )
    return rows


def _instance(log: Log, track: int) -> str:
    return f"{log.name}-track-{track}"


def _place(pose: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    """Return translation and rotation (w, x, y, z) of a pose."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}

"""Write the tracks and ego poses of logs as Argoverse 2 does, without maps and sensor data.

With `openlane_export`, this makes a complete copy of what TF-Lane reads: OpenLane-V2's frames, and the logs of which
its segments are parts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tflane_jax.datasets.argoverse2_log import ANNOTATIONS
from tflane_jax.datasets.argoverse2_poses import POSES
from tflane_jax.datasets.base import Split
from tflane_jax.errors import UserError, missing_extra
from tflane_jax.files.atomic import replacing
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import Log, Tracks

CATEGORY = {
    RoadUser.CAR: "REGULAR_VEHICLE",
    RoadUser.TRUCK: "BOX_TRUCK",
    RoadUser.BUS: "BUS",
    RoadUser.MOTORCYCLE: "MOTORCYCLE",
    RoadUser.BICYCLE: "BICYCLE",
    RoadUser.PEDESTRIAN: "PEDESTRIAN",
}
"""Argoverse 2 category that stands for each road user."""
# The vehicle itself is a track, as the tools of Argoverse write it: a frame without other road users has a row, too.
_EGO, _EGO_SIZE = "EGO_VEHICLE", (4.9, 1.9, 1.7)


def export_tracks(
    logs: Iterable[tuple[Split, Log]], out: Path, time_offset: Callable[[int], int] = lambda _: 0
) -> Path:
    """Write logs as `<out>/sensor/<split>/<log>/`, all or none of them.

    A box that its tracker did not see has no interior points; every other has one. The vehicle's own has none.

    Args:
        logs: with their splits.
        out: folder that does not exist yet or is empty.
        time_offset: of a log's last timestamp -> nanoseconds that are added to all of its timestamps.

    Raises:
        UserError: the folder is not empty or cannot be written, or pyarrow is missing.
    """
    try:
        import pyarrow
        from pyarrow import feather
    except ImportError as error:
        raise missing_extra("writing Argoverse 2 needs pyarrow", "data") from error
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f"{out} is not empty: choose another folder")
    with replacing(out) as writing:
        writing.mkdir()
        for split, log in logs:
            folder = writing / "sensor" / split / log.name
            folder.mkdir(parents=True)
            offset = time_offset(int(log.timestamps_ns[-1]))
            for name, table in ((ANNOTATIONS, _boxes(log, offset)), (POSES, _poses(log, offset))):
                feather.write_feather(pyarrow.table(table), str(folder / name))
    return out


def _poses(log: Log, offset: int) -> dict[str, np.ndarray]:
    """Return the ego poses at all track and key frames, in time order."""
    moments = [(keyframe.timestamp_ns, keyframe.global_from_ego) for keyframe in log.keyframes]
    moments += zip(log.timestamps_ns.tolist(), log.global_from_ego, strict=True)
    at = dict(moments)
    times = np.array(sorted(at), np.int64)
    poses = np.stack([at[time] for time in times.tolist()])
    x, y, z, w = Rotation.from_matrix(poses[:, :3, :3]).as_quat().T
    return {"timestamp_ns": times + offset, "qw": w, "qx": x, "qy": y, "qz": z} | _places(poses[:, :3, 3])


def _boxes(log: Log, offset: int) -> dict[str, np.ndarray]:
    """Return one row for each valid box and one for the vehicle itself, in the ego frame of its own time."""
    tracks: Tracks = log.tracks
    frame, track = np.nonzero(tracks.valid)
    empty, own = np.zeros(len(log.timestamps_ns)), np.full(len(log.timestamps_ns), _EGO)
    half = np.concatenate([tracks.yaw[frame, track], empty]) / 2.0
    size = np.concatenate([tracks.size[track], np.tile(_EGO_SIZE, (len(own), 1))])
    category = np.array([CATEGORY[RoadUser(kind)] for kind in tracks.category[track].tolist()], str)
    points = np.where(tracks.occluded[frame, track], 0, 1)
    return {
        "timestamp_ns": np.concatenate([log.timestamps_ns[frame], log.timestamps_ns]) + offset,
        "track_uuid": np.concatenate([tracks.uuid[track].astype(str), own]),
        "category": np.concatenate([category, own]),
        "length_m": size[:, 0],
        "width_m": size[:, 1],
        "height_m": size[:, 2],
        "qw": np.cos(half),
        "qx": np.zeros_like(half),
        "qy": np.zeros_like(half),
        "qz": np.sin(half),
        **_places(np.concatenate([tracks.position[frame, track], np.zeros((len(own), 3))])),
        "num_interior_pts": np.concatenate([points, empty]).astype(np.int64),
    }


def _places(position: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(("tx_m", "ty_m", "tz_m"), position.T, strict=True))

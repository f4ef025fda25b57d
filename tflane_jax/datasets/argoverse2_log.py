"""One Argoverse 2 sensor log: annotations, ego poses and the vector map -> `Log`.

`argoverse2_cameras` reads its images; lidar is not read. Two traps of the format: a box is given in the ego frame of
its own timestamp, and the map's predecessor lists are incomplete, so only successors are read. Format:
https://argoverse.github.io/user-guide (sensor dataset; annotations.feather, city_SE3_egovehicle.feather, map/).
"""

from __future__ import annotations

import itertools
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.argoverse2_map import read_map
from tflane_jax.datasets.argoverse2_poses import POSE_COLUMNS, poses_at, poses_of, read_poses
from tflane_jax.datasets.log_frames import LogOutline
from tflane_jax.datasets.openlane_splits import openlane_timestamps
from tflane_jax.datasets.plausible import (
    check_distance,
    check_headings,
    check_interval,
    check_place,
    missing_frames,
)
from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.files.feather_table import Kind, read_columns
from tflane_jax.files.folders import named_folder
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import KeyFrame, Log, Tracks, VectorMap

ANNOTATIONS = "annotations.feather"
_SIZE = ("length_m", "width_m", "height_m")
_BOX_COLUMNS: Mapping[str, Kind] = {
    **POSE_COLUMNS,
    "track_uuid": "text",
    "category": "text",
    **dict.fromkeys(_SIZE, "number"),
    "num_interior_pts": "integer",
}
# Every fifth lidar frame is 2 Hz, the rate of OpenLane-V2.
_FRAMES_PER_KEYFRAME = 5
# Most seconds between a key frame of OpenLane-V2 and the nearest lidar frame; cameras are some 10 ms off.
_NEAR = 0.1
# Seconds without a box after which annotations are not those of one drive.
_QUIET = 600.0

CATEGORIES: Mapping[str, RoadUser | None] = {
    "REGULAR_VEHICLE": RoadUser.CAR,
    "LARGE_VEHICLE": RoadUser.TRUCK,
    "BOX_TRUCK": RoadUser.TRUCK,
    "TRUCK": RoadUser.TRUCK,
    "TRUCK_CAB": RoadUser.TRUCK,
    "VEHICULAR_TRAILER": RoadUser.TRUCK,
    "BUS": RoadUser.BUS,
    "ARTICULATED_BUS": RoadUser.BUS,
    "SCHOOL_BUS": RoadUser.BUS,
    "RAILED_VEHICLE": RoadUser.BUS,
    "MOTORCYCLE": RoadUser.MOTORCYCLE,
    "MOTORCYCLIST": RoadUser.MOTORCYCLE,
    "BICYCLE": RoadUser.BICYCLE,
    "BICYCLIST": RoadUser.BICYCLE,
    "WHEELED_DEVICE": RoadUser.BICYCLE,
    "WHEELED_RIDER": RoadUser.BICYCLE,
    "PEDESTRIAN": RoadUser.PEDESTRIAN,
    "OFFICIAL_SIGNALER": RoadUser.PEDESTRIAN,
    "STROLLER": RoadUser.PEDESTRIAN,
    "WHEELCHAIR": RoadUser.PEDESTRIAN,
    "DOG": RoadUser.PEDESTRIAN,
    "ANIMAL": RoadUser.PEDESTRIAN,
    "BOLLARD": None,
    "SIGN": None,
    "STOP_SIGN": None,
    "CONSTRUCTION_CONE": None,
    "CONSTRUCTION_BARREL": None,
    "MOBILE_PEDESTRIAN_CROSSING_SIGN": None,
    "MOBILE_PEDESTRIAN_SIGN": None,  # the same in the data set's README
    "MESSAGE_BOARD_TRAILER": None,
    "TRAFFIC_LIGHT_TRAILER": None,
    "EGO_VEHICLE": None,
}
"""Road user of each Argoverse 2 category; None is no traffic: street furniture, and the vehicle itself, which the tools
of Argoverse write as a track."""

Keyframes = Literal["openlane_v2", "annotations"]


class _Frames(NamedTuple):
    """Times (nanoseconds) and poses of all frames of a log, and its key frames."""

    times_ns: Int[np.ndarray, " f"]
    global_from_ego: Float[np.ndarray, "f 4 4"]
    keyframes: tuple[KeyFrame, ...]


def load_log(
    folder: Path,
    *,
    keyframes: Keyframes = "openlane_v2",
    openlane: Path | None = None,
    categories: Mapping[str, RoadUser | None] = CATEGORIES,
    with_map: bool = True,
) -> Log:
    """Read one log folder.

    Args:
        folder: holds annotations.feather, city_SE3_egovehicle.feather and map/.
        keyframes: "openlane_v2" takes the 2 Hz frames of OpenLane-V2, "annotations" every annotated frame (10 Hz).
        openlane: folder of the OpenLane-V2 split files, which hold the exact timestamps (of the front camera). Without
            it, or for a log that is not in them, "openlane_v2" takes every fifth frame. Those without annotations
            near them are left out, with a warning.
        categories: road user of each category, None to leave it out.
        with_map: False leaves the map empty, for tracks alone.

    Raises:
        UserError: a file is missing or unreadable, lacks a column, or holds no frame.
    """
    folder = Path(folder)
    boxes = _read_boxes(folder / ANNOTATIONS)
    frames = _drive(folder, boxes["timestamp_ns"], keyframes, openlane)
    tracks = _tracks(boxes, frames.times_ns, categories, folder)
    check_headings(tracks, frames.global_from_ego, frames.times_ns, str(folder / ANNOTATIONS))
    city = VectorMap({})
    if with_map:
        city = read_map(folder / "map")
        lanes = [lane.centerline for lane in city.segments.values()]
        check_place(lanes, frames.global_from_ego[:, :2, 3], f"{folder} and its map")
    return Log(
        name=folder.name,
        source="argoverse2",
        map=city,
        timestamps_ns=frames.times_ns,
        global_from_ego=frames.global_from_ego,
        tracks=tracks,
        actors=tracks,
        keyframes=frames.keyframes,
        seed=zlib.crc32(folder.name.encode()),
        area=city_of(folder),
    )


def log_outline(folder: Path, keyframes: Keyframes = "openlane_v2", openlane: Path | None = None) -> LogOutline:
    """Return the key frames of a log as `load_log` does, without reading boxes and map; raises UserError like it."""
    times = read_columns(folder / ANNOTATIONS, {"timestamp_ns": "integer"})["timestamp_ns"]
    return LogOutline(folder.name, "argoverse2", city_of(folder), _drive(folder, times, keyframes, openlane).keyframes)


def _drive(folder: Path, box_times: Int[np.ndarray, " n"], keyframes: Keyframes, openlane: Path | None) -> _Frames:
    """Return the frames of a log, given the times of all boxes."""
    pose_times, poses = read_poses(folder)
    annotated = np.unique(box_times)
    if len(annotated) == 0:
        raise UserError(
            f"{folder / ANNOTATIONS} holds no annotated frame (the test split has none): use a train or val log"
        )
    check_interval(annotated, "nanoseconds", str(folder / ANNOTATIONS))
    poses_at(annotated, pose_times, poses, folder)  # raises where an annotated frame has no pose of its own time
    # Frames without a box have no time of their own: each takes that of a pose, as annotated ones have it.
    times = np.unique(pose_times[_nearest(pose_times, _with_empty_frames(annotated, folder))])
    key_times = annotated if keyframes == "annotations" else times[::_FRAMES_PER_KEYFRAME]
    if keyframes == "openlane_v2" and openlane is not None:
        key_times = _annotated(openlane_timestamps(openlane).get(folder.name, key_times), times, folder)
    key_poses = poses_at(key_times, pose_times, poses, folder)
    found = zip(key_times, key_poses, _nearest(times, key_times), strict=True)
    return _Frames(
        times,
        poses[_nearest(pose_times, times)],
        tuple(KeyFrame(int(time), pose, int(frame)) for time, pose, frame in found),
    )


def _annotated(key_times: np.ndarray, times: np.ndarray, folder: Path) -> np.ndarray:
    """Return the times that have an annotated frame near them; warn of others, which a file cut short may lack."""
    near = np.abs(times[_nearest(times, key_times)] - key_times) <= _NEAR * 1e9
    if not near.any():
        raise UserError(
            f"{folder / ANNOTATIONS}: no key frame of OpenLane-V2 has an annotated frame within {_NEAR:g} s: download "
            "the file again, or take the log out"
        )
    if not near.all():
        message = (
            f"{folder / ANNOTATIONS}: {(~near).sum()} of {len(near)} key frames have no annotated frame within "
            f"{_NEAR:g} s and are left out; if the log has road users there, download the file again"
        )
        warnings.warn(message, LeftOutWarning, stacklevel=2)
    return key_times[near]


def city_of(folder: Path) -> str:
    """Return the city of a log, which the name of its map file tells; "" without it."""
    names = sorted((folder / "map").glob("log_map_archive_*____*_city_*.json"))
    return names[0].stem.split("____")[1].split("_")[0] if names else ""


def _read_boxes(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the boxes; raise UserError for boxes that cannot be."""
    boxes = read_columns(path, _BOX_COLUMNS)
    for name in _SIZE:
        if (flat := boxes[name] <= 0.0).any():
            row = int(flat.argmax())
            raise UserError(f"{path}: column {name} holds {boxes[name][row]:g} in row {row}: a box has an extent")
    keys, count = np.unique(
        np.stack([boxes["timestamp_ns"].astype(str), boxes["track_uuid"]], -1), axis=0, return_counts=True
    )
    if (count > 1).any():
        time, track = keys[(count > 1).argmax()]
        raise UserError(f"{path} has track {track} twice at {time}: download it again")
    place = np.stack([boxes[name] for name in ("tx_m", "ty_m", "tz_m")], -1)
    check_distance(place, [f"{path}: row {row}" for row in range(len(place))])
    return boxes


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the row of the nearest of ascending times for each wanted one; the earlier of two that are as near."""
    after = np.searchsorted(times, wanted).clip(1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    return np.where(times[after] - wanted < wanted - times[before], after, before)


def _with_empty_frames(annotated: np.ndarray, folder: Path) -> np.ndarray:
    """Return the times of all frames: annotated ones, and those between them in which there was no box at all.

    The file has no row of such a frame. History counts frames, so that what was seen before a quiet stretch would move
    up to the present. Raises UserError for a stretch that is too long to be one.
    """
    steps = np.diff(annotated)
    if not len(steps):
        return annotated
    if steps.max() > _QUIET * 1e9:
        raise UserError(
            f"{folder / ANNOTATIONS} has no box for {steps.max() / 1e9:.0f} s after {annotated[steps.argmax()]}: are "
            "these several logs?"
        )
    missing = missing_frames(annotated)
    between = [
        annotated[i] + steps[i] * np.arange(1, missing[i] + 1) // (missing[i] + 1) for i in np.flatnonzero(missing > 0)
    ]
    return np.sort(np.concatenate([annotated, *between]))


def _tracks(
    boxes: dict[str, Any], times: np.ndarray, categories: Mapping[str, RoadUser | None], folder: Path
) -> Tracks:
    names, category_row = np.unique(boxes["category"], return_inverse=True)
    unknown = [n for n in names if n not in categories]
    if unknown:
        raise UserError(
            f"{folder / ANNOTATIONS} has the unknown category {', '.join(unknown)}: rename it there to a known one, "
            "such as REGULAR_VEHICLE, or add it with its road user to CATEGORIES of "
            "tflane_jax/datasets/argoverse2_log.py"
        )
    traffic = np.isin(category_row, [i for i, n in enumerate(names) if categories[n] is not None])
    boxes = {name: column[traffic] for name, column in boxes.items()}
    uuid, first, k = np.unique(boxes["track_uuid"], return_index=True, return_inverse=True)
    f = np.searchsorted(times, boxes["timestamp_ns"])
    pose, shape = poses_of(folder / ANNOTATIONS, boxes), (len(times), len(uuid))
    tracks = Tracks(
        position=np.zeros((*shape, 3)),
        yaw=np.zeros(shape),
        size=np.stack([boxes[c][first] for c in _SIZE], -1),
        category=np.array([categories[c] for c in boxes["category"][first]], np.int32),
        occluded=np.zeros(shape, bool),
        valid=np.zeros(shape, bool),
        uuid=uuid,
    )
    tracks.position[f, k] = pose[:, :3, 3]
    tracks.yaw[f, k] = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    tracks.occluded[f, k] = boxes["num_interior_pts"] == 0
    tracks.valid[f, k] = True
    return tracks


def check_log(folder: Path) -> list[str]:
    """Return one sentence for each fault of a log folder; none if it can be read."""
    folder, lacking = Path(folder), []
    if not folder.is_dir():
        return [f"{folder} is no folder"]
    parts = (
        lambda: _read_boxes(folder / ANNOTATIONS),
        lambda: read_poses(folder),
        lambda: read_map(folder / "map"),
        lambda: lacking or load_log(folder),
    )
    for read in parts:
        try:
            read()
        except UserError as error:
            lacking.append(str(error))
    return lacking


def logs_within(root: Path) -> list[Path]:
    """Return the log folders where `find_logs` looks for them, sorted by log id; two may have the same id."""
    patterns = ("", "*", "*/*", "sensor/*/*")
    paths = [path.parent for p in patterns for path in sorted(root.glob(f"{p}/{ANNOTATIONS}".lstrip("/")))]
    return sorted({path.resolve(): path for path in reversed(paths)}.values(), key=lambda path: path.name)


def find_logs(root: Path) -> list[Path]:
    """Return the log folders, sorted by log id, in a dataset root, a split, a folder of logs, or one log itself.

    A log that links lead to twice is found once.

    Raises UserError if there is none, or if two have the same id.
    """
    root = named_folder(root)  # that of one log tells its id
    if not root.exists():
        raise UserError(f"there is no {root}: name a folder of Argoverse 2 logs, or one log")
    found = logs_within(root)
    if not found:
        raise UserError(
            f"{root} holds no Argoverse 2 log: no {ANNOTATIONS} in it, in */, in */*/ or in sensor/<split>/<log>/"
        )
    for one, other in itertools.pairwise(found):
        if one.name == other.name:
            raise UserError(f"{root} holds the log {one.name} twice: take out {one} or {other}")
    return found

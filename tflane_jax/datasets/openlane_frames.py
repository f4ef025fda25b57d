"""OpenLane-V2 on disk: which frames there are, and each frame's file with its cameras and poses.

    <root>/data_dict_*.json                                    {split: {segment: ["<timestamp>.json", ...]}}
    <root>/<split>/<segment>/info/<timestamp>.json, -ls.json   one frame, in the centerline and the lane-segment flavour
    <root>/<split>/<segment>/image/<camera>/<timestamp>.jpg

Subset A comes from Argoverse 2 (seven cameras, nanoseconds), subset B from nuScenes (six cameras, microseconds).
Format: https://github.com/OpenDriveLab/OpenLane-V2/blob/master/data/README.md
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import SPLITS, Split
from tflane_jax.datasets.plausible import FARTHEST, MOST_PIXELS
from tflane_jax.errors import UserError
from tflane_jax.files.fields import file_within, is_time, load_json, load_members, member, numbers
from tflane_jax.files.folders import folder_nearby
from tflane_jax.files.openlane import CENTERLINE, DATA_DICT, SEGMENT, FrameKey, frames_of
from tflane_jax.files.wording import shown
from tflane_jax.geometry import pose_matrix

SubsetName = Literal["A", "B"]
# Largest deviation of a rotation matrix from orthonormality, per entry; the files have float32 digits.
_ORTHONORMAL = 1e-4


@dataclass(frozen=True)
class Subset:
    """Constants of a subset.

    Attributes:
        cameras: names; the first is the front camera, in whose image traffic elements are labelled.
        sizes: width and height of each camera's original images, pixels.
        tick_ns: unit of the timestamps, nanoseconds.
        first_segment: number of the first segment of each split.
        data_dict: name of the split file.
        tracks_hz: frames a second of the boxes in the source logs.
    """

    cameras: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    tick_ns: int
    first_segment: Mapping[Split, int]
    data_dict: str
    tracks_hz: float


SUBSETS: Mapping[SubsetName, Subset] = {
    "A": Subset(
        cameras=(
            "ring_front_center",
            "ring_front_left",
            "ring_front_right",
            "ring_rear_left",
            "ring_rear_right",
            "ring_side_left",
            "ring_side_right",
        ),
        sizes=((1550, 2048), *6 * ((2048, 1550),)),
        tick_ns=1,
        first_segment={"train": 0, "val": 10_000, "test": 20_000},
        data_dict=f"{DATA_DICT}A.json",
        tracks_hz=10.0,
    ),
    "B": Subset(
        cameras=("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"),
        sizes=6 * ((1600, 900),),
        tick_ns=1000,
        first_segment={"train": 1000, "val": 11_000, "test": 21_000},
        data_dict=f"{DATA_DICT}B.json",
        tracks_hz=2.0,
    ),
}


@dataclass(frozen=True)
class FrameCamera:
    """One camera of one frame.

    Attributes:
        name: in the dataset.
        image: file.
        intrinsics: (3, 3), pixels of the file; lens distortion is ignored, as in TopoNet and LaneSegNet.
        ego_from_camera: (4, 4).
    """

    name: str
    image: Path
    intrinsics: Float[np.ndarray, "3 3"]
    ego_from_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class FrameFile:
    """One frame's file.

    Attributes:
        path: of the file.
        global_from_ego: (4, 4) float64.
        cameras: in the order of the subset; None for a camera that the frame lacks.
        annotation: unchecked JSON, see `openlane_annotation`; None in the test split.
    """

    path: Path
    global_from_ego: Float[np.ndarray, "4 4"]
    cameras: tuple[FrameCamera | None, ...]
    annotation: Any | None


def info_path(root: Path, key: FrameKey, suffix: str = "") -> Path:
    """Return the file of a frame; `suffix` is `files.openlane.FieldNames.suffix`."""
    return root / key.split / key.segment / "info" / f"{key.timestamp}{suffix}.json"


def list_frames(root: Path, split: str, subset: SubsetName, data_dict: str | None = None) -> list[FrameKey]:
    """Return the frames of a split by segment, then time.

    Args:
        root: of the dataset.
        split: train, val or test.
        subset: its split file is the default.
        data_dict: name of a split file under `root`; "folders" lists the folders instead, without the segments of the
            other subset. None takes the subset's split file if it exists, else lists the folders.

    Raises:
        UserError: a folder or split file that is missing, is damaged, or names no frame of this split.
    """
    if not root.is_dir():
        raise UserError(f"there is no folder {root}: set `root` to OpenLane-V2's folder")
    file = root / (data_dict or SUBSETS[subset].data_dict)
    if data_dict == "folders" or (data_dict is None and not file.is_file()):
        keys = _in_folders(root, split)
        if not keys:
            others = [name for name in SPLITS if _in_folders(root, name)]
            raise no_frames(root, split, _instead(split, others) if others else None)
        keys = _of_subset(root, keys, subset)
    else:
        content = load_json(file)
        others = [name for name in SPLITS if isinstance(content, Mapping) and content.get(name) and name != split]
        keys = [] if others and not content.get(split) else frames_of(content, split, str(file))
        if not keys:
            remedy = _instead(split, others) if others else ": choose another split"
            raise UserError(f"{file} names no frame of split {split}{remedy}, or another split file (data_dict)")
    if wrong := [key for key in sorted(keys) if not has_time(key, subset)]:
        raise UserError(f"{root}: frame {wrong[0]} {no_time(subset)}: leave the file out")
    return sorted(set(keys), key=lambda key: (key.segment, int(key.timestamp)))


def no_frames(root: Path, split: str, remedy: str | None = None) -> UserError:
    """Return the error of a folder without frames; its remedy is by default the folder above or below that has some."""
    if remedy is None:
        near = folder_nearby(root, _has_frames)
        remedy = ": is it OpenLane-V2's folder?" if near is None else f": OpenLane-V2's folder is {near}, name that"
    return UserError(f"{root} holds no {split}/<segment>/info/<timestamp>.json{remedy}")


def frames_content(root: Path, split: str, subset: SubsetName, data_dict: str | None = None) -> str:
    """Return the hash of the names of a split's frames, see `list_frames`; their files are too many to be read."""
    names = map(str, list_frames(root, split, subset, data_dict))
    return hashlib.sha256("\n".join(names).encode()).hexdigest()


def _of_subset(root: Path, keys: list[FrameKey], subset: SubsetName) -> list[FrameKey]:
    """Return frames without those of the other subset's segments; all where there are no others, for an error."""
    subsets: dict[str, SubsetName | None] = {}
    for key in sorted(keys):
        if key.segment not in subsets:
            subsets[key.segment] = subset_of_frame(root, key)
    kept = [key for key in keys if subsets[key.segment] in (subset, None)]
    return kept or keys


def subset_of_frame(root: Path, key: FrameKey) -> SubsetName | None:
    """Return the subset most of whose cameras a frame has; None if it can be read as neither."""
    for suffix in (CENTERLINE.suffix, SEGMENT.suffix):
        path = info_path(root, key, suffix)
        try:
            sensors = member(load_members(path, ("sensor",)), "sensor", str(path))
        except UserError:
            continue
        if isinstance(sensors, Mapping):
            shared: dict[SubsetName, int] = {
                name: len({*subset.cameras} & {*map(str, sensors)}) for name, subset in SUBSETS.items()
            }
            best: SubsetName = "A" if shared["A"] >= shared["B"] else "B"
            if shared[best]:
                return best
    return None


def _in_folders(root: Path, split: str) -> list[FrameKey]:
    files = (root / split).glob("*/info/*.json")
    return [FrameKey(split, path.parent.parent.name, path.stem.removesuffix("-ls")) for path in files]


def _has_frames(root: Path) -> bool:
    return any(True for split in SPLITS for _ in (root / split).glob("*/info/*.json"))


def _instead(split: str, others: Sequence[str]) -> str:
    """Return the end of a message: which options take other splits, the only ones there, in place of one."""
    return (
        f", only of {' and '.join(others)}: choose --split {others[0]}, or in a run's settings, where data.train, "
        f"data.val and data.test name the official split that serves as each, --data.{split} {others[0]}"
    )


def has_time(key: FrameKey, subset: SubsetName) -> bool:
    """Return whether a frame is named after a time in its subset's unit that fits in 64 bits as nanoseconds."""
    ticks = np.iinfo(np.int64).max // SUBSETS[subset].tick_ns
    return is_time(key.timestamp) and int(key.timestamp) <= ticks


def no_time(subset: SubsetName) -> str:
    """Return what is wrong with a frame that has no time."""
    unit = {1: "nanoseconds", 1000: "microseconds"}[SUBSETS[subset].tick_ns]
    return f"has no whole number of {unit} as its timestamp, as frames of subset {subset} have"


MAP_CHANGES = frozenset(
    (
        "75e8adad-50a6-3245-8726-5e612db3d165",
        "54bc6dbc-ebfb-3fba-b5b3-57f88b4b79ca",
        "af170aac-8465-3d7b-82c5-64147e94af7d",
        "6e106cf8-f6dd-38f6-89c8-9be7a71e7275",
        "a6daedc3063b421cb3a05019e545f925",
        "02f1e5e2fc544798aad223f5ae5e8440",
        "55638ae3a8b34572aef756ee7fbce0df",
        "20ec831deb0f44e397497198cbe5a97c",
    )
)
"""Logs whose streets differ from their map, four of subset A and four of subset B. LaneSegNet, TopoNet on subset B and
later copies of TopoNet do not train on them; TopoNet's first release on subset A does."""


def without_map_changes(root: Path, keys: Sequence[FrameKey], suffix: str = "") -> list[FrameKey]:
    """Return the frames that belong to none of the logs of `MAP_CHANGES`; see `source_logs`."""
    logs = source_logs(root, keys, suffix)
    return [key for key in keys if logs[key.split, key.segment] not in MAP_CHANGES]


def source_logs(root: Path, keys: Sequence[FrameKey], suffix: str = "") -> dict[tuple[str, str], str]:
    """Return the log of which each (split, segment) is a part; reads one file of each segment.

    Raises UserError for a file that is missing or does not name its log.
    """
    logs: dict[tuple[str, str], str] = {}
    for key in keys:
        if (key.split, key.segment) not in logs:
            path = info_path(root, key, suffix)
            meta = member(load_members(path, ("meta_data",)), "meta_data", str(path))
            log = member(meta, "source_id", f"{path}: meta_data")
            if not isinstance(log, str | int) or log == "":
                raise UserError(f"{path}: meta_data.source_id is {shown(log)}, expected the name of the source log")
            logs[key.split, key.segment] = str(log)
    return logs


def read_frame(root: Path, key: FrameKey, subset: SubsetName, suffix: str = "") -> FrameFile:
    """Return the content of one frame's file; images are not read.

    Raises:
        UserError: the file is missing or damaged, lacks an entry, has a camera of another subset, or a matrix that is
            no rotation.
    """
    path = info_path(root, key, suffix)
    content, where = load_json(path), str(path)
    sensors = member(content, "sensor", where)
    if not isinstance(sensors, Mapping):
        raise UserError(f"{where}: sensor is of type {type(sensors).__name__}, expected a mapping from cameras")
    names = SUBSETS[subset].cameras
    unknown = [name for name in sensors if name not in names]
    if unknown:
        raise UserError(
            f"{where}: camera {unknown[0]!r} is none of subset {subset} ({names[0]}, ...): "
            f"set `subset` to {'B' if subset == 'A' else 'A'}?"
        )
    return FrameFile(
        path=path,
        global_from_ego=frame_pose(member(content, "pose", where), f"{where}: pose"),
        cameras=tuple(_camera(sensors, name, root, where) if name in sensors else None for name in names),
        annotation=content.get("annotation"),
    )


def read_pose(root: Path, key: FrameKey, suffix: str = "") -> Float[np.ndarray, "4 4"]:
    """Return the pose in a frame's file, parsed no further than that; raises UserError as `read_frame` does."""
    path = info_path(root, key, suffix)
    return frame_pose(member(load_members(path, ("pose",)), "pose", str(path)), f"{path}: pose")


def _camera(sensors: Any, name: str, root: Path, where: str) -> FrameCamera:
    sensor, where = sensors[name], f"{where}: sensor.{name}"
    intrinsics = numbers(
        member(member(sensor, "intrinsic", where), "K", where), (3, 3), f"{where}.intrinsic.K", largest=MOST_PIXELS
    )
    if not (intrinsics[0, 0] > 0.0 and intrinsics[1, 1] > 0.0 and (intrinsics[2] == (0.0, 0.0, 1.0)).all()):
        raise UserError(f"{where}.intrinsic.K is no camera matrix (positive focal lengths, last row 0 0 1)")
    pose = frame_pose(member(sensor, "extrinsic", where), f"{where}.extrinsic")
    image = file_within(root, member(sensor, "image_path", where), f"{where}.image_path")
    return FrameCamera(name, image, intrinsics, pose)


def frame_pose(record: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """Return a pose of a frame's file; raises UserError where it is missing, or its rotation is none."""
    rotation = numbers(member(record, "rotation", where), (3, 3), f"{where}.rotation").astype(np.float64)
    translation = numbers(member(record, "translation", where), (3,), f"{where}.translation", largest=FARTHEST)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise UserError(f"{where}.rotation is no rotation: its rows are not orthonormal, or it mirrors")
    return pose_matrix(rotation, translation.astype(np.float64))

"""How much two splits show the same places: drives of both splits past the same spot leak the map.

The official splits of nuScenes and OpenLane-V2 overlap, so a model can score by memorising the map of a place. This
compares ego positions and reports which fraction of a validation split lies near training frames. Evaluations of real
data measure the frames near training frames and the others apart (`nearness`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, city_of, find_logs, logs_within
from tflane_jax.datasets.argoverse2_poses import read_poses
from tflane_jax.datasets.base import IndexedExamples, Split
from tflane_jax.datasets.nuscenes_folder import find_tables, table_folders
from tflane_jax.datasets.nuscenes_log import scene_frames
from tflane_jax.datasets.nuscenes_scene_files import find_scene_files, scene_file_outline
from tflane_jax.datasets.nuscenes_splits import official_split
from tflane_jax.datasets.nuscenes_tables import shared_tables
from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_members, member, numbers
from tflane_jax.files.openlane import info_files

if TYPE_CHECKING:
    from scipy.spatial import KDTree

RADII = (5.0, 10.0, 20.0, 50.0)
NEAR = 5.0
"""Up to this distance from a training frame, metres, a test frame shows a place that a model may know by heart."""
NEAR_GROUPS = ("near training", "far from training")
_FORMATS = (
    f"a folder of Argoverse 2 logs (<log>/{ANNOTATIONS}), of OpenLane-V2 (<segment>/info/<timestamp>.json), of "
    "nuScenes (v1.0-*/sample.json) or of its scene files (*.npz)"
)
_POSE_INTERVAL = 0.1  # seconds between the poses of a log that are compared; the files have 170 per second


@dataclass(frozen=True)
class DrivenPath:
    """Ego positions of one recording.

    Attributes:
        name: of the recording.
        area: city whose coordinates the positions use; positions of different cities are never compared. "" if it is
            not known: it may be any city, so its positions are compared with all.
        positions: (F, 2) metres.
    """

    name: str
    area: str
    positions: Float[np.ndarray, "f 2"]


def read_drives(root: Path, split: Split | None = None) -> list[DrivenPath]:
    """Return the drives of a folder of Argoverse 2 logs, of OpenLane-V2, of nuScenes or of its scene files.

    OpenLane-V2's files, `<segment>/info/<timestamp>.json` and `<timestamp>-ls.json`, do not name the city.

    Args:
        root: the folder; or a scene file.
        split: of a folder with `has_official_splits`, only the scenes of this one; others have no such splits.

    Raises:
        UserError: the folder holds none of these, no scene of the split, or a file cannot be read.
    """
    root = Path(root)
    if not root.exists():
        raise UserError(f"there is no {root}: name {_FORMATS}")
    if table_folders(root):
        return _table_drives(root, split)
    # Where a frame has both files, which hold the same pose, the one without "-ls" is read: it sorts last.
    files = sorted(info_files(root))
    if frames := {file.with_stem(file.stem.removesuffix("-ls")): file for file in files}:
        drives: dict[Path, list[np.ndarray]] = {}
        for _, file in sorted(frames.items()):
            pose = member(load_members(file, ("pose",)), "pose", str(file))
            where = numbers(member(pose, "translation", f"{file}: pose"), (3,), f"{file}: pose.translation")
            drives.setdefault(file.parent.parent, []).append(where[:2])
        return [DrivenPath(folder.name, "", np.stack(where)) for folder, where in drives.items()]
    if logs_within(root):
        return [_log_drive(folder) for folder in find_logs(root)]
    if _has_scene_files(root):
        found = {path.stem: path for path in find_scene_files(root)}
        return [_scene_drive(found[name]) for name in _of_split(root, found, split, mini=False)]
    raise UserError(f"{root} holds no drive: name {_FORMATS}")


def has_official_splits(root: Path) -> bool:
    """Return whether a folder holds nuScenes or scene files of it: names of scenes tell their official split."""
    return bool(table_folders(root)) or (_has_scene_files(root) and not any(info_files(root)) and not logs_within(root))


def _has_scene_files(root: Path) -> bool:
    return any(root.glob("*.npz")) or (root.is_file() and root.suffix == ".npz")


def _of_split(root: Path, names: Iterable[str], split: Split | None, *, mini: bool) -> list[str]:
    """Return the scenes of an official split of nuScenes, or all, by name."""
    found = sorted(name for name in names if split in (None, official_split(name, mini=mini)))
    if split is not None and not found:
        raise UserError(
            f"{root}, named on both sides, holds no scene of nuScenes' split {split}: name another folder on one side"
        )
    return found


def _table_drives(root: Path, split: Split | None) -> list[DrivenPath]:
    tables = shared_tables(find_tables(root))
    scenes, drives = tables.scenes(), []
    for name in _of_split(root, scenes, split, mini=tables.mini):
        frames = scene_frames(tables, scenes[name])
        drives.append(DrivenPath(name, tables.location(scenes[name]), frames.global_from_frame[:, :2, 3]))
    return drives


def _scene_drive(path: Path) -> DrivenPath:
    outline = scene_file_outline(path)
    where = [moment.global_from_ego[:2, 3] for moment in outline.keyframes]
    return DrivenPath(outline.name, outline.area, np.stack(where))


def _log_drive(folder: Path) -> DrivenPath:
    times, poses = read_poses(folder)
    _, kept = np.unique(times // int(_POSE_INTERVAL * 1e9), return_index=True)
    if not (city := city_of(folder)):
        raise UserError(f"{folder / 'map'} has no log_map_archive_*.json, whose name tells the city")
    return DrivenPath(folder.name, city, poses[kept, :2, 3])


def frame_drives(dataset: IndexedExamples) -> list[DrivenPath]:
    """Return the drives of a dataset: the positions of its examples in their order."""
    return [drive for drive, _ in _by_drive(dataset)]


def _by_drive(dataset: IndexedExamples) -> list[tuple[DrivenPath, list[int]]]:
    """Return each drive of a dataset with the indices of its examples, which are in the order of its positions."""
    positions: dict[tuple[str, str], list[np.ndarray]] = {}
    indices: dict[tuple[str, str], list[int]] = {}
    for index in range(len(dataset)):
        info = dataset.info(index)
        drive = info.scene, info.area
        positions.setdefault(drive, []).append(info.global_from_ego[:2, 3])
        indices.setdefault(drive, []).append(index)
    return [
        (DrivenPath(scene, area, np.stack(where)), indices[scene, area]) for (scene, area), where in positions.items()
    ]


@dataclass(frozen=True)
class Nearness:
    """How far the examples of a split are from the nearest training frame.

    Attributes:
        distances: (N,) metres; inf where no training frame can be in the same city.
        assumed: (N,) whether the city of the example, or of the nearest training frame, is not known.
    """

    distances: Float[np.ndarray, " n"]
    assumed: Bool[np.ndarray, " n"]

    @property
    def groups(self) -> list[str]:
        """The group of each example: one of `NEAR_GROUPS`."""
        return [NEAR_GROUPS[int(distance > NEAR)] for distance in self.distances]

    def sentence(self) -> str:
        """Return how many examples are near, and the distance of the nearest."""
        near, nearest = self.distances <= NEAR, self.distances.min()
        least = f"the nearest is {nearest:.1f} m away" if np.isfinite(nearest) else "none is of the same city"
        said = f"{near.sum()} of {len(near)} frames are within {NEAR:g} m of a training frame; {least}"
        if not (guessed := int((near & self.assumed).sum())):
            return said
        return f"{said}. Files do not name the city of {guessed} of them, which may be another with equal coordinates"


def nearness(train: Sequence[DrivenPath], dataset: IndexedExamples) -> Nearness:
    """Compare every example of a dataset with the drives of the training split, area by area.

    Raises UserError where one side has no frames.
    """
    by_drive = _by_drive(dataset)
    found = overlap(train, [drive for drive, _ in by_drive])
    distances, assumed = np.zeros(len(dataset)), np.zeros(len(dataset), bool)
    for (_, indices), apart, guess in zip(by_drive, found.distances, found.assumed, strict=True):
        distances[indices], assumed[indices] = apart, guess
    return Nearness(distances, assumed)


@dataclass(frozen=True)
class Overlap:
    """Distances from validation frames to training frames.

    Attributes:
        names: V validation drives.
        distances: V arrays (F,), from every frame to the nearest training frame that may be in the same city, metres;
            inf if there is none.
        assumed: V arrays (F,), whether the city of the frame, or of that training frame, is not known.
        nearest: V names, the training drive that comes nearest; "-" if there is none.
    """

    names: tuple[str, ...]
    distances: tuple[Float[np.ndarray, " f"], ...]
    assumed: tuple[Bool[np.ndarray, " f"], ...]
    nearest: tuple[str, ...]

    def rows(self) -> list[dict[str, float]]:
        """Return the fractions of validation frames and drives with a training frame within each of `RADII`."""
        frames = np.concatenate(self.distances)
        closest = np.array([d.min() for d in self.distances])
        return [
            {"within m": r, "frames": float((frames <= r).mean()), "drives": float((closest <= r).mean())}
            for r in RADII
        ]

    def worst(self, count: int = 10) -> list[dict[str, float | str]]:
        """Return the validation drives that overlap most: fraction within 20 m, least distance, nearest drive."""
        rows: list[dict[str, float | str]] = [
            {
                "drive": name,
                "frames within 20 m": float((d <= 20.0).mean()),
                "least m": float(d.min()),
                "nearest": other,
            }
            for name, d, other in zip(self.names, self.distances, self.nearest, strict=True)
            if np.isfinite(d.min())
        ]
        return sorted(rows, key=lambda row: (-float(row["frames within 20 m"]), float(row["least m"])))[:count]


class _TrainingFrames(NamedTuple):
    """Frames of the training drives that may be in one area.

    Attributes:
        tree: of their positions.
        drives: one after the other.
        owner: (F,) number of each frame's drive.
    """

    tree: KDTree
    drives: list[DrivenPath]
    owner: Int[np.ndarray, " f"]


def overlap(train: Sequence[DrivenPath], validation: Sequence[DrivenPath]) -> Overlap:
    """Compare positions within each city, see `DrivenPath.area`; raises UserError where one side has no drive."""
    from scipy.spatial import KDTree

    for what, drives in (("training", train), ("validation", validation)):
        if not sum(len(drive.positions) for drive in drives):
            raise UserError(f"the {what} split has no frames")
    validation = [drive for drive in validation if len(drive.positions)]
    training: dict[str, _TrainingFrames] = {}
    for area in {drive.area for drive in validation}:
        drives = [drive for drive in train if len(drive.positions) and (not area or drive.area in (area, ""))]
        if drives:
            owner = np.repeat(np.arange(len(drives)), [len(drive.positions) for drive in drives])
            tree = KDTree(np.concatenate([drive.positions for drive in drives]))
            training[area] = _TrainingFrames(tree, drives, owner)
    distances, assumed, nearest = [], [], []
    for drive in validation:
        if drive.area not in training:
            distances.append(np.full(len(drive.positions), np.inf))
            assumed.append(np.zeros(len(drive.positions), bool))
            nearest.append("-")
            continue
        frames = training[drive.area]
        distance, index = frames.tree.query(drive.positions)
        owner = frames.owner[index]
        distances.append(distance)
        named = np.array([bool(drive.area and other.area) for other in frames.drives])
        assumed.append(~named[owner])
        nearest.append(frames.drives[owner[distance.argmin()]].name)
    return Overlap(tuple(drive.name for drive in validation), tuple(distances), tuple(assumed), tuple(nearest))

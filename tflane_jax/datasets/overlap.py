"""How much two splits show the same places: drives of both splits past the same spot leak the map.

The official splits of nuScenes and OpenLane-V2 overlap, so a model can score by memorising the map of a place. This
compares ego positions and reports which fraction of a validation split lies near training frames. Evaluations of real
data measure the frames near training frames and the others apart (`nearness`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.argoverse2_log import city_of, find_logs
from tflane_jax.datasets.argoverse2_poses import read_poses
from tflane_jax.datasets.base import IndexedExamples
from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_members, member, numbers
from tflane_jax.files.openlane import info_files

RADII = (5.0, 10.0, 20.0, 50.0)
NEAR = 5.0
"""Up to this distance from a training frame, metres, a test frame shows a place that a model may know by heart."""
NEAR_GROUPS = ("near training", "far from training")
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


def read_drives(root: Path) -> list[DrivenPath]:
    """Return the drives of a folder of Argoverse 2 logs, or of OpenLane-V2.

    Its files, `<segment>/info/<timestamp>.json` and `<timestamp>-ls.json`, do not name the city.

    Raises:
        UserError: the folder holds neither, or a file cannot be read.
    """
    root = Path(root)
    # Where a frame has both files, which hold the same pose, the one without "-ls" is read: it sorts last.
    files = sorted(info_files(root))
    if frames := {file.with_stem(file.stem.removesuffix("-ls")): file for file in files}:
        drives: dict[Path, list[np.ndarray]] = {}
        for _, file in sorted(frames.items()):
            pose = member(load_members(file, ("pose",)), "pose", str(file))
            where = numbers(member(pose, "translation", f"{file}: pose"), (3,), f"{file}: pose.translation")
            drives.setdefault(file.parent.parent, []).append(where[:2])
        return [DrivenPath(folder.name, "", np.stack(where)) for folder, where in drives.items()]
    try:
        logs = find_logs(root)
    except UserError as error:
        also = "; nor a frame of OpenLane-V2: no <segment>/info/<timestamp>.json" if root.is_dir() else ""
        raise UserError(f"{error}{also}") from None
    return [_log_drive(folder) for folder in logs]


def _log_drive(folder: Path) -> DrivenPath:
    times, poses = read_poses(folder)
    _, kept = np.unique(times // int(_POSE_INTERVAL * 1e9), return_index=True)
    if not (city := city_of(folder)):
        raise UserError(f"{folder / 'map'} has no log_map_archive_*.json, whose name tells the city")
    return DrivenPath(folder.name, city, poses[kept, :2, 3])


def frame_drives(dataset: IndexedExamples) -> list[DrivenPath]:
    """Return the drives of a dataset: the positions of its examples in their order."""
    drives: dict[tuple[str, str], list[np.ndarray]] = {}
    for index in range(len(dataset)):
        info = dataset.info(index)
        drives.setdefault((info.scene, info.area), []).append(info.global_from_ego[:2, 3])
    return [DrivenPath(scene, area, np.stack(where)) for (scene, area), where in drives.items()]


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
    rows: dict[tuple[str, str], list[int]] = {}
    for index in range(len(dataset)):
        info = dataset.info(index)
        rows.setdefault((info.scene, info.area), []).append(index)
    found = overlap(train, frame_drives(dataset))
    distances, assumed = np.zeros(len(dataset)), np.zeros(len(dataset), bool)
    for indices, apart, guess in zip(rows.values(), found.distances, found.assumed, strict=True):
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


def overlap(train: Sequence[DrivenPath], validation: Sequence[DrivenPath]) -> Overlap:
    """Compare positions within each city, see `DrivenPath.area`; raises UserError where one side has no drive."""
    from scipy.spatial import KDTree

    for what, drives in (("training", train), ("validation", validation)):
        if not sum(len(drive.positions) for drive in drives):
            raise UserError(f"the {what} split has no frames")
    validation = [drive for drive in validation if len(drive.positions)]
    trees = {}
    for area in {drive.area for drive in validation}:
        drives = [drive for drive in train if len(drive.positions) and (not area or drive.area in (area, ""))]
        if drives:
            owner = np.repeat(np.arange(len(drives)), [len(drive.positions) for drive in drives])
            trees[area] = KDTree(np.concatenate([drive.positions for drive in drives])), owner, drives
    distances, assumed, nearest = [], [], []
    for drive in validation:
        if drive.area not in trees:
            distances.append(np.full(len(drive.positions), np.inf))
            assumed.append(np.zeros(len(drive.positions), bool))
            nearest.append("-")
            continue
        tree, owner, drives = trees[drive.area]
        distance, index = tree.query(drive.positions)
        distances.append(distance)
        named = np.array([bool(drive.area and other.area) for other in drives])
        assumed.append(~named[owner[index]])
        nearest.append(drives[owner[index[distance.argmin()]]].name)
    return Overlap(tuple(drive.name for drive in validation), tuple(distances), tuple(assumed), tuple(nearest))

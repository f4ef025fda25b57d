"""Check a folder of OpenLane-V2: counts of each split, and one sentence for each fault.

Every frame's files are read as for training. By default only the header and the last bytes of an image are read, so
that a subset takes minutes. A folder may hold both subsets; each segment is checked against its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tflane_jax.datasets.areas import is_closed
from tflane_jax.datasets.base import SPLITS, ExampleConfig, Split
from tflane_jax.datasets.data_source import FolderCheck
from tflane_jax.datasets.openlane_annotation import Annotation, read_annotation
from tflane_jax.datasets.openlane_check_cameras import CameraChecks, Images
from tflane_jax.datasets.openlane_check_collections import check_collections
from tflane_jax.datasets.openlane_check_files import frames_on_disk, named_frames, subsets_of
from tflane_jax.datasets.openlane_frames import (
    SUBSETS,
    FrameFile,
    SubsetName,
    has_time,
    info_path,
    no_frames,
    no_time,
    read_frame,
    source_logs,
)
from tflane_jax.datasets.openlane_sd_map import FILE, read_sd_lines, sd_map_path
from tflane_jax.datasets.openlane_tracks import SourceTracks, listed
from tflane_jax.datasets.plausible import check_motion
from tflane_jax.errors import UserError
from tflane_jax.files.openlane import CENTERLINE, SEGMENT, FrameKey
from tflane_jax.progress import progress_bar
from tflane_jax.scene import AreaType

_WITH_LOG, _WITHOUT_LOG, _WITH_TRAFFIC = "with log", "without log", "with traffic"
# Name of the log of a segment whose files do not tell it; no log has it.
_NO_LOG = ""
# Metres from the vehicle: lanes are annotated up to 50 m ahead and behind.
_FARTHEST = 200.0
_COUNTS = ("segments", "frames", "-ls files", "images", "lanes", "lane segments", "elements", "areas", "SD maps")


def check_openlane_v2(
    root: Path,
    tracks: Path | None = None,
    *,
    images: Images = "ends",
    cameras: Literal["all", "some"] = "all",
    progress: bool = True,
) -> FolderCheck:
    """Check every split that split files or folders contain, and the collections beside them.

    Args:
        root: of the dataset.
        tracks: folder of the logs of which the segments are parts. With it, the rows say how many frames have such a
            log, and in how many of them there is any road user; a log that does not fit its frames is a fault. Logs
            that are missing are named among what was skipped.
        images: how far images are read, see `openlane_check_cameras.Images`.
        cameras: whether a frame without one of its subset's cameras is a fault.
        progress: show a bar.

    Raises UserError where there is no frame at all, or `tracks` holds no log.
    """
    checks = _Checks(Path(root), tracks, images, cameras, progress)
    root, faults, skipped = checks.root, checks.faults, checks.skipped
    if not root.is_dir():
        raise UserError(f"there is no folder {root}: name OpenLane-V2's")
    on_disk = frames_on_disk(root, skipped)
    named = named_frames(root, on_disk, faults, skipped)
    if not any(on_disk.values()):
        raise no_frames(root, "<split>")
    subsets = subsets_of(root, on_disk)
    present: list[SubsetName] = sorted(set(subsets.values()))
    rows = []
    for split in SPLITS:
        every = sorted({*named[split], *on_disk[split]}, key=lambda key: (key.segment, int(key.timestamp)))
        for subset in present:
            keys = [key for key in every if subsets.get((key.split, key.segment), present[0]) == subset]
            before = len(faults)
            keys = checks.with_time(split, subset, keys)
            if not keys:
                continue
            there = checks.not_absent(split, keys, set(named[split]) - set(on_disk[split]))
            counts = checks.split(split, subset, there, alone=len(present) == 1)
            both = {"subset": subset} if len(present) > 1 else {}
            rows.append({"split": split, **both, **counts, "faults": len(faults) - before})
    skipped += _not_named(root, named, on_disk, present)
    of_collections, not_read = check_collections(root, [key for keys in on_disk.values() for key in keys])
    title = f"OpenLane-V2, subset {' and '.join(present)}"
    return FolderCheck(title, rows, [*faults, *of_collections], [*skipped, *not_read])


@dataclass
class _Checks:
    """What to check, see `check_openlane_v2`, and what was found so far."""

    root: Path
    tracks: Path | None
    images: Images
    cameras: Literal["all", "some"]
    progress: bool
    faults: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def with_time(self, split: Split, subset: SubsetName, keys: list[FrameKey]) -> list[FrameKey]:
        """Return the frames whose names are times; the others are a fault."""
        wrong = {key for key in keys if not has_time(key, subset)}
        if wrong:
            self.faults.append(f"{self.root}: {len(wrong)} {split} frames, first {min(wrong)}: it {no_time(subset)}")
        return [key for key in keys if key not in wrong]

    def not_absent(self, split: Split, keys: list[FrameKey], not_on_disk: set[FrameKey]) -> list[FrameKey]:
        """Return the frames that are there; that the others are missing is a fault."""
        absent = not_on_disk.intersection(keys)
        if absent:
            self.faults.append(
                f"{self.root}: {len(absent)} of {len(keys)} {split} frames that split files name are missing (first "
                f"{min(absent)})"
            )
        return [key for key in keys if key not in absent]

    def split(self, split: Split, subset: SubsetName, keys: list[FrameKey], *, alone: bool) -> dict[str, Any]:
        """Check the frames, logs and SD maps of a split and return the counts; `alone`: there is no other subset."""
        before = len(self.faults)
        logs, unnamed = None, {}
        if self.tracks is not None:
            logs, unnamed = _logs(self.root, keys, subset, self.tracks, alone=alone)
        counts = self.frames(keys, subset, logs)
        # What makes a file unreadable has been reported.
        told = self.faults[before:]
        self.faults += [why for path, why in unnamed.items() if not any(str(path) in fault for fault in told)]
        counts["segments"] = len({key.segment for key in keys})
        counts["SD maps"] = _check_sd_maps(self.root, keys, self.faults)
        lacking = Counter() if logs is None else logs.lacking(keys)
        del lacking[_NO_LOG]  # a fault
        if lacking:
            self.skipped.append(
                f"{lacking.total()} of {len(keys)} {split} frames have no log in {self.tracks}, so no traffic flow: "
                f"it lacks {listed(lacking, len(lacking))}"
            )
        return dict(counts) if self.tracks is None else _with_share(counts)

    def frames(self, keys: list[FrameKey], subset: SubsetName, logs: SourceTracks | None) -> Counter[str]:
        """Check frames that are there, in the order of time, and return what they hold."""
        of_logs = () if logs is None else (_WITH_LOG, _WITHOUT_LOG, _WITH_TRAFFIC)
        counts: Counter[str] = Counter(dict.fromkeys((*_COUNTS, *of_logs), 0))
        images = CameraChecks(self.images)
        before = None
        lacking: dict[tuple[str, str], list[FrameKey]] = {}
        title = f"checking {keys[0].split if keys else ''}"
        for key in progress_bar(keys, title, unit="frame", disable=not self.progress):
            frame = _check_frame(self.root, key, subset, counts, self.faults, images)
            self.faults += _check_motion(before, key, frame, subset)
            if frame is None:
                continue
            if logs is not None:
                # A log that cannot be read is one fault, not one of each of its frames.
                of_log = _check_tracks(logs, key, frame, counts)
                self.faults += [fault for fault in of_log if fault not in self.faults]
            for name, camera in zip(SUBSETS[subset].cameras, frame.cameras, strict=True):
                if camera is None and self.cameras == "all":
                    lacking.setdefault((key.scene, name), []).append(key)
            before = (key, frame)
        strange, of_cameras = images.finish()
        counts["images"] -= strange
        self.faults += of_cameras
        self.faults += [
            f"{self.root / scene}: {len(of)} frames have no camera {name} (first {of[0]})"
            for (scene, name), of in lacking.items()
        ]
        return counts


def _not_named(
    root: Path, named: dict[Split, list[FrameKey]], on_disk: dict[Split, list[FrameKey]], present: list[SubsetName]
) -> Iterator[str]:
    """Return which split files are missing, and how many frames of the others' splits a training would not see."""
    for subset in present:
        file = root / f"data_dict_subset_{subset}.json"
        if not file.is_file():
            yield f"{file} is missing: a training takes its frames from it, or all there are with data_dict folders"
    for split, keys in on_disk.items():
        unnamed = sorted(set(keys) - set(named[split])) if named[split] else []
        if unnamed:
            yield (
                f"{len(unnamed)} of {len(keys)} {split} frames are named by no split file (first {unnamed[0]}): a "
                "training does not see them, unless data.data_dict is folders"
            )


def _check_frame(
    root: Path, key: FrameKey, subset: SubsetName, counts: Counter[str], faults: list[str], images: CameraChecks
) -> FrameFile | None:
    """Check the files of one frame and return the first readable one."""
    first: FrameFile | None = None
    elements = None
    for names, kind in ((CENTERLINE, "lanes"), (SEGMENT, "lane segments")):
        path = info_path(root, key, names.suffix)
        if not path.is_file():
            continue
        counts["frames" if names is CENTERLINE else "-ls files"] += 1
        try:
            frame = read_frame(root, key, subset, names.suffix)
            found = None
            if frame.annotation is not None:
                found = read_annotation(frame.annotation, names, f"{path}: annotation")
            elif key.split != "test":
                faults.append(f"{path} has no annotation, though it is of split {key.split}")
        except UserError as error:
            faults.append(str(error))
            continue
        if found is not None:
            faults += [f"{path}: {fault}" for fault in _check_annotation(found)]
            counts[kind] += len(found.lines)
            counts["areas"] += len(found.areas)
            counts["elements"] += len(found.boxes) if elements is None else 0
            if elements is not None and elements != len(found.boxes):
                faults.append(f"{path} has {len(found.boxes)} traffic elements, its centerline twin {elements}")
            elements = len(found.boxes)
        if first is None:
            first = frame
            intact, damaged = images.check(frame)
            counts["images"] += intact
            faults += damaged
        elif not np.allclose(first.global_from_ego, frame.global_from_ego):
            faults.append(f"{path} has another pose than its centerline twin")
    return first


def _check_sd_maps(root: Path, keys: list[FrameKey], faults: list[str]) -> int:
    """Check the SD maps of a split's segments and return how many can be read; a split may have none."""
    segments = {key.scene: sd_map_path(root, key) for key in keys}
    lacking, read = [scene for scene, path in segments.items() if not path.is_file()], 0
    for scene, path in segments.items():
        if scene not in lacking:
            try:
                read_sd_lines(path)
                read += 1
            except UserError as error:
                faults.append(str(error))
    if 0 < len(lacking) < len(segments):
        faults.append(
            f"{root}: {len(lacking)} of {len(segments)} segments have no {FILE} (first {lacking[0]}): unpack the SD "
            "maps again"
        )
    return read


def _check_annotation(found: Annotation) -> Iterator[str]:
    if (far := max((float(np.abs(line[:, :2]).max()) for line in found.lines), default=0.0)) > _FARTHEST:
        yield f"a lane reaches {far:.0f} m from the vehicle, expected some 50: metres, in the ego frame?"
    if any((line == line[0]).all() for line in (*found.lines, *(found.left or ()), *(found.right or ()), *found.areas)):
        yield "a lane, boundary or area has no length: all of its points are at one place"
    if (np.diff(found.boxes, axis=1) <= 0.0).any():
        yield "a traffic element's box has no area: its points should be the top-left and the bottom-right corner"
    crossings = [found.areas[i] for i in np.flatnonzero(found.area_category == AreaType.PEDESTRIAN_CROSSING)]
    if not all(is_closed(outline) for outline in crossings):
        yield "the outline of a crossing does not end where it begins: its points should be those of a ring"
    lights = np.isin(found.attribute, (1, 2, 3))
    if (lights & (found.element_category != 1)).any() or ((found.attribute > 3) & (found.element_category != 2)).any():
        yield "a traffic element's attribute does not fit its category (1 to 3 are of lights, 4 to 12 of signs)"


def _check_motion(
    before: tuple[FrameKey, FrameFile] | None, key: FrameKey, frame: FrameFile | None, subset: SubsetName
) -> Iterator[str]:
    """Compare a frame with the one before it in its segment."""
    if before is None or frame is None or before[0].segment != key.segment:
        return
    (earlier, other), tick = before, SUBSETS[subset].tick_ns
    places = np.stack([other.global_from_ego, frame.global_from_ego])[:, :3, 3]
    gap = (int(key.timestamp) - int(earlier.timestamp)) * tick
    try:
        check_motion(places, np.array([0, gap]), [str(other.path), str(frame.path)])
    except UserError as error:
        yield str(error)


def _logs(
    root: Path, keys: list[FrameKey], subset: SubsetName, tracks: Path, *, alone: bool
) -> tuple[SourceTracks | None, dict[Path, str]]:
    """Return the logs of a split, and by file why its segment's log is not known; such a segment has none.

    `tracks` may hold those of one subset; None for the other, unless the subset stands alone.
    """
    named: dict[tuple[str, str], str] = {}
    unnamed: dict[Path, str] = {}
    for key in keys:
        suffix = CENTERLINE.suffix if info_path(root, key, CENTERLINE.suffix).is_file() else SEGMENT.suffix
        if (key.split, key.segment) not in named:
            try:
                named |= source_logs(root, [key], suffix)
            except UserError as error:
                named[key.split, key.segment] = _NO_LOG
                unnamed[info_path(root, key, suffix)] = str(error)
    try:
        return SourceTracks(tracks, subset, named), unnamed
    except UserError:
        if alone:
            raise
        return None, {}


def _check_tracks(logs: SourceTracks, key: FrameKey, frame: FrameFile, counts: Counter[str]) -> Iterator[str]:
    if not logs.has(key):
        counts[_WITHOUT_LOG] += 1
        return
    try:
        flow = logs.flow(key, frame.global_from_ego, ExampleConfig())
    except UserError as error:
        yield str(error)
        return
    counts[_WITH_LOG] += 1
    counts[_WITH_TRAFFIC] += bool(flow.valid.any())


def _with_share(counts: Counter[str]) -> dict[str, Any]:
    frames = max(counts["frames"], counts["-ls files"], 1)
    return {**counts, _WITH_TRAFFIC: f"{counts[_WITH_TRAFFIC]} ({100 * counts[_WITH_TRAFFIC] / frames:.1f} %)"}

"""Check a folder of OpenLane-V2: counts of each split, and one sentence for each fault.

Every frame's files are read as for training. Of images only existence, first and last bytes are checked; they are not
decoded, so a whole subset takes minutes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tflane_jax.datasets.base import SPLITS, ExampleConfig, Split
from tflane_jax.datasets.openlane_annotation import Annotation, read_annotation
from tflane_jax.datasets.openlane_frames import (
    SUBSETS,
    FrameFile,
    SubsetName,
    frames_of,
    info_path,
    list_frames,
    read_frame,
    source_logs,
)
from tflane_jax.datasets.openlane_tracks import SourceTracks
from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_json
from tflane_jax.files.openlane import CENTERLINE, SEGMENT, FrameKey

# Metres per second; a higher speed between two frames means damaged poses.
_FASTEST = 70.0
# First and last bytes of intact images.
_MARKS = {".jpg": (b"\xff\xd8", b"\xff\xd9"), ".png": (b"\x89PNG", b"IEND\xaeB`\x82")}
_WITH_LOG, _WITH_TRAFFIC = "with log", "with traffic"
_COUNTS = ("segments", "frames", "-ls files", "images", "lanes", "lane segments", "elements", "areas")


@dataclass(frozen=True)
class OpenLaneCheck:
    """Result of a check.

    Attributes:
        subset: A or B, by the cameras of the first frame.
        rows: counts of each split, for a table.
        faults: sentences, each naming a file.
    """

    subset: SubsetName
    rows: list[dict[str, Any]]
    faults: list[str]


def check_openlane_v2(root: Path, tracks: Path | None = None, *, progress: bool = True) -> OpenLaneCheck:
    """Check every split that split files or folders contain.

    Args:
        root: of the dataset.
        tracks: folder of the logs of which the segments are parts. With it, the rows say how many frames have such a
            log, and in how many of them there is any road user; a log that does not fit its frames is a fault.
        progress: show a bar.

    Raises UserError where there is no frame at all, or `tracks` holds no log.
    """
    root, faults = Path(root), []
    named, on_disk = _named_frames(root, faults), _frames_on_disk(root)
    if not any(on_disk.values()):
        raise UserError(f"{root} holds no <split>/<segment>/info/<timestamp>.json: is it OpenLane-V2's folder?")
    subset = _subset(root, next(keys[0] for keys in on_disk.values() if keys))
    rows = []
    for split in SPLITS:
        keys = sorted({*named[split], *on_disk[split]}, key=lambda key: (key.segment, int(key.timestamp)))
        if not keys:
            continue
        absent = set(named[split]) - set(on_disk[split])
        if absent:
            faults.append(
                f"{root}: {len(absent)} of {len(keys)} {split} frames that split files name are missing (first "
                f"{min(absent)})"
            )
        before, found = None, len(faults)
        counts: Counter[str] = Counter(dict.fromkeys(_COUNTS, 0))
        if tracks is not None:
            counts |= {_WITH_LOG: 0, _WITH_TRAFFIC: 0}
        logs = None if tracks is None else _logs(root, [key for key in keys if key not in absent], subset, tracks)
        for key in tqdm(keys, f"checking {split}", unit="frame", disable=not progress):
            if key not in absent:
                frame = _check_frame(root, key, subset, counts, faults)
                faults += _check_motion(before, key, frame, subset)
                if logs is not None and frame is not None:
                    # A log that cannot be read is one fault, not one of each of its frames.
                    faults += [fault for fault in _check_tracks(logs, key, frame, counts) if fault not in faults]
                before = (key, frame) if frame is not None else before
        counts["segments"] = len({key.segment for key in keys})
        content = counts if logs is None else _with_share(counts)
        rows.append({"split": split, **content, "faults": len(faults) - found + bool(absent)})
    return OpenLaneCheck(subset, rows, faults)


def _named_frames(root: Path, faults: list[str]) -> dict[Split, list[FrameKey]]:
    """Return the frames that any split file names."""
    named: dict[Split, list[FrameKey]] = {split: [] for split in SPLITS}
    for file in sorted(root.glob("data_dict_*.json")):
        try:
            content = load_json(file)
            for split in SPLITS:
                if isinstance(content, Mapping) and split not in content:
                    continue
                keys = frames_of(content, split, str(file))
                faults += [
                    f"{file}: {key} has no whole number as its timestamp"
                    for key in keys
                    if not key.timestamp.isdecimal()
                ]
                named[split] += [key for key in keys if key.timestamp.isdecimal()]
        except UserError as error:
            faults.append(str(error))
    return named


def _frames_on_disk(root: Path) -> dict[Split, list[FrameKey]]:
    present = [split for split in SPLITS if any((root / split).glob("*/info/*.json"))]
    return {split: list_frames(root, split, "A", "folders") if split in present else [] for split in SPLITS}


def _subset(root: Path, key: FrameKey) -> SubsetName:
    """Return the subset whose cameras the frame has; A if it has none."""
    for name in SUBSETS:
        for suffix in (CENTERLINE.suffix, SEGMENT.suffix):
            try:
                if any(read_frame(root, key, name, suffix).cameras):
                    return name
            except UserError:
                continue
    return "A"


def _check_frame(
    root: Path, key: FrameKey, subset: SubsetName, counts: Counter[str], faults: list[str]
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
            images = list(_check_cameras(frame))
            counts["images"] += sum(camera is not None for camera in frame.cameras) - len(images)
            faults += images
        elif not np.allclose(first.global_from_ego, frame.global_from_ego):
            faults.append(f"{path} has another pose than its centerline twin")
    return first


def _check_annotation(found: Annotation) -> Iterator[str]:
    if (np.diff(found.boxes, axis=1) <= 0.0).any():
        yield "a traffic element's box has no area: its points should be the top-left and the bottom-right corner"
    lights = np.isin(found.attribute, (1, 2, 3))
    if (lights & (found.element_category != 1)).any() or ((found.attribute > 3) & (found.element_category != 2)).any():
        yield "a traffic element's attribute does not fit its category (1 to 3 are of lights, 4 to 12 of signs)"


def _check_cameras(frame: FrameFile) -> Iterator[str]:
    front = frame.cameras[0]
    # The third column is the optical axis in the ego frame.
    if front is not None and front.ego_from_camera[0, 2] < 0.5:
        yield (
            f"{frame.path}: {front.name} does not look ahead: is its extrinsic from the ego frame to the camera, "
            "instead of from the camera to the ego frame?"
        )
    for camera in frame.cameras:
        if camera is not None and (fault := _check_image(camera.image)) is not None:
            yield f"{camera.image} {fault}"


def _check_image(path: Path) -> str | None:
    """Return the fault of an image file, or None."""
    try:
        with open(path, "rb") as file:
            start = file.read(4)
            size = file.seek(0, 2)
            file.seek(max(size - 64, 0))
            end = file.read()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    head, tail = _MARKS.get(path.suffix.lower(), (b"", b""))
    if not start.startswith(head) or tail not in end:
        return "is damaged or cut short"
    return None


def _check_motion(
    before: tuple[FrameKey, FrameFile] | None, key: FrameKey, frame: FrameFile | None, subset: SubsetName
) -> Iterator[str]:
    """Compare a frame with the one before it in its segment."""
    if before is None or frame is None or before[0].segment != key.segment:
        return
    seconds = (int(key.timestamp) - int(before[0].timestamp)) * SUBSETS[subset].tick_ns / 1e9
    metres = float(np.linalg.norm((frame.global_from_ego - before[1].global_from_ego)[:3, 3]))
    if metres > _FASTEST * seconds:
        yield (
            f"{frame.path}: the vehicle is {metres:.0f} m from where it was {seconds:.2g} s before: pose or timestamp "
            "is wrong"
        )


def _logs(root: Path, keys: list[FrameKey], subset: SubsetName, tracks: Path) -> SourceTracks:
    """Return the logs of a split; the files of a segment that do not name theirs have none."""
    named: dict[tuple[str, str], str] = {}
    for key in keys:
        suffix = CENTERLINE.suffix if info_path(root, key, CENTERLINE.suffix).is_file() else SEGMENT.suffix
        if (key.split, key.segment) not in named:
            try:
                named |= source_logs(root, [key], suffix)
            except UserError:  # a fault of the file, which its own check reports
                named[key.split, key.segment] = ""
    return SourceTracks(tracks, subset, named)


def _check_tracks(logs: SourceTracks, key: FrameKey, frame: FrameFile, counts: Counter[str]) -> Iterator[str]:
    if not logs.has(key):
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

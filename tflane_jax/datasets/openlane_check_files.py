"""Which frames a folder of OpenLane-V2 names and has, the subset of each segment, and what does not belong there."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from tflane_jax.datasets.base import SPLITS, Split
from tflane_jax.datasets.openlane_frames import SUBSETS, SubsetName, subset_of_frame
from tflane_jax.datasets.openlane_sd_map import FILE
from tflane_jax.errors import UserError
from tflane_jax.files.fields import is_time, load_json
from tflane_jax.files.openlane import FrameKey, frames_of

# Frames of a segment that are read to find its subset.
_TRIED = 3
_FRAME_FILE = re.compile(r"(\d+)(-ls)?\.json")
_IMAGES = (".jpg", ".jpeg", ".png")
# Beside the splits in the official repository's folder.
_OFFICIAL = ("openlanev2.md5", "preprocess.py", "preprocess-ls.py", "preprocess-sd.py")
_CAMERAS = {name for subset in SUBSETS.values() for name in subset.cameras}


def named_frames(
    root: Path, on_disk: Mapping[Split, list[FrameKey]], faults: list[str], skipped: list[str]
) -> dict[Split, list[FrameKey]]:
    """Return the frames that any split file names, of those files that name a frame on disk.

    The official folder has the files of both subsets, and many people one subset. A file none of whose frames are there
    is skipped and named, unless no file has any.
    """
    by_file: dict[Path, dict[Split, list[FrameKey]]] = {}
    for file in sorted(root.glob("data_dict_*.json")):
        named: dict[Split, list[FrameKey]] = {split: [] for split in SPLITS}
        by_file[file] = named
        try:
            content = load_json(file)
            for split in SPLITS:
                if isinstance(content, Mapping) and split not in content:
                    continue
                keys = frames_of(content, split, str(file))
                faults += [
                    f"{file}: {key} has no whole number as its timestamp" for key in keys if not is_time(key.timestamp)
                ]
                if twice := len(keys) - len(set(keys)):
                    faults.append(f"{file}: {twice} {split} frames are named twice")
                named[split] += [key for key in keys if is_time(key.timestamp)]
        except UserError as error:
            faults.append(str(error))
    there = {key for keys in on_disk.values() for key in keys}
    used = [file for file, named in by_file.items() if any(there.intersection(keys) for keys in named.values())]
    for file, named in by_file.items():
        if used and file not in used and (frames := sum(map(len, named.values()))):
            skipped.append(f"{file}: none of its {frames} frames are here")
    return {split: [key for file in used or by_file for key in by_file[file][split]] for split in SPLITS}


def frames_on_disk(root: Path, skipped: list[str]) -> dict[Split, list[FrameKey]]:
    """Return the frames in the folders; files and folders that are none of the dataset's are skipped and named."""
    found: dict[Split, list[FrameKey]] = {}
    skipped += [
        f"{path} is neither a split's folder ({', '.join(SPLITS)}) nor a split file nor a collection"
        for path in root.glob("*")
        if not _of_root(path)
    ]
    for split in SPLITS:
        keys = set()
        for segment in (root / split).glob("*"):
            if not (segment / "info").is_dir():
                skipped.append(f"{segment} is no segment: it has no info folder")
                continue
            skipped += [
                f"{path} is no part of a segment (info, image, {FILE})"
                for path in segment.glob("*")
                if path.name not in ("info", "image", FILE)
            ]
            skipped += _strays_of_images(segment / "image")
            for path in (segment / "info").glob("*"):
                name = _FRAME_FILE.fullmatch(path.name)
                if name is None or path.is_dir():
                    skipped.append(f"{path} is no frame's file (<timestamp>.json or <timestamp>-ls.json)")
                else:
                    keys.add(FrameKey(split, segment.name, name[1]))
        found[split] = sorted(keys, key=lambda key: (key.segment, int(key.timestamp)))
    skipped.sort()
    return found


def _of_root(path: Path) -> bool:
    if path.name in SPLITS:
        return path.is_dir()
    return path.is_file() and (path.match("data_dict_*.json") or path.suffix == ".pkl" or path.name in _OFFICIAL)


def _strays_of_images(folder: Path) -> Iterator[str]:
    for camera in folder.glob("*"):
        if not camera.is_dir() or camera.name not in _CAMERAS:
            yield f"{camera} is no folder of a camera of either subset"
            continue
        for path in camera.glob("*"):
            if path.suffix.lower() not in _IMAGES or path.name.startswith("."):
                yield f"{path} is no image ({', '.join(_IMAGES)})"


def subsets_of(root: Path, on_disk: Mapping[Split, list[FrameKey]]) -> dict[tuple[str, str], SubsetName]:
    """Return the subset of each (split, segment), by the cameras of its first readable frames; else that of others."""
    found: dict[tuple[str, str], SubsetName | None] = {}
    tried: Counter[tuple[str, str]] = Counter()
    for key in (key for keys in on_disk.values() for key in keys):
        segment = key.split, key.segment
        if found.get(segment) is None and tried[segment] < _TRIED:
            tried[segment] += 1
            found[segment] = subset_of_frame(root, key)
    known: list[SubsetName] = [subset for subset in found.values() if subset is not None]
    other = known[0] if known else "A"
    return {segment: other if subset is None else subset for segment, subset in found.items()}

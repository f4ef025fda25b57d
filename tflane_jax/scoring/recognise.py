"""What a file seems to be: for the message about one that a protocol cannot read."""

from __future__ import annotations

import json
import stat
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tflane_jax.errors import UserError
from tflane_jax.files.openlane import info_files
from tflane_jax.files.plain_pickle import load_plain_pickle

Side = Literal["predictions", "ground truth"]
Format = Literal["OpenLane-V2 centerlines", "OpenLane-V2 lane segments", "MapTR", "TuSimple", "plain centerlines"]
_TASKS: dict[str, Format] = {
    "lane_centerline": "OpenLane-V2 centerlines",
    "lane_segment": "OpenLane-V2 lane segments",
}
_LONGEST_LINE = 2**20


class Content(NamedTuple):
    """What a file seems to hold.

    Attributes:
        format: whose file it is.
        side: of the comparison.
        remedy: for a form of it that no protocol reads; "" for others.
    """

    format: Format
    side: Side
    remedy: str = ""


def check_there(path: Path) -> None:
    """Raise UserError where there is no file or folder of this name, or a device, which may have no end."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
        raise UserError(f"cannot read {path}: it is a device, expected a file")


def hint(path: Path, side: Side, formats: Sequence[Format], protocols: Mapping[str, Sequence[Format]]) -> str:
    """Return the likely reason why a file cannot be read, as the end of a message; "" where none is known.

    Args:
        path: of the file.
        side: as which it was given.
        formats: that the chosen protocol reads.
        protocols: formats that each protocol reads.
    """
    content = recognise(path)
    if content is None:
        return ""
    if content.remedy:
        return f". It looks like {content.remedy}"
    if content.format not in formats:
        able = [name for name, read in protocols.items() if content.format in read]
        return f". It looks like {content.side} of {content.format}: score it by {' or '.join(able)}"
    if content.side != side:
        return f". It looks like {content.side}: are PREDICTIONS and GROUND_TRUTH swapped?"
    return ""


def recognise(path: Path) -> Content | None:
    """Return what a file or folder seems to hold, None if that is unknown or it is damaged."""
    try:
        if path.is_dir():
            return _of_folder(path)
        if not path.is_file():  # a pipe: what was read of it is gone, and opening it again would wait for more
            return None
        if zipfile.is_zipfile(path):
            return _of_arrays(zipfile.ZipFile(path).namelist())
        if path.suffix in (".pkl", ".pickle"):
            return _of_record(load_plain_pickle(path))
        return _of_text(path)
    except Exception:  # a damaged file may raise anything; its reader says what is wrong with it
        return None


def _of_folder(path: Path) -> Content | None:
    stems = [file.stem for file in info_files(path)]
    if not stems:
        return None
    segments = all(stem.endswith("-ls") for stem in stems)
    return Content("OpenLane-V2 lane segments" if segments else "OpenLane-V2 centerlines", "ground truth")


def _of_arrays(names: Iterable[str]) -> Content | None:
    held = {name.removesuffix(".npy") for name in names}
    if not {"points", "scene", "timestamp_ns"} <= held:
        return None
    if "category" in held and "successor" not in held:
        lines = "the map lines of `tflane predict`, which no protocol reads"
        return Content("plain centerlines", "predictions", lines)
    return Content("plain centerlines", "predictions" if "scores" in held else "ground truth")


def _of_text(path: Path) -> Content | None:
    text = path.read_text(encoding="utf-8-sig")
    first = text.lstrip()[:_LONGEST_LINE].split("\n", 1)[0]
    try:
        return _of_record(json.loads(text))
    except json.JSONDecodeError:
        return _of_record(json.loads(first))


def _of_record(record: Any) -> Content | None:
    if isinstance(record, list):
        inner = _of_record(record[0]) if record else None
        if inner is None or inner.format != "TuSimple":
            return None
        return inner._replace(remedy="TuSimple's records as one JSON list: write one record on each line")
    if not isinstance(record, Mapping):
        return None
    if "raw_file" in record:
        labelled = "h_samples" in record and "run_time" not in record
        return Content("TuSimple", "ground truth" if labelled else "predictions")
    if "GTs" in record:
        return Content("MapTR", "ground truth")
    if "annotation" in record:
        task: Format | None = _task(record["annotation"]) or "OpenLane-V2 centerlines"
        return Content(task, "ground truth", "the annotations of one frame: give the folder of all frames")
    if "frames" in record:
        return _of_frames(record["frames"])
    if isinstance(record.get("results"), list):
        return Content("MapTR", "predictions")
    if isinstance(results := record.get("results"), Mapping):
        task = next((_task(frame.get("predictions")) for frame in results.values()), None)
        return Content(task, "predictions") if task else None
    task = next((_task(frame.get("annotation")) for frame in record.values() if isinstance(frame, Mapping)), None)
    return Content(task, "ground truth") if task else None


def _of_frames(frames: Any) -> Content | None:
    first = frames[0]
    if "lanes" in first:
        remedy = "predictions.json of `tflane predict`, best lanes only: give predictions.npz beside it"
        return Content("plain centerlines", "predictions", remedy)
    if "points" not in first:
        return None
    return Content("plain centerlines", "predictions" if "scores" in first else "ground truth")


def _task(content: Any) -> Format | None:
    return next((task for name, task in _TASKS.items() if isinstance(content, Mapping) and name in content), None)

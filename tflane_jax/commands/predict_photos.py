"""`tflane predict` for lane lines in photos and videos of any size and camera.

predictions.json, and one picture or video (MP4) for each input:
    {"run", "step", "threshold", "complete",
     "photos": [{"file", "width", "height", "picture", "view", "value", "needed", "warning", "lanes": LANES}, ...],
     "videos": [{"file", "width", "height", "rate", "video", "view", "warning", "frames": [LANES, ...]}, ...],
     "faults": [{"file", "error"}, ...]}
    LANES is [{"score", "paint", "points": [[column, row], ...]}, ...]: pixels, from the upper end of a lane to the
    lower end; lanes are in order from left to right. `paint` is the fraction of the lane that lies on paint, `view` the
    part of the photo that the network saw ({"left", "top", "width", "height"}; `top` is negative where black rows were
    added), `value` its plausibility and `needed` from which value it is taken: one limit for the whole photo, seen
    without a search, another for one of the searched views, whose values are of another scale; null where the camera's
    horizon is known or the photo is empty. `faults` are files that could not be read or that the camera does not fit;
    `complete` is false until all others are done.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.commands.sources import make_folder
from tflane_jax.datasets.photos import PhotoCamera, Placement, fit_photo, misfits
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_replaces, write_json
from tflane_jax.files.images import LARGEST_SIDE, PHOTO_SUFFIXES, list_photos, opencv, read_image
from tflane_jax.files.videos import VIDEO_SUFFIXES, read_frames, sample_frames, video_info, writing_video
from tflane_jax.files.wording import check_name, counted, plain_name, short_stem
from tflane_jax.plots.figure import new_figure
from tflane_jax.plots.images import lanes_drawn, save_photo
from tflane_jax.progress import progress_bar
from tflane_jax.runs import Run
from tflane_jax.tasks.photo_lanes import PhotoLanes, PhotoReader

# Frames of a video in which its view is searched, and points of a lane in its record.
_SEARCHED_FRAMES, _VIDEO_POINTS = 4, 20
# Seconds between two states of predictions.json: a run of hours that is killed keeps almost all of its answers. Those
# of a long video take longer to write; then less often, so that writing takes at most this fraction of the time.
_SAVED_EVERY, _SAVING = 10.0, 0.05
# Least fraction of the frames in its header that a whole video has; headers are not exact.
_WHOLE = 0.95


def predict(trained: Run, paths: list[Path], options: argparse.Namespace) -> int:
    """Predict the lane lines in photos and videos; write a picture or video of each, and the points of all.

    A file that cannot be read is recorded and reported, the others are predicted, and the exit code is 2.
    """
    inputs = list(dict.fromkeys(list_photos(paths, (*PHOTO_SUFFIXES, *VIDEO_SUFFIXES))))
    videos = [path for path in inputs if path.suffix.lower() in VIDEO_SUFFIXES]
    photos = [path for path in inputs if path not in videos]
    opencv()  # without it, or matplotlib, every file would be a fault
    if photos:
        new_figure()
    names = dict(zip(inputs, _names(inputs), strict=True))
    check_replaces({options.out / name: path for path, name in names.items()}, inputs)
    camera = None if options.focal is None and options.horizon is None else PhotoCamera(options.focal, options.horizon)
    reader = PhotoReader(trained.config.task, trained.params[0], options.threshold)
    make_folder(options.out)
    head = {"run": trained.name, "step": trained.step, "threshold": options.threshold}
    report = _Report(options.out / "predictions.json", head)
    try:
        for path in progress_bar(photos, desc="predict", unit="photo", disable=not photos):
            report.add("photos", path, lambda _, path=path: _photo(reader, path, options.out / names[path], camera))
        for path in videos:
            report.add(
                "videos",
                path,
                lambda so_far, path=path: _video(reader, path, options.out / names[path], camera, so_far),
            )
        report.content["complete"] = True
    finally:
        report.save()
    records, clips, faults = (report.content[kind] for kind in ("photos", "videos", "faults"))
    for record in (*records, *clips):
        if record["warning"]:
            print(f"tflane: {record['file']}: {record['warning']}", file=sys.stderr)
    lanes = sum(len(record["lanes"]) for record in records)
    found = [f"{counted(lanes, 'lane line')} in {counted(len(records), 'photo')}"] * bool(records)
    found += [
        f"{sum(map(len, clip['frames']))} in {counted(len(clip['frames']), 'frame')} of {clip['file']}"
        for clip in clips
    ]
    if found:
        print(f"{'; '.join(found)}; pictures and predictions.json written to {options.out}")
    for fault in faults:
        file = "" if fault["file"] in fault["error"] else f"{fault['file']}: "
        print(f"tflane: {file}{fault['error']}", file=sys.stderr)
    if faults:
        print(f"tflane: {len(faults)} of {len(inputs)} files have no answer, see above", file=sys.stderr)
    return 2 if faults else 0


SoFar = Callable[[dict[str, Any]], None]
"""Takes the record of a file that is still being read."""


class _Report:
    """The content of predictions.json, written now and then, so that a run that is stopped keeps its answers."""

    def __init__(self, path: Path, head: dict[str, Any]) -> None:
        self.content: dict[str, Any] = head | {"complete": False, "photos": [], "videos": [], "faults": []}
        self._path, self._next = path, time.monotonic() + _SAVED_EVERY

    def add(self, kind: str, path: Path, read: Callable[[SoFar], dict[str, Any]]) -> None:
        """Append what `read` returns, or the fault of its UserError.

        While it reads, `read` may give the record as it is so far.
        """
        records = self.content[kind]
        place = len(records)

        def so_far(record: dict[str, Any]) -> None:
            records[place:] = [record]
            with contextlib.suppress(UserError):  # a full disk is no fault of the file; the save below tells
                self._save_now_and_then()

        try:
            check_name(path)
            records[place:] = [read(so_far)]
        except UserError as error:
            del records[place:]
            self.content["faults"].append({"file": plain_name(path), "error": str(error)})
        self._save_now_and_then()

    def _save_now_and_then(self) -> None:
        if time.monotonic() > self._next:
            self.save()

    def save(self) -> None:
        """Write the file."""
        begun = time.monotonic()
        write_json(self._path, self.content)
        now = time.monotonic()
        self._next = now + max(_SAVED_EVERY, (now - begun) / _SAVING)


def _photo(reader: PhotoReader, path: Path, out: Path, camera: PhotoCamera | None) -> dict[str, Any]:
    photo = read_image(path)
    if max(photo.shape) > LARGEST_SIDE:
        height, width = photo.shape[:2]
        raise UserError(f"{path} has {width} x {height} pixels, more than {LARGEST_SIDE} on a side: make it smaller")
    answer = reader.read(photo, camera)
    count = len(answer.lanes)
    save_photo(out, photo, answer.lanes, f"{path.name}: {counted(count, 'lane line')}")
    height, width = photo.shape[:2]
    size = {"file": str(path), "width": width, "height": height}
    found = {"view": _plain_view(answer.view), "value": round(answer.value, 3), "needed": answer.needed}
    return size | {"picture": out.name} | found | {"warning": answer.warning, "lanes": _plain(answer)}


def _video(reader: PhotoReader, path: Path, out: Path, camera: PhotoCamera | None, so_far: SoFar) -> dict[str, Any]:
    """Write the video with its lanes; all frames are seen in one view, because they have one camera."""
    info = video_info(path)
    some = sample_frames(path, _SEARCHED_FRAMES)
    horizon = None if camera is None else camera.horizon
    known = horizon is not None
    view = fit_photo(some[0], camera).placement if known else reader.find_view(some, camera and camera.focal)
    head = {"file": str(path), "width": info.width, "height": info.height, "rate": info.rate}
    if view is None:
        warning = "no view of its frames shows plausible lanes, and no video is written: give --horizon and --focal"
        return head | {"video": None, "view": None, "warning": warning, "frames": []}
    frames, doubtful = [], 0
    unfinished = head | {
        "video": None,
        "view": _plain_view(view),
        "warning": "not all frames were read",
        "frames": frames,
    }
    of_all = "; ".join(misfits(view, horizon)) if known else ""
    with writing_video(out, info) as writer:
        for frame in progress_bar(read_frames(path), desc=path.name, unit="frame", total=info.frames or None):
            answer = reader.read(frame, camera) if known else reader.read_view(frame, view)
            writer.add(lanes_drawn(frame, answer.lanes))
            frames.append(_plain(answer, _VIDEO_POINTS))
            doubtful += answer.warning not in ("", of_all)
            so_far(unfinished)
    few = f"{doubtful} of {len(frames)} frames are doubtful or empty" if doubtful else ""
    cut = len(frames) < _WHOLE * info.frames
    lost = f"only {len(frames)} of {info.frames} frames could be read: is the file whole?" if cut else ""
    warning = "; ".join(filter(None, (of_all, few, lost)))
    return head | {"video": out.name, "view": _plain_view(view), "warning": warning, "frames": frames}


def _plain(answer: PhotoLanes, points: int | None = None) -> list[dict[str, Any]]:
    records = []
    for lane, score, paint in zip(answer.lanes, answer.scores, answer.paint, strict=True):
        kept = lane if points is None else lane[np.linspace(0, len(lane) - 1, min(points, len(lane))).astype(int)]
        records.append({"score": score, "paint": round(paint, 3), "points": np.round(kept, 2).tolist()})
    return records


def _plain_view(view: Placement) -> dict[str, int]:
    return {"left": view.left, "top": view.top, "width": view.width, "height": view.height}


def _names(inputs: list[Path]) -> list[str]:
    """Return a file name for each input's picture; of equal names, all but the first get numbers, long ones are cut."""
    taken: set[str] = set()
    names = []
    for path in inputs:
        suffix = ".mp4" if path.suffix.lower() in VIDEO_SUFFIXES else ".png"
        name = short_stem(path)
        stems = itertools.chain([name], (f"{name}-{count}" for count in itertools.count(2)))
        stem = next(stem for stem in stems if stem.lower() not in taken)  # some file systems ignore case
        taken.add(stem.lower())
        names.append(f"{stem}-lanes{suffix}")
    return names

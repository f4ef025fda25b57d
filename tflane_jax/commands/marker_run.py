"""`tflane markers run`: reads a drive (`datasets.drive_files`) and a store, writes pictures and frames.json.

frames.json:
    {"store", "model", "threshold", "complete",
     "frames": [{"timestamp_ns", "picture", "lanes_dropped", "gate", "remembered",
     "boards": [{"id", "outcome", "score", "size", "position", "distance", "camera", "corners", "residual",
                 "confidence"}, ...],
     "guidance": [{"weight", "points": [[x, y], ...]}, ...],
     "lanes": [{"query", "score", "points": [[x, y, z], ...]}, ...]}, ...],
     "faults": [{"file", "error"}, ...]}
    "complete" is false if an error ended the command, and the frames are those before it.
    "lanes_dropped" counts lanes of the boards that the prior does not take. "outcome" is one of
    `markers.observe.Outcome`; "residual" and "confidence" exist for boards that give a prior. "lanes" exist with a
    model, as in predictions.json (`commands.predict_lanes`). An id that was read at two places has two entries.
    Coordinates are in the ego frame, metres; corners of the black square are pixels of the camera's undistorted image.
    `faults` are images that could not be read; their cameras saw nothing in that frame.
"""

from __future__ import annotations

import argparse
import datetime
import math
import sys
import warnings
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from tflane_jax.commands.marker_store import day_of
from tflane_jax.commands.sources import make_folder
from tflane_jax.datasets.drive_files import Drive, load_drive, thinned
from tflane_jax.datasets.marker_cache import search_views
from tflane_jax.datasets.native_views import check_camera_names, fitted_views
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder, check_replaces, write_json
from tflane_jax.files.fields import load_json
from tflane_jax.files.images import opencv
from tflane_jax.geometry import PerceptionRange
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.markers.observe import Outcome
from tflane_jax.markers.reader import MarkerReader, ReaderConfig
from tflane_jax.markers.store import MarkerStore, StaleMarkerWarning, UnknownMarkerWarning
from tflane_jax.markers.store_files import load_store
from tflane_jax.plots import format_table
from tflane_jax.plots.marker_drive import board_outline, frame_title, save_drive_frame
from tflane_jax.progress import progress_bar
from tflane_jax.runs import open_run
from tflane_jax.scene import CameraViews
from tflane_jax.scene.marker_patterns import MarkerFamily, marker_count
from tflane_jax.tasks.answers import answer_arrays, best_first, lane_records
from tflane_jax.tasks.marker_drive import DriveModel, DriveStep, MarkerDrive, as_trained, check_model, check_rate
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Follow a drive: markers, store, confidence, memory and, with a model, lanes.

    An image that cannot be read is recorded and told, and counts as missing; the result is then 2.
    """
    if not 0.0 <= options.threshold <= 1.0:
        raise UserError(f"--threshold {options.threshold:g}: it must be a score from 0 to 1")
    configure_jax()
    check_folder(options.out)
    opencv()  # without it, every image would be a fault
    store, drive = load_store(options.store), load_drive(options.poses, options.images)
    if options.interval is not None:
        if not 0.0 < options.interval < math.inf:
            raise UserError(f"--interval is a positive number of seconds, not {options.interval:g}")
        drive = thinned(drive, options.interval)
    model = None if options.model is None else _model(options.model)
    range_ = PerceptionRange() if model is None else model.source.example.range
    detector = _detector(options, store)
    config = ReaderConfig(detector, range_, today=_day(options), max_age_days=_age(options))
    doubts = [*_without_lanes(store), *_doubtful_dates(store, _day(options), config.max_age_days)]
    doubts += _without_images(drive, options.poses)
    steps = MarkerDrive(MarkerReader(store, as_trained(config, model)), model)
    faults: dict[str, str] = {}
    if model is not None:
        # A model that cannot read these images is refused before they are searched, which takes seconds each.
        check_camera_names([camera.name for camera in drive.cameras], model.source)
        fitted_views(drive.views(drive.frames[0], faults), model.source)
    times = [frame.timestamp_ns for frame in drive.frames]
    _check_replaces(drive, options)
    check_rate(times, steps.interval if steps.remembers else None, steps.reader.config.residual_interval)
    make_folder(options.out)
    _remove_pictures(options.out, {image for frame in drive.frames for image in frame.images.values()})
    frames: list[dict[str, Any]] = []
    head = {"store": str(options.store), "model": None if options.model is None else str(options.model)}
    head |= {"threshold": options.threshold}
    try:
        _follow(drive, steps, detector, range_, faults, options, frames)
    finally:
        told = [{"file": file, "error": error} for file, error in faults.items()]
        complete = len(frames) == len(drive.frames)
        write_json(options.out / "frames.json", head | {"complete": complete, "frames": frames, "faults": told})
    outcomes = Counter(board["outcome"] for frame in frames for board in frame["boards"])
    boards = {f"boards {name}": outcomes[name] for name in get_args(Outcome)}
    guided = sum(bool(frame["guidance"]) for frame in frames)
    remembered = sum(frame["remembered"] for frame in frames)
    lanes = {"lanes dropped": sum(frame["lanes_dropped"] for frame in frames)}
    rows = [{"frames": len(frames), "with lanes": guided, "from memory": remembered} | boards | lanes]
    print(format_table(rows, title=f"{options.poses}: markers of {options.store}"))
    print(f"\nwritten to {options.out}")
    for text in doubts:
        print(f"tflane: warning: {text}", file=sys.stderr)
    for error in faults.values():
        print(f"tflane: {error}", file=sys.stderr)
    if faults:
        print(f"tflane: images of the drive left out: {len(faults)}, see above", file=sys.stderr)
    return 2 if faults else 0


def _follow(
    drive: Drive,
    steps: MarkerDrive,
    detector: DetectorConfig,
    view: PerceptionRange,
    faults: dict[str, str],
    options: argparse.Namespace,
    frames: list[dict[str, Any]],
) -> None:
    """Process all frames and draw each; their records are added to `frames`, images that cannot be read to `faults`."""
    names = [camera.name for camera in drive.cameras]
    with warnings.catch_warnings():
        # The table counts them.
        warnings.simplefilter("ignore", UnknownMarkerWarning)
        warnings.simplefilter("ignore", StaleMarkerWarning)
        for number, frame in enumerate(progress_bar(drive.frames, desc="drive", unit="frame")):
            views = drive.views(frame, faults)
            step = steps.step(views, frame.timestamp_ns, frame.global_from_ego, search_views(views, detector))
            picture = _picture(number)
            save_drive_frame(
                options.out / picture,
                views,
                step.reading.detected,
                step.reading.observed.outcomes,
                _confidence(step),
                step.guidance,
                None if step.prediction is None else step.prediction.lanes,
                view=view,
                names=names,
                title=frame_title(number, step.guidance, remembered=step.remembered),
                threshold=options.threshold,
            )
            record = {"timestamp_ns": frame.timestamp_ns, "picture": picture}
            record["lanes_dropped"] = _lanes_dropped(step, steps.most_lanes)
            frames.append(record | _record(step, views, names, options.threshold))


def _lanes_dropped(step: DriveStep, most: int) -> int:
    """Return how many lanes of a frame's boards are left out: beyond the capacity of a board, and of the prior."""
    markers = step.reading.observed.markers
    found = int((np.asarray(markers.lane_valid) & np.asarray(markers.valid)[:, None]).sum())
    return step.reading.observed.lanes_dropped + max(found - most, 0)


def _picture(number: int) -> str:
    return f"{number:03d}.png"


def _check_replaces(drive: Drive, options: argparse.Namespace) -> None:
    """Raise UserError if the pictures or frames.json would replace what is read."""
    written = [options.out / name for name in ("frames.json", *map(_picture, range(len(drive.frames))))]
    images = [image for frame in drive.frames for image in frame.images.values()]
    poses: Path = options.poses
    check_replaces(dict.fromkeys(written, poses), [poses, options.store, *images])


def _remove_pictures(folder: Path, kept: Collection[Path]) -> None:
    """Remove the pictures of an earlier drive that its frames.json names; those of two drives would mix."""
    record = folder / "frames.json"
    if not record.is_file():
        return
    try:
        content = load_json(record)
    except UserError:  # not of this command
        return
    frames, read = content.get("frames") if isinstance(content, dict) else None, {path.resolve() for path in kept}
    for number, frame in enumerate(frames if isinstance(frames, list) else ()):
        path = folder / _picture(number)
        if isinstance(frame, dict) and frame.get("picture") == path.name and path.resolve() not in read:
            path.unlink(missing_ok=True)


def _model(folder: Path) -> DriveModel:
    trained = open_run(folder)
    return DriveModel(check_model(trained.config.task), trained.params[0], trained.config.data.source("test"))


def _detector(options: argparse.Namespace, store: MarkerStore) -> DetectorConfig:
    if options.family not in MarkerFamily.__members__:
        raise UserError(f"there is no marker family {options.family}: one of {', '.join(MarkerFamily.__members__)}")
    family = MarkerFamily[options.family]
    largest = marker_count(family) - 1
    if (last := max(store.markers, default=0)) > largest:
        raise UserError(
            f"{store.source} holds marker {last}, and ids of {family.name} end at {largest}: give the family of these "
            "boards with --family"
        )
    # On a partly hidden board only these ids are searched; whole boards are read with any id.
    return DetectorConfig(family, search=options.search, ids=tuple(sorted(store.markers)))


def _day(options: argparse.Namespace) -> datetime.date:
    return day_of(options.today, "--today") or datetime.date.today()


def _without_lanes(store: MarkerStore) -> list[str]:
    """Return a sentence for a store that can guide no frame."""
    if any(len(entry.lanes) for entry in store.markers.values()):
        return []
    what = f"its {len(store.markers)} markers have no lanes" if store.markers else "it holds no marker"
    return [f"{store.source}: {what}, so that no frame gets a prior: is it the right store?"]


def _without_images(drive: Drive, poses: Path) -> list[str]:
    """Return a sentence for cameras that have no image in any frame; raise UserError if none has one."""
    seen = {name for frame in drive.frames for name in frame.images}
    if not seen:
        raise UserError(f"{poses}: no frame names an image: nothing can be searched for markers")
    blind = [camera.name for camera in drive.cameras if camera.name not in seen]
    return [f"{poses}: no frame has an image of {', '.join(blind)}"] if blind else []


def _doubtful_dates(store: MarkerStore, today: datetime.date, max_age_days: int | None) -> list[str]:
    """Return a sentence for entries whose age is unknown where it counts, and one for surveys in the future."""
    told, entries = [], store.markers.values()
    undated = [entry.marker_id for entry in entries if entry.surveyed is None]
    if undated and max_age_days is not None:
        told.append(
            f"{store.source}: {len(undated)} of {len(entries)} markers have no day of survey (first: {undated[0]}), so "
            'they count as stale: write "surveyed" into the store, or leave out --max-age-days'
        )
    future = [entry for entry in entries if entry.surveyed is not None and entry.surveyed > today]
    if future:
        told.append(
            f"{store.source}: {len(future)} of {len(entries)} markers were surveyed after {today} (first: "
            f'{future[0].marker_id} on {future[0].surveyed}): correct "surveyed" in the store, or --today'
        )
    return told


def _age(options: argparse.Namespace) -> int | None:
    if options.max_age_days is not None and options.max_age_days < 0:
        raise UserError(f"--max-age-days is a number of days, not {options.max_age_days}")
    return options.max_age_days


def _confidence(step: DriveStep) -> dict[int, float]:
    """Return the confidence of each id that gives lanes."""
    markers, outcomes = step.reading.observed.markers, step.reading.observed.outcomes
    rows = {int(markers.marker_id[k]): float(step.confidence[k]) for k in np.flatnonzero(markers.valid)}
    return {number: confidence for number, confidence in rows.items() if outcomes[number] == "used"}


def _record(step: DriveStep, views: CameraViews, names: Sequence[str], threshold: float) -> dict[str, Any]:
    """Return a frame as plain values."""
    detected, markers, guidance = step.reading.detected, step.reading.observed.markers, step.guidance
    residual = {int(markers.marker_id[k]): float(markers.residual[k]) for k in np.flatnonzero(markers.valid)}
    confidence = _confidence(step)
    boards = []
    for k in np.flatnonzero(detected.valid).tolist():
        number, position = int(detected.marker_id[k]), detected.pose[k, :3, 3].astype(float)
        prior = {"residual": residual[number], "confidence": confidence[number]} if number in confidence else {}
        boards.append(
            {
                "id": number,
                "outcome": step.reading.observed.outcomes[number],
                "score": round(float(detected.score[k]), 4),
                "size": round(float(detected.size[k]), 4),
                "position": position.round(3).tolist(),
                "distance": round(float(np.hypot(*position[:2])), 3),
                "camera": names[int(detected.camera[k])],
                "corners": board_outline(views, detected, k).round(1).tolist(),
                **{name: round(value, 4) for name, value in prior.items()},
            }
        )
    lanes = [
        {"weight": round(float(guidance.weight[i]), 4), "points": np.asarray(guidance.points[i]).round(3).tolist()}
        for i in np.flatnonzero(guidance.valid)
    ]
    record: dict[str, Any] = {
        "gate": round(float(guidance.gate), 4),
        "remembered": step.remembered,
        "boards": boards,
        "guidance": lanes,
    }
    if step.prediction is not None:
        arrays = {name: np.asarray(array) for name, array in answer_arrays(step.prediction).items()}
        record["lanes"] = lane_records(arrays, best_first(arrays["scores"], threshold))
    return record

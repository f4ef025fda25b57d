"""`tflane submit`: the predictions for all frames of a split in the file of the dataset's own evaluation."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tflane_jax.commands.outputs import check_output, folders_of
from tflane_jax.commands.sources import opened, source_for
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesDataset
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset
from tflane_jax.errors import UserError
from tflane_jax.evaluation.centerlines import detections_of_centerlines
from tflane_jax.evaluation.geometric_topology import Topology
from tflane_jax.evaluation.interventions import with_traffic
from tflane_jax.evaluation.lane_segments import detections_of_segments
from tflane_jax.evaluation.predict import predicted_batches
from tflane_jax.evaluation.vector_maps import detections_of_lines
from tflane_jax.files.wording import counted
from tflane_jax.metrics.map_matching import MapDetections
from tflane_jax.progress import progress_bar
from tflane_jax.runs import Run
from tflane_jax.scene import Prediction
from tflane_jax.scoring import maptr
from tflane_jax.scoring.submission import (
    Author,
    best_lanes,
    best_segments,
    centerline_record,
    segment_record,
    write_submission,
)
from tflane_jax.startup import showing, stage
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.runtime import configure_jax

_OF_SERVER = ("method", "authors", "email", "institution", "country", "team", "most_lanes", "most_elements")
_LARGEST = 500e6
"""Bytes that OpenLane-V2's server takes, as people who used it told in 2023 (its issue 26)."""


def run(options: argparse.Namespace) -> int:
    """Predict all frames of the split and write the submission."""
    check_output(options.out)
    for name in ("most_lanes", "most_elements"):
        if (most := getattr(options, name)) is not None and most < 1:
            raise UserError(f"--{name.replace('_', '-')} is {most}: expected at least 1")
    configure_jax()
    trained, rest = opened(options)
    if rest:
        raise UserError(f"tflane submit takes one run: leave {rest[0]} out")
    task = trained.config.task
    if not isinstance(task, LaneGraphTask):
        raise UserError("this model finds lanes in one image: OpenLane-V2 and nuScenes have no such task")
    predicts = set(task.model.predicts)
    if options.data is None and options.root is not None:
        options.data = "nuscenes" if "lines" in predicts else "openlane-v2"
    source = source_for(trained, options)
    # Configurations evaluate on the validation split in place of the official test, which has no truth.
    if isinstance(source, OpenLaneV2Config):
        source = replace(source, split=options.split or options.default_split)
    elif isinstance(source, NuScenesConfig) and options.split is not None:
        source = replace(source, split=options.split)
    check_output(options.out, folders_of(source))
    if isinstance(source, OpenLaneV2Config):
        if not {"centerlines", "segments"} & predicts:
            raise UserError("this model predicts neither centerlines nor lane segments: OpenLane-V2 has no other task")
        dataset = OpenLaneV2Dataset(source)
        most = options.most_lanes, options.most_elements
        topology = trained.config.evaluation.topology
        answers = _answers(trained, source, len(dataset))
        found = {dataset.keys[i]: _record(dataset, answer, *most, topology) for i, answer in answers}
        author = Author(
            options.method, tuple(options.authors), options.email, options.institution, options.country, options.team
        )
        _tell_size(write_submission(options.out, found, author))
    elif isinstance(source, NuScenesConfig):
        if given := [name for name in _OF_SERVER if getattr(options, name)]:
            option = f"--{given[0].replace('_', '-')}"
            raise UserError(f"{option} is for OpenLane-V2's server: MapTR's file has no place for it, leave it out")
        if "lines" not in predicts:
            raise UserError("MapTR's file for nuScenes holds lines of a vector map, and this model predicts none")
        dataset = NuScenesDataset(source)
        maptr.write_predictions(options.out, _map_frames(dataset, _answers(trained, source, len(dataset))))
    else:
        raise UserError(
            "frames of OpenLane-V2 and nuScenes alone can be submitted: add --root and the dataset's folder"
        )
    print(f"{counted(len(dataset), 'frame')} of {dataset.name} written to {options.out}")
    return 0


def _answers(trained: Run, source: OpenLaneV2Config | NuScenesConfig, frames: int) -> Iterator[tuple[int, Prediction]]:
    """Yield number and prediction of every frame, in order."""
    task = trained.config.task
    assert isinstance(task, LaneGraphTask)  # only it sees such frames
    with showing(True):
        with stage("reading the data"):
            arrays = with_traffic(task.load(source, progress=True), trained.config.evaluation.traffic)
        batches = predicted_batches(
            task, trained.params[0], arrays, trained.config.evaluation.batch_size, lambda batch: None
        )
        with progress_bar(desc="predict", unit="frame", total=frames) as bar:
            for indices, _, answers in batches:
                for row, index in enumerate(indices):
                    yield int(index), jax.tree.map(lambda leaf, i=row: leaf[i], answers)
                bar.update(len(indices))


def _map_frames(dataset: NuScenesDataset, answers: Iterator[tuple[int, Prediction]]) -> list[tuple[str, MapDetections]]:
    """Return sample tokens with the lines in MapTR's axes, in order of time.

    MapTR's evaluation sorts frames by time and takes the predictions in their order, whatever the tokens say.
    """
    frames = []
    for index, answer in answers:
        assert answer.lines is not None
        found = detections_of_lines(answer.lines)
        points = dataset.in_lidar_axes(index, np.asarray(found.points, float))
        found = MapDetections(points.astype(np.float32), found.classes, found.scores)
        frames.append((dataset.info(index).timestamp_ns, dataset.token(index), found))
    return [(token, found) for _, token, found in sorted(frames, key=lambda frame: frame[0])]


def _tell_size(path: Path) -> None:
    if (size := path.stat().st_size) > _LARGEST:
        print(
            f"tflane: warning: {path} has {size / 1e6:.0f} MB: OpenLane-V2's server was reported to refuse more than "
            f"{_LARGEST / 1e6:.0f}; --most-lanes and --most-elements keep the best of each frame",
            file=sys.stderr,
        )


def _record(
    dataset: OpenLaneV2Dataset,
    answer: Prediction,
    most_lanes: int | None,
    most_elements: int | None,
    topology: Topology = "learned",
) -> dict[str, Any]:
    """Return the best predictions of a frame; a model of both kinds of lanes submits its segments.

    Edges between lanes are those that `tflane eval` measures: with the topology "geometric", the sum of learned and
    geometric confidence, up to 2.
    """
    elements = answer.elements
    if elements is not None:
        boxes = dataset.in_files(np.asarray(elements.box))
        elements = elements.replace(box=boxes)  # pyright: ignore[reportAttributeAccessIssue]
    if answer.segments is not None:
        crossings = "sides" if answer.segments.areas is None else "ring"
        found = detections_of_segments(answer.segments, elements, topology)
        return segment_record(best_segments(found, most_lanes, most_elements), crossings)
    assert answer.centerlines is not None
    found = detections_of_centerlines(answer.centerlines, elements, topology)
    return centerline_record(best_lanes(found, most_lanes, most_elements))

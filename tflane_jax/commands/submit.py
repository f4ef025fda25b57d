"""`tflane submit`: the predictions for all frames of an OpenLane-V2 split, as its server takes them."""

from __future__ import annotations

import argparse
from typing import Any

import jax
import numpy as np

from tflane_jax.commands.sources import chosen_source, opened
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset
from tflane_jax.errors import UserError
from tflane_jax.evaluation.centerlines import detections_from_prediction
from tflane_jax.evaluation.lane_segments import detections_of_segments
from tflane_jax.evaluation.predict import predicted_batches
from tflane_jax.files.atomic import check_writable
from tflane_jax.progress import progress_bar
from tflane_jax.scene import Prediction
from tflane_jax.scoring.submission import Author, centerline_record, segment_record, write_submission
from tflane_jax.startup import showing, stage
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Predict all frames of the split and write the submission."""
    check_writable(options.out)
    configure_jax()
    trained, rest = opened(options)
    if rest:
        raise UserError(f"tflane submit takes one run: leave {rest[0]} out")
    if options.data is None and options.root is not None:
        options.data = "openlane-v2"
    source = chosen_source(trained.config, options)
    if not isinstance(source, OpenLaneV2Config):
        raise UserError("only frames of OpenLane-V2 can be submitted: add --root and the dataset's folder")
    dataset, task = OpenLaneV2Dataset(source), trained.config.task
    assert isinstance(task, LaneGraphTask)  # only it sees such frames
    if not {"centerlines", "segments"} & set(task.model.predicts):
        raise UserError("this model predicts neither centerlines nor lane segments: OpenLane-V2 has no other task")
    records = {}
    with showing(True):
        with stage("reading the data"):
            arrays = task.load(source, progress=True)
        batches = predicted_batches(
            task, trained.params[0], arrays, trained.config.evaluation.batch_size, lambda batch: None
        )
        with progress_bar(desc="predict", unit="frame", total=len(dataset)) as bar:
            for indices, _, answers in batches:
                for row, index in enumerate(indices):
                    answer = jax.tree.map(lambda leaf, i=row: leaf[i], answers)
                    records[dataset.keys[index]] = _record(dataset, answer)
                bar.update(len(indices))
    author = Author(options.method, tuple(options.authors), options.email, options.institution, options.country)
    write_submission(options.out, records, author)
    print(f"{len(records)} frames of {dataset.name} written to {options.out}")
    return 0


def _record(dataset: OpenLaneV2Dataset, answer: Prediction) -> dict[str, Any]:
    """Return the predictions of a frame; a model of both kinds of lanes submits its segments."""
    elements = answer.elements
    if elements is not None:
        boxes = dataset.in_files(np.asarray(elements.box))
        elements = elements.replace(box=boxes)  # pyright: ignore[reportAttributeAccessIssue]
    if answer.segments is not None:
        return segment_record(detections_of_segments(answer.segments, elements))
    assert answer.centerlines is not None
    return centerline_record(detections_from_prediction(answer.centerlines, elements))

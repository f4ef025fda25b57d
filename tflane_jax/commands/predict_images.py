"""`tflane predict` for lane lines in the images of a split.

Written are pictures.png, and predictions.json and truth.json in TuSimple's format (one record per line), which
`tflane score tusimple` reads.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tflane_jax.commands.predict_lanes import MOST_DRAWN
from tflane_jax.commands.sources import chosen_source, make_folder, model_title
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import spread
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import delete_older, write_text
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.files.wording import counted
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.images import save_road_images
from tflane_jax.runs import Run
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_shape import found_lanes, predict_curves


def predict_split(trained: Run, options: argparse.Namespace) -> int:
    """Predict the lane lines in some images of a split; write predictions and ground truth."""
    source = chosen_source(trained.config, options)
    root: Path | str | None = getattr(source, "root", None)  # generated images have none
    if root is not None and not Path(root).is_dir():
        raise UserError(f"there is no folder {root}: name that of the data with --root, or name photos or videos")
    dataset = sources.open_dataset(source)
    if len(dataset) == 0:
        raise UserError(f"nothing to predict: {dataset.name} has no images")
    indices = spread(len(dataset), options.count)
    examples = stack_examples([dataset.example(index) for index in indices])
    answers = predict_curves(trained.config.task, trained.params[0], examples, at_once=min(16, len(examples.image)))
    make_folder(options.out)
    predictions, truths = [], []
    for i, index in enumerate(indices):
        truth = dataset.truth(index)
        found = found_lanes(jax.tree.map(lambda leaf, i=i: leaf[i], answers), truth, options.threshold)
        name = dataset.info(index).scene
        truths.append({"raw_file": name, "lanes": _plain(truth), "h_samples": np.asarray(truth.rows).tolist()})
        predictions.append({"raw_file": name, "lanes": _plain(found), "run_time": 0.0})
    write_text(options.out / "predictions.json", _rows(predictions))
    delete_older(options.out, "truth.json", "pictures.png")  # the disk may fill up
    write_text(options.out / "truth.json", _rows(truths))
    if drawn := can_draw():
        title, rows = model_title(trained), spread(len(indices), MOST_DRAWN)
        examples, answers = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], (examples, answers))
        names = [dataset.info(indices[row]).scene for row in rows]
        pictures = options.out / "pictures.png"
        save_road_images(pictures, examples, {title: answers}, titles=names, threshold=options.threshold)
    lines = sum(len(row["lanes"]) for row in predictions)
    found = f"{counted(len(indices), 'image')}, {counted(lines, 'lane line')} with a score of at least"
    hint = "" if lines else " (choose a lower --threshold to see more)"
    files = "predictions.json, truth.json" + ", pictures.png" * drawn
    print(f"{found} {options.threshold:g}{hint}; written to {options.out}: {files}")
    return 0


def _rows(records: list[dict[str, Any]]) -> str:
    return "".join(json.dumps(record) + "\n" for record in records)


def _plain(lanes: RowLanes) -> list[list[float]]:
    return np.round(lanes.x, 3).tolist()

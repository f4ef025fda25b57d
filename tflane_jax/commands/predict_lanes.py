"""`tflane predict` for lanes around the vehicle: predictions as arrays, as plain JSON, and as pictures.

predictions.npz, arrays over F frames and Q queries:
    points (F, Q, P, 3), metres, ego frame; scores (F, Q), 0 to 1; successor (F, Q, Q), 0 to 1: [f, i, j] is the score
    that lane j continues lane i; scene (F,) and timestamp_ns (F,) identify the frame. A model with traffic elements
    adds arrays over E element queries: box (F, E, 2, 2), corners in pixels of the front image; attribute_score
    (F, E, 13); element_lane (F, Q, E), 0 to 1: [f, i, e] is the score that element e governs lane i.
    A model of lane segments has their centerlines in `points` and adds left, right (F, Q, P, 3) and category (F, Q),
    0 lane segment, 1 crossing; one with line types adds left_type, right_type (F, Q), 0 none, 1 solid, 2 dashed.
    A model of the lines of a vector map has these in `points`, as (F, Q, P, 2) if it predicts no heights, adds category
    (F, Q), 0 divider, 1 crossing, 2 boundary, 3 centerline, and has no successor.
truth.npz, the ground-truth lanes, segments or labelled lines of the same frames over G slots:
    points (F, G, P, 3), successor (F, G, G) or category (F, G), valid (F, G), visibility (F, G), scene and
    timestamp_ns. Lines add dense (F, G, S, 3), what the evaluation measures. `tflane score` reads both files, but not
    those of lines.

predictions.json, lanes with a score of at least `threshold`, best first:
    {"run", "step", "seed", "threshold", "frames": [{"source", "scene", "timestamp_ns",
     "lanes": [{"query", "score", "points": [[x, y, z], ...]}, ...],
     "successors": [{"from": position in lanes, "to": position in lanes, "score"}, ...],
     "elements": [{"query", "score", "attribute", "box": [[left, top], [right, bottom]]}, ...],
     "governs": [{"element": position in elements, "lane": position in lanes, "score"}, ...]}, ...]}
    Lane segments add "left", "right", "category" and, with line types, "left_type" and "right_type"; lines add
    "category". A line has its best class here, where pictures and scores take every pair of query and class.
    Relations have a score of at least 0.5. "elements" and "governs" exist if the model predicts traffic elements.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float

from tflane_jax.commands.sources import limited_task, make_folder, model_title, source_for
from tflane_jax.commands.views import with_images
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import Dataset, FrameInfo, spread
from tflane_jax.datasets.data_source import LaneGraphSource
from tflane_jax.datasets.procedural import SimulatedDataset
from tflane_jax.errors import UserError
from tflane_jax.evaluation.geometric_topology import Topology, edge_confidences
from tflane_jax.evaluation.interventions import dataset_with_traffic
from tflane_jax.evaluation.predict import predict_examples
from tflane_jax.files.atomic import delete_older, write_json
from tflane_jax.files.npz import write_npz
from tflane_jax.files.wording import counted
from tflane_jax.plots import save_camera_views, save_examples
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.segments import true_lanes
from tflane_jax.runs import Run
from tflane_jax.scene import Example, LanePrediction, LinePrediction, Prediction
from tflane_jax.tasks.answers import answer_arrays, best_first, lane_records
from tflane_jax.tasks.lane_pictures import titles

_RELATION_THRESHOLD = 0.5
MOST_DRAWN = 16
"""Frames in a picture, spread evenly over those that are predicted: a picture of a whole split cannot be drawn."""


def predict(trained: Run, options: argparse.Namespace) -> int:
    """Predict some examples of a split with the first seed, and write all files to --out."""
    task = limited_task(trained, options) or trained.config.task
    source = source_for(trained, options)
    if options.cameras and not isinstance(plain := sources.make_dataset(source), SimulatedDataset):
        raise UserError(f"--cameras renders scenes of the built-in world, and {plain.name} has none: leave it out")
    evaluation = trained.config.evaluation
    dataset = sources.open_dataset(source)
    if len(dataset) == 0:
        raise UserError(f"nothing to predict: {dataset.name} has no examples")
    if evaluation.traffic != "own":
        print(f"as `tflane eval` of this run: evaluation.traffic is {evaluation.traffic}, also in the pictures")
        dataset = cast(Dataset, dataset_with_traffic(dataset, evaluation.traffic))
    indices = spread(len(dataset), options.count)
    examples, answer = predict_examples(task, trained.params[0], dataset, indices)
    infos = [dataset.info(index) for index in indices]
    arrays = _arrays(answer, infos, evaluation.topology)
    frames = [
        _frame(info, {name: array[i] for name, array in arrays.items()}, options.threshold)
        for i, info in enumerate(infos)
    ]

    make_folder(options.out)
    write_npz(options.out / "predictions.npz", arrays)
    delete_older(options.out, "truth.npz", "predictions.json", "pictures.png", "cameras.png")  # the disk may fill up
    truth = _truth(examples, answer.lanes, arrays)
    if truth is not None:
        write_npz(options.out / "truth.npz", truth | {name: arrays[name] for name in ("scene", "timestamp_ns")})
    head = {"run": trained.name, "step": trained.step, "seed": trained.config.training.seeds[0]}
    write_json(options.out / "predictions.json", head | {"threshold": options.threshold, "frames": frames})
    pictures = _draw(options, source, dataset, indices, examples, answer, model_title(trained))

    written = ", ".join(["predictions.npz", *(["truth.npz"] if truth else []), "predictions.json", *pictures])
    lanes = sum(len(frame["lanes"]) for frame in frames)
    found = f"{counted(len(indices), 'frame')}, {counted(lanes, 'lane')} with a score of at least {options.threshold:g}"
    highest = arrays["scores"].max(initial=0.0)
    best = "" if lanes else f" (best {highest:.2g}: choose a lower --threshold to see it)"
    print(f"{found}{best}; written to {options.out}: {written}")
    return 0


def _arrays(answer: Prediction, infos: Sequence[FrameInfo], topology: Topology = "learned") -> dict[str, np.ndarray]:
    """Return the arrays of predictions.npz; edges between lanes are those that `tflane eval` measures."""
    arrays, lanes = answer_arrays(answer), answer.lanes
    if topology == "geometric" and not isinstance(lanes, LinePrediction) and lanes.successor_logits is not None:
        pairs = zip(lanes.points, lanes.successor_logits, strict=True)
        arrays["successor"] = np.stack([edge_confidences(*each, topology) for each in pairs])
    arrays["scene"] = np.array([info.scene for info in infos])
    arrays["timestamp_ns"] = np.array([info.timestamp_ns for info in infos], np.int64)
    return arrays


def _draw(
    options: argparse.Namespace,
    source: LaneGraphSource,
    dataset: Dataset,
    indices: Sequence[int],
    examples: Example,
    answer: Prediction,
    label: str,
) -> list[str]:
    """Draw some of the frames, and the camera views of those that have images; return the names of the files.

    Without matplotlib there are none, and a line tells.
    """
    if not can_draw():
        return []
    rows = spread(len(indices), MOST_DRAWN)
    drawn = [indices[row] for row in rows]
    examples, lanes, elements = jax.tree.map(
        lambda leaf: np.asarray(leaf)[rows], (examples, answer.lanes, answer.elements)
    )
    names = titles(dataset, drawn)
    look = {"ground": source.example.ground, "view": source.example.range, "threshold": options.threshold}
    save_examples(options.out / "pictures.png", examples, {label: lanes}, titles=names, **look)
    shown, examples = with_images(examples, source, drawn, rendered=options.cameras)
    if not shown:
        return ["pictures.png"]
    lanes, elements = jax.tree.map(lambda leaf: np.asarray(leaf)[shown], (lanes, elements))
    save_camera_views(options.out / "cameras.png", examples, lanes, elements, titles=[names[i] for i in shown], **look)
    return ["pictures.png", "cameras.png"]


def _truth(examples: Example, lanes: LanePrediction, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray] | None:
    """Return the arrays of truth.npz but for the names of the frames; None for lines that are not labelled."""
    if isinstance(lanes, LinePrediction):
        true, kept = examples.map_lines, ["points", "category", "valid", "visibility", "dense"]
    else:
        true, kept = true_lanes(examples, lanes), ["points", "successor", "valid", "visibility"]
        kept += [name for name in ("left", "right", "left_type", "right_type") if name in arrays]
    if true is None:
        return None
    return {name: np.asarray(getattr(true, name)) for name in kept if getattr(true, name) is not None}


def _frame(info: FrameInfo, arrays: dict[str, np.ndarray], threshold: float) -> dict[str, Any]:
    """Return one frame as plain values; `arrays` are those of predictions.npz for this frame."""
    kept = best_first(arrays["scores"], threshold)
    frame: dict[str, Any] = {
        "source": info.source,
        "scene": info.scene,
        "timestamp_ns": int(info.timestamp_ns),
        "lanes": lane_records(arrays, kept),
    }
    if "successor" in arrays:
        frame["successors"] = _relations(arrays["successor"][np.ix_(kept, kept)], "from", "to")
    if "box" in arrays:
        best = arrays["attribute_score"].max(-1)
        shown = best_first(best, threshold)
        frame["elements"] = [
            {
                "query": int(e),
                "score": float(best[e]),
                "attribute": int(arrays["attribute_score"][e].argmax()),
                "box": arrays["box"][e].tolist(),
            }
            for e in shown
        ]
        frame["governs"] = _relations(arrays["element_lane"][np.ix_(kept, shown)].T, "element", "lane")
    return frame


def _relations(scores: Float[np.ndarray, "a b"], first: str, second: str) -> list[dict[str, Any]]:
    pairs = np.argwhere(scores >= _RELATION_THRESHOLD).tolist()
    return [{first: i, second: j, "score": float(scores[i, j])} for i, j in pairs]

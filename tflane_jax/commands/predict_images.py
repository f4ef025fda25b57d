"""`tflane predict` for lane lines in one image.

Photos: predictions.json, and one picture for each photo:
    {"model", "step", "photos": [{"file", "width", "height", "picture",
     "lanes": [{"score", "points": [[column, row], ...]}, ...]}, ...]}
    Points are in pixels of the photo, from the upper end of a lane to the lower end; lanes are in order from left to
    right.

Examples of a split: pictures.png, and predictions.json and truth.json in TuSimple's format (one record per line), which
`tflane score tusimple` reads.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from tflane_jax.commands.sources import chosen_source, make_folder
from tflane_jax.datasets import sources
from tflane_jax.datasets.photos import PhotoCamera, fit_photo
from tflane_jax.errors import UserError
from tflane_jax.evaluation import lane_shapes
from tflane_jax.files.atomic import write_json, write_text
from tflane_jax.files.images import list_photos, read_image
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.plots.images import predicted_lines, save_photo, save_road_images
from tflane_jax.runs import Run
from tflane_jax.scene import LaneLines, RoadImage, stack_examples
from tflane_jax.tasks import spread
from tflane_jax.tasks.lane_shape import found_lanes, predict_curves


def predict_photos(trained: Run, paths: list[Path], options: argparse.Namespace) -> int:
    """Predict the lane lines in photos of any size; write a picture of each, and the points of all."""
    photos = list_photos(paths)
    camera = PhotoCamera(options.focal, options.horizon)
    make_folder(options.out)
    records, names = [], _picture_names(photos)
    for path, name in tqdm(list(zip(photos, names, strict=True)), desc="predict", unit="photo"):
        photo = read_image(path)
        fitted = fit_photo(photo, camera)
        example = RoadImage(fitted.image, fitted.image_valid, LaneLines.empty(1, 1))
        stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], example)
        answer = jax.tree.map(lambda leaf: leaf[0], predict_curves(trained.config.task, trained.params[0], stacked))
        lanes = fitted.placement.to_photo(predicted_lines(answer))
        # Predicted lanes may leave the photo; points outside are neither drawn nor written.
        inside = [_inside(lane, photo.shape) for lane in lanes]
        scores = lane_shapes.lane_scores(answer)[lane_shapes.left_to_right(answer)]
        found = [
            {"score": float(s), "points": np.round(lane, 2).tolist()}
            for s, lane in zip(scores, inside, strict=True)
            if len(lane) > 1
        ]
        height, width = photo.shape[:2]
        records.append({"file": str(path), "width": width, "height": height, "picture": name, "lanes": found})
        title = f"{path.name}: {len(found)} lane line{'' if len(found) == 1 else 's'}"
        save_photo(options.out / name, photo, [lane for lane in inside if len(lane) > 1], title)
    head = {"model": trained.name, "step": trained.step}
    write_json(options.out / "predictions.json", head | {"photos": records})
    lanes = sum(len(record["lanes"]) for record in records)
    print(f"{lanes} lane lines in {len(photos)} photos; pictures and predictions.json written to {options.out}")
    return 0


def predict_split(trained: Run, options: argparse.Namespace) -> int:
    """Predict the lane lines in some images of a split; write predictions and ground truth."""
    dataset = sources.open_dataset(chosen_source(trained.config, options))
    if options.count < 1 or len(dataset) == 0:
        raise UserError(f"nothing to predict: {len(dataset)} images, --count {options.count}")
    indices = spread(len(dataset), options.count)
    examples = stack_examples([dataset.example(index) for index in indices])
    answers = predict_curves(trained.config.task, trained.params[0], examples)
    make_folder(options.out)
    predictions, truths = [], []
    for i, index in enumerate(indices):
        truth = dataset.truth(index)
        found = found_lanes(jax.tree.map(lambda leaf, i=i: leaf[i], answers), truth)
        name = dataset.info(index).scene
        truths.append({"raw_file": name, "lanes": _plain(truth), "h_samples": np.asarray(truth.rows).tolist()})
        predictions.append({"raw_file": name, "lanes": _plain(found), "run_time": 0.0})
    for name, rows in (("predictions.json", predictions), ("truth.json", truths)):
        write_text(options.out / name, "".join(json.dumps(row) + "\n" for row in rows))
    title = f"{Path(trained.name).name}, step {trained.step}"
    names = [dataset.info(index).scene for index in indices]
    save_road_images(options.out / "pictures.png", examples, {title: answers}, titles=names)
    print(f"{len(indices)} images written to {options.out}: predictions.json, truth.json, pictures.png")
    return 0


def _plain(lanes: RowLanes) -> list[list[float]]:
    return np.round(lanes.x, 3).tolist()


def _inside(lane: Float[np.ndarray, "p 2"], shape: tuple[int, ...]) -> Float[np.ndarray, "k 2"]:
    height, width = shape[:2]
    u, v = lane.T
    return lane[(u >= 0) & (u < width) & (v >= 0) & (v < height)]


def _picture_names(photos: list[Path]) -> list[str]:
    """Return a file name for each photo's picture; photos with equal names in different folders get numbers."""
    seen: dict[str, int] = {}
    names: list[Any] = []
    for photo in photos:
        count = seen[photo.stem] = seen.get(photo.stem, 0) + 1
        names.append(f"{photo.stem}-lanes.png" if count == 1 else f"{photo.stem}-{count}-lanes.png")
    return names

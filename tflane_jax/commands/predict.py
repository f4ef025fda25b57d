"""`tflane predict`. For the written files, see `predict_lanes`, `predict_images` and `predict_photos`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tflane_jax.commands import predict_images, predict_lanes, predict_photos
from tflane_jax.commands.sources import opened
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.runtime import configure_jax

# A lane line of LSTR is a query that is more probably a lane than not.
_OF_LANES, _OF_LANE_LINES = 0.3, 0.5
_EXAMPLES = 8


def run(options: argparse.Namespace) -> int:
    """Predict with the first seed, and write all files to --out."""
    configure_jax()
    check_folder(options.out)  # before the weights are read and examples made
    if options.threshold is not None and not 0.0 <= options.threshold <= 1.0:
        raise UserError(f"--threshold {options.threshold:g}: it must be a score from 0 to 1")
    if options.count is not None and options.count < 1:
        raise UserError(f"--count {options.count}: nothing to predict")
    trained, photos = opened(options)
    of_images = isinstance(trained.config.task, LaneShapeTask)
    _check_inputs(options, photos)
    if options.count is None:
        options.count = _EXAMPLES
    if options.threshold is None:
        options.threshold = _OF_LANE_LINES if of_images else _OF_LANES
    if not of_images:
        if photos:
            raise UserError(f"{trained.name} does not read photos: leave {photos[0]} out")
        return predict_lanes.predict(trained, options)
    if options.cameras:
        raise UserError("--cameras draws lanes around the vehicle, and this model finds lane lines in one image")
    if options.max_instances is not None:
        raise UserError("--max-instances limits traffic flow, and this model takes none")
    if photos:
        return predict_photos.predict(trained, photos, options)
    return predict_images.predict_split(trained, options)


def _check_inputs(options: argparse.Namespace, photos: list[Path]) -> None:
    """Raise UserError for options that would have no effect on photos, or without them."""
    names, reason = ("focal", "horizon"), "is of photos: name some, or leave it out"
    if photos:
        names = ("split", "data", "root", "openlane", "data_dict", "count")
        reason = f"selects labelled examples, and {photos[0]} is given too: leave one out"
    for name in names:
        if getattr(options, name) is not None:
            raise UserError(f"--{name.replace('_', '-')} {reason}")

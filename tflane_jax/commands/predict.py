"""`tflane predict`. For the written files, see `predict_lanes` (lanes around the vehicle) and `predict_images`."""

from __future__ import annotations

import argparse

from tflane_jax.commands import predict_images, predict_lanes
from tflane_jax.commands.sources import opened
from tflane_jax.errors import UserError
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Predict with the first seed, and write all files to --out."""
    configure_jax()
    trained, photos = opened(options)
    if not isinstance(trained.config.task, LaneShapeTask):
        if photos:
            raise UserError(f"{trained.name} does not read photos: leave {photos[0]} out")
        return predict_lanes.predict(trained, options)
    if options.max_instances is not None:
        raise UserError("--max-instances limits traffic flow, and this model takes none")
    if photos:
        return predict_images.predict_photos(trained, photos, options)
    return predict_images.predict_split(trained, options)

"""Predicted lane shapes as points in the image, for TuSimple's metric, files and pictures (host, numpy, one image).

Decoding as in LSTR (Liu et al. 2021; docs/reference/lstr.md).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.files.tusimple import NO_POINT, RowLanes
from tflane_jax.geometry.lane_shapes import curve_columns, order_from_left
from tflane_jax.scene import CurvePrediction


def detected(prediction: CurvePrediction, threshold: float | None = None) -> Bool[np.ndarray, " q"]:
    """Return which queries are lanes: those with at least this score; by default, where lane exceeds background."""
    if threshold is not None:
        return np.asarray(prediction.scores) >= threshold
    logits = np.asarray(prediction.logits)
    return logits[..., 1] > logits[..., 0]


def left_to_right(prediction: CurvePrediction, threshold: float | None = None) -> Int[np.ndarray, " l"]:
    """Return the indices of detected queries (see `detected`), from left to right, see `order_from_left`."""
    queries = np.flatnonzero(detected(prediction, threshold))
    return queries[order_from_left(np.asarray(prediction.curves, np.float64)[queries])]


def detections_of_curves(
    prediction: CurvePrediction,
    rows: Float[np.ndarray, " h"],
    *,
    height: float,
    width: float,
    threshold: float | None = None,
) -> RowLanes:
    """Return the detected lanes as x at image rows, -2 outside each lane's extent; columns may lie outside the image.

    Args:
        prediction: one example, one layer, numpy.
        rows: image rows, pixels.
        height, width: of the image, pixels.
        threshold: see `detected`.
    """
    curves = np.asarray(prediction.curves)[detected(prediction, threshold)]
    fraction = np.asarray(rows, np.float32) / height
    columns = curve_columns(curves[:, 2:], fraction[None]) * width
    inside = (fraction >= curves[:, :1]) & (fraction <= curves[:, 1:2])
    return RowLanes(np.where(inside, columns, NO_POINT))

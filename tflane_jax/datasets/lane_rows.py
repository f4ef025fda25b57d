"""TuSimple's labels, one x per image row, as `LaneLines` and back.

`LaneLines` made here always have the 56 rows of TuSimple's test set: 160, 170, ..., 710 of 720.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.files.tusimple import NO_POINT, ROWS, SIZE, RowLanes
from tflane_jax.scene import LaneLines, RoadImage

_HEIGHT, _WIDTH = SIZE


@dataclass(frozen=True)
class LabelledImages:
    """A split of road images.

    Attributes:
        images: stacked along a new first axis, or read by workers while they are used.
        truth: labels of each image for TuSimple's metric, with the size of the image.
    """

    images: RoadImage | Streamed
    truth: Sequence[RowLanes]


def lane_lines(truth: RowLanes, *, height: int, width: int, capacity: int = 8) -> LaneLines:
    """Return labels as lines with points at `ROWS`, sorted from left to right by each line's first point.

    Labels at other rows, or of images of another height, are interpolated between neighbouring labelled rows. Lanes
    without a point are dropped. Of more lines than `capacity`, those with the fewest points are left out with a
    `TruncationWarning`.

    Args:
        truth: x in pixels, with its rows.
        height, width: size of the image, pixels.
        capacity: number of lines that the result has room for.
    """
    assert truth.rows is not None, "labels have rows"
    x, valid = _at_rows(truth, ROWS * (height / _HEIGHT))
    kept = np.flatnonzero(valid.any(1))
    if len(kept) > capacity:
        message = f"an image has {len(kept)} lines and room for {capacity}: raise `capacity`"
        warnings.warn(message, TruncationWarning, stacklevel=2)
        kept = kept[np.argsort(-valid[kept].sum(1), kind="stable")[:capacity]]
    first = x[kept, valid[kept].argmax(1)]
    kept = kept[np.argsort(first, kind="stable")]
    lines = LaneLines.empty(capacity, len(ROWS))
    n = len(kept)
    lines.points[..., 1] = ROWS / _HEIGHT
    lines.points[:n, :, 0] = np.where(valid[kept], x[kept] / width, 0.0)
    lines.point_valid[:n] = valid[kept]
    lines.valid[:n] = True
    return lines


def row_lanes(lines: LaneLines, height: float = _HEIGHT, width: float = _WIDTH) -> RowLanes:
    """Return lines whose point p is at `ROWS[p]` as TuSimple's metric reads them, in pixels of an image of that size.

    Points left of the image are absent, because the metric reads a negative x as "no point". Raises ValueError for a
    point at another row, for example in augmented lines.
    """
    points = np.asarray(lines.points, np.float64)[np.asarray(lines.valid)]
    valid = np.asarray(lines.point_valid)[np.asarray(lines.valid)]
    u, v = points[..., 0], points[..., 1]
    if valid.shape[1] != len(ROWS) or (valid & ~(np.abs(v * _HEIGHT - ROWS) < 0.01)).any():
        raise ValueError("the lines' points do not stand at TuSimple's rows: give lines that were not augmented")
    x = np.where(valid & (u >= 0.0), u * width, NO_POINT)
    return RowLanes(x, ROWS * (height / _HEIGHT), size=(height, width))


def _at_rows(
    truth: RowLanes, rows: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "l p"], Bool[np.ndarray, "l p"]]:
    """Return x (L, P) of the lanes at other rows, and its mask."""
    assert truth.rows is not None
    order = np.argsort(truth.rows, kind="stable")
    labelled = np.asarray(truth.rows, np.float64)[order]
    x = np.asarray(truth.x, np.float64)
    if len(labelled) == 0 or len(x) == 0:
        return np.zeros((len(x), len(rows))), np.zeros((len(x), len(rows)), bool)
    x = x[:, order]
    below = np.searchsorted(labelled, rows).clip(max=len(labelled) - 1)
    above = np.maximum(below - 1, 0)
    exact = labelled[below] == rows
    between = (labelled[above] < rows) & (rows < labelled[below])
    fraction = (rows - labelled[above]) / np.where(between, labelled[below] - labelled[above], 1.0)
    mixed = (1.0 - fraction) * x[:, above] + fraction * x[:, below]
    present = x >= 0.0
    valid = present[:, below] & (exact | (between & present[:, above]))
    return np.where(exact, x[:, below], mixed), valid

"""TuSimple lane metrics: accuracy, false positives and false negatives (docs/reference/metrics.md, section 5).

Five official rules surprise, and are kept: rows without a point on both sides count as hits; a prediction may match
several lanes, so that false positives can be negative; an image with more than two lanes beyond the true ones counts as
one without lanes; with more than four lanes, one may be missed without a penalty; with six or more lanes the accuracy
can exceed 1.
"""

from __future__ import annotations

from typing import Self

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.metrics.merging import joined

PIXEL_THRESHOLD = 20.0  # across the lane
MATCHED = 0.85  # least fraction of rows
OFFICIAL_TIME_LIMIT, LSTR_TIME_LIMIT = 200.0, 20_000.0  # milliseconds
MORE_LANES = 2  # an image with more lanes beyond the true ones counts as missed
_ABSENT = -100.0
_LANES = 4  # the lines of the ego lane and of its neighbours


class TuSimpleMetrics:
    """Accumulator of the TuSimple metrics over images; it keeps three numbers of each image.

    Args:
        time_limit: milliseconds; an image that took longer counts as missed. 200 officially, 20,000 in LSTR's copy.
            Detections without a time (`run_time` 0) are never late.
    """

    def __init__(self, time_limit: float = OFFICIAL_TIME_LIMIT) -> None:
        self.time_limit = time_limit
        self._frames = self._timed = 0
        self._sums = np.zeros(3)
        self._images: list[tuple[float, float, float]] = []

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers; whether the time limit was applied."""
        return f"TuSimple, {self.time_limit:g} ms an image" if self._timed else "TuSimple, time not measured"

    def update(self, detections: RowLanes, truth: RowLanes) -> None:
        """Add one image; raise UserError for arrays that do not fit together."""
        self._images.append(score_image(detections, truth, self.time_limit))
        self._sums += self._images[-1]
        self._frames += 1
        self._timed += detections.run_time > 0.0

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the images of all, in this order (none changes)."""
        for other in others:
            if self.time_limit != other.time_limit:
                limits = f"{self.time_limit:g} and {other.time_limit:g} ms"
                raise UserError(f"cannot merge scores of TuSimple with limits of {limits} an image: use one time limit")
        merged = type(self)(self.time_limit)
        for name in vars(self).keys() - {"time_limit"}:
            setattr(merged, name, joined([getattr(each, name) for each in (self, *others)]))
        return merged

    def compute(self) -> dict[str, float]:
        """Return `frames`, and the means over images of `Accuracy`, `FP` and `FN` (0 without images)."""
        accuracy, positives, negatives = (self._sums / max(self._frames, 1)).tolist()
        return {"frames": self._frames, "Accuracy": accuracy, "FP": positives, "FN": negatives}

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return the scores, which are means over images: the score of each image, and 1."""
        images = np.array(self._images).reshape(-1, 3)
        return {
            name: np.column_stack([column, np.ones(len(images))])
            for name, column in zip(("Accuracy", "FP", "FN"), images.T, strict=True)
        }


def score_image(
    detections: RowLanes, truth: RowLanes, time_limit: float = OFFICIAL_TIME_LIMIT
) -> tuple[float, float, float]:
    """Return accuracy, fraction of false positives and fraction of missed lanes of one image."""
    if truth.rows is None:
        raise UserError("truth: the rows (h_samples) of the lanes are missing")
    rows = np.asarray(truth.rows, np.float64)
    what = detections.place or "detections"
    true, found = _checked(truth.x, len(rows), truth.place or "truth"), _checked(detections.x, len(rows), what)
    if detections.rows is not None and not np.array_equal(detections.rows, rows):
        own, right = (_range(r) for r in (detections.rows, rows))
        raise UserError(f"{what}: h_samples are {own}, those of the truth {right}: predict at the rows of the truth")
    g, p = len(true), len(found)
    if detections.run_time > time_limit or p > g + MORE_LANES:
        return 0.0, 0.0, 1.0
    best = line_accuracy(true, found, pixel_thresholds(true, rows)).max(1, initial=0.0)
    matched = int((best >= MATCHED).sum())
    missed = g - matched
    total = best.sum()
    if g > _LANES:
        missed -= missed > 0
        total -= best.min()
    counted = max(min(g, _LANES), 1)
    return float(total / counted), (p - matched) / p if p else 0.0, missed / counted


def pixel_thresholds(true: Float[np.ndarray, "g h"], rows: Float[np.ndarray, " h"]) -> Float[np.ndarray, " g"]:
    """Return the distance along a row, pixels, that is 20 pixels across each lane.

    The slope is that of the least-squares line through the lane's points; a lane of one point counts as vertical.
    """
    valid = true >= 0
    count = np.maximum(valid.sum(-1, keepdims=True), 1)
    y = np.where(valid, rows - (valid * rows).sum(-1, keepdims=True) / count, 0.0)
    x = np.where(valid, true, 0.0)
    spread = (y * y).sum(-1)
    slope = (y * x).sum(-1) / np.where(spread > 0, spread, 1.0)
    return PIXEL_THRESHOLD * np.sqrt(1.0 + np.where(spread > 0, slope, 0.0) ** 2)


def line_accuracy(
    true: Float[np.ndarray, "g h"], found: Float[np.ndarray, "p h"], thresholds: Float[np.ndarray, " g"]
) -> Float[np.ndarray, "g p"]:
    """Return the fraction of rows in which a prediction is nearer than the threshold; rows absent in both are hits."""
    true, found = (np.where(x < 0, _ABSENT, x) for x in (true, found))
    near = np.abs(true[:, None] - found[None]) < thresholds[:, None, None]
    return near.mean(-1) if near.shape[-1] else np.zeros(near.shape[:2])


def _range(rows: Float[np.ndarray, " h"]) -> str:
    return f"{rows[0]:g} to {rows[-1]:g}" if len(rows) else "empty"


def _checked(x: Float[np.ndarray, "l h"], rows: int, what: str) -> Float[np.ndarray, "l h"]:
    try:
        x = np.asarray(x, np.float64)
    except ValueError as error:
        raise UserError(
            f"{what}: lanes have different numbers of rows, expected {rows} numbers in each ({error})"
        ) from None
    if x.ndim and len(x) == 0:  # no lanes: an empty list has no number of rows
        return np.zeros((0, rows))
    if x.ndim != 2 or x.shape[1] != rows:
        raise UserError(
            f"{what}: lanes have shape {x.shape}, expected (lanes, {rows}), one x for each row of the truth"
        )
    if not np.isfinite(x).all():
        raise UserError(f"{what}: lane {int((~np.isfinite(x).all(1)).argmax())} has a number that is not finite")
    return x

"""Whether predicted columns of TuSimple's lanes are pixels of the labelled image, whose size no file tells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.files.tusimple import SIZE, RowLanes
from tflane_jax.files.wording import named
from tflane_jax.metrics.tusimple import pixel_thresholds

# Of the predicted lanes, at most so many are near a true one if they are of another image; at least so many after the
# right scale and shift. Labels of other images of the same road, in place of predictions, have 0.1 to 0.4 in both.
_FEW, _MOST = 0.2, 0.6
# Rows by which predictions may be shifted.
_ROWS_OFF = 12
# Within this fraction of the metric's threshold, rows that are one off do not fit as well as the right ones.
_CLOSE = 0.1
# Predicted columns of so many times the widest true one are outside of any image that has these lanes.
_OUTSIDE = 2.0
# Images that scale and shift are taken from.
_IMAGES = 500
_STEPS, _QUANTILES = 5, np.linspace(0.05, 0.95, 19)

_Pair = tuple[Float[np.ndarray, "p h"], Float[np.ndarray, "g h"], Float[np.ndarray, " g"]]


def columns(predictions: Mapping[str, RowLanes], truth: Mapping[str, RowLanes]) -> list[str]:
    """Return remarks on columns of other rows, another image size or crop, mirrored or far outside of the image."""
    pairs = _pairs(predictions, truth)
    if not pairs:
        return []
    near = _near(pairs)
    remarks = _outside(predictions, max(float(true.max()) for _, true, _ in pairs))
    if (found := _rearranged(pairs, near)) is not None:
        return [found]
    if near <= _FEW:
        scale, shift = _fit(pairs[:: -(-len(pairs) // _IMAGES)])
        moved = [(np.where(x >= 0.0, scale * x + shift, -1.0), true, widths) for x, true, widths in pairs]
        if (then := _near(moved)) >= _MOST:
            offset = f" {'-' if shift < 0.0 else '+'} {abs(shift):.0f}" if round(shift) else ""
            return [
                f"{near:.0%} of the predicted lanes are near a true one, but {then:.0%} with {scale:.3g} x{offset} in "
                "place of x: are they of another image size or crop?"
            ]
    if near == 0.0 and not remarks:
        return ["no predicted lane is near a true one: are x pixels of the labelled image, from its left border?"]
    return remarks


def _rearranged(pairs: Sequence[_Pair], near: float) -> str | None:
    """Return a remark if most lanes would be near a true one with other rows or mirrored; `near` of them are as is."""
    if near > _MOST:
        return None
    shifts = [rows for rows in range(-_ROWS_OFF, _ROWS_OFF + 1) if rows]
    changes = {
        "with the rows in reverse order: do they ascend, as h_samples do?": lambda x: x[:, ::-1],
        f"mirrored, with {SIZE[1]} - x in place of x: is x counted from the left border?": lambda x: np.where(
            x >= 0.0, SIZE[1] - x, -1.0
        ),
        **{
            f"{abs(rows)} rows further {'down' if rows > 0 else 'up'}: is the first number that of the first of "
            "h_samples?": lambda x, rows=rows: _moved(x, rows)
            for rows in shifts
        },
    }
    few = pairs[:: -(-len(pairs) // _IMAGES)]

    def near_then(change: Callable[[np.ndarray], np.ndarray], within: float = 1.0) -> float:
        return _near([(change(x), true, within * widths) for x, true, widths in few])

    best = max(changes, key=lambda name: near_then(changes[name], _CLOSE))
    if (then := near_then(changes[best])) < max(_MOST, 2.0 * near):
        return None
    return f"{near:.0%} of the predicted lanes are near a true one, but {then:.0%} {best}"


def _moved(x: Float[np.ndarray, "p h"], rows: int) -> Float[np.ndarray, "p h"]:
    """Return columns so many rows further down; those that leave the image are lost."""
    moved = np.full_like(x, -1.0)
    count = x.shape[1]
    if abs(rows) < count:
        moved[:, max(rows, 0) : count + min(rows, 0)] = x[:, max(-rows, 0) : count - max(rows, 0)]
    return moved


def _pairs(predictions: Mapping[str, RowLanes], truth: Mapping[str, RowLanes]) -> list[_Pair]:
    """Return predicted and true columns with the metric's thresholds, of images in which both have points."""
    pairs = []
    for key, one in truth.items():
        true, found = (lanes[(lanes >= 0.0).any(-1)] for lanes in (one.x, predictions[key].x))
        if len(true) and len(found) and one.rows is not None:
            pairs.append((found, true, pixel_thresholds(true, one.rows)))
    return pairs


def _near(pairs: Sequence[_Pair]) -> float:
    """Return the fraction of predicted lanes of which half of the points or more are near one true lane."""
    near = total = 0
    for found, true, thresholds in pairs:
        both = (found[:, None] >= 0.0) & (true >= 0.0)
        close = both & (np.abs(found[:, None] - true) < thresholds[:, None])
        points = (found >= 0.0).sum(-1)
        near += int(((2 * close.sum(-1).max(-1) >= points) & (points > 0)).sum())
        total += len(found)
    return near / total


def _fit(pairs: Sequence[_Pair]) -> tuple[float, float]:
    """Return scale and shift that bring predicted columns to the true ones.

    The quantiles of both begin. Then each predicted point goes with the nearest true one of its row, and of these, the
    nearer half decides.
    """
    ours, theirs = (
        np.quantile(np.concatenate([lanes[i][lanes[i] >= 0.0] for lanes in pairs]), _QUANTILES) for i in (0, 1)
    )
    scale, shift = _line(ours, theirs)
    for _ in range(_STEPS):
        x, nearest = [], []
        for found, true, _ in pairs:
            apart = np.where(true >= 0.0, np.abs(scale * found[:, None] + shift - true), np.inf)
            lane = apart.argmin(1)
            kept = (found >= 0.0) & np.isfinite(apart.min(1))
            x.append(found[kept])
            nearest.append(np.take_along_axis(true, lane, 0)[kept])
        x, nearest = np.concatenate(x), np.concatenate(nearest)
        apart = np.abs(scale * x + shift - nearest)
        kept = apart <= np.median(apart) if len(apart) else slice(0)
        scale, shift = _line(x[kept], nearest[kept])
    return scale, shift


def _line(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return slope and intercept of the least-squares line; slope 1 where x has no extent."""
    if len(x) == 0 or np.ptp(x) == 0.0:
        return 1.0, float(np.mean(y - x)) if len(x) else 0.0
    dx = x - x.mean()
    slope = float((dx * y).sum() / (dx * dx).sum())
    return slope, float(y.mean() - slope * x.mean())


def _outside(predictions: Mapping[str, RowLanes], widest: float) -> list[str]:
    """Return a remark on columns far right of all true ones, of which `widest` is the last."""
    far = {key: int((one.x > _OUTSIDE * widest).sum()) for key, one in predictions.items()}
    if not any(far.values()):
        return []
    points, images = sum(far.values()), [key for key, count in far.items() if count]
    most = max(float(predictions[key].x.max()) for key in images)
    return [
        f"{points} predicted points of {len(images)} images reach x {most:.4g}, true ones {widest:.4g} "
        f"({named(images[0])}): are they outside of the image, or of another image size?"
    ]

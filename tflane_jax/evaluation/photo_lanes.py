"""Whether lanes predicted in a part of a photo are plausible: they meet in one point, do not cross, and lie on paint.

Of many parts, that one is best whose lanes are also long, and predicted in the other parts as well. Nothing here was
trained; what the choice was fitted to is said in docs/gtn_lane.md. Lengths are those of TuSimple's camera, 1.5 m above
the road, because a part of a photo is good if the network sees in it what TuSimple's camera would have seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.datasets.photos import HORIZON, Placement
from tflane_jax.files.images import opencv

_CAMERA_HEIGHT = 1.5  # metres, assumed
_ASPECT = 720 / 1280  # rows of TuSimple's image for each column
_LEAST_DEPTH = 0.02  # rows so close to the horizon, as fractions of the view, are not judged
_LEAST_POINTS = 15

# Paint: brighter than both sides, `_APART` metres away, by this fraction. Lanes may be off by the search to the sides.
_APART, _SEARCH, _BRIGHTER = 0.3, np.linspace(-0.25, 0.25, 7), 0.08
# Beside a lane, where no paint should be. Where it is found there too, the texture is not that of a road.
_BESIDE = (-1.2, -0.8, 0.8, 1.2)
_MOST_CLUTTER = 0.35
# Standard deviations of the row in which lanes meet, about TuSimple's horizon, and of their distance from that point.
_HORIZON_SPREAD, _MEETING_SPREAD = 0.05, 0.03
# A lane is supported if this fraction of it lies on paint, so much more than of lines beside it, and some of each of
# `_SPREAD` of its `_PARTS` parts: an arrow or a crossing lies on one or two.
_SUPPORTED, _MORE = 0.18, 0.1
_PARTS, _SPREAD, _SOME = 5, 3, 0.1
# What a further lane is worth beside the paint under all lanes: worn paint hardly differs from asphalt.
_LANE_WORTH = 0.1
# Lanes of two views agree where they are closer than this fraction of the photo's width, in so many rows of the photo.
_SAME, _ROWS = 0.02, 200
# Columns of the view by which lanes must have changed places to count as crossed.
_CROSSED = 0.005


@dataclass(frozen=True)
class Judgement:
    """What was found out about the lanes of one view.

    Attributes:
        value: plausibility, from 0; TuSimple's frames have 0.2 to 1.5.
        meeting: column and row of the photo in which the lanes meet; None for fewer than two lanes.
        trust: weight of `meeting` in an estimate of the horizon.
        paint: of each lane, the fraction that lies on paint.
        supported: which lanes lie on paint rather than by chance.
        crossed: lanes change places on their way to the horizon.
    """

    value: float
    meeting: tuple[float, float] | None
    trust: float
    paint: tuple[float, ...]
    supported: tuple[bool, ...]
    crossed: bool


def judge_lanes(
    grey: UInt8[np.ndarray, "h w"],
    view: Placement,
    lanes: Sequence[Float[np.ndarray, "p 2"]],
    scores: Float[np.ndarray, " l"],
) -> Judgement:
    """Judge the lanes that a network found in a view of a photo.

    Args:
        grey: the photo.
        view: the part that the network saw.
        lanes: (u, v), fractions of the view.
        scores: of each lane, 0 to 1.
    """
    every = [_judge_lane(grey, view, lane, score) for lane, score in zip(lanes, scores, strict=True)]
    paint = tuple(0.0 if lane is None else lane.paint for lane in every)
    supported = tuple(lane is not None and lane.supported for lane in every)
    judged = [lane for lane in every if lane is not None]
    if len(judged) < 2:
        return Judgement(0.0, None, 0.0, paint, supported, crossed=False)
    slope, start = np.array([lane.slope for lane in judged]), np.array([lane.start for lane in judged])
    # The point (u, v) nearest to all lines u = start + slope v.
    system = np.stack([np.ones(len(slope)), -slope], 1)
    meeting = np.linalg.lstsq(system, start, rcond=None)[0]
    apart = float(np.abs(system @ meeting - start).max())
    near, far = start + slope, start + slope * (HORIZON + 0.08)
    # Either the straight lines through the lanes change places towards the horizon, or the lanes themselves cross.
    straight_cross = bool((np.diff(far[np.argsort(near)]) < -_CROSSED).any())
    crossed = straight_cross or not without_crossings(lanes, scores.tolist(), 1.0).all()
    together = float(np.exp(-0.5 * (apart / _MEETING_SPREAD) ** 2))
    clean = max(1.0 - float(np.mean([lane.clutter for lane in judged])) / _MOST_CLUTTER, 0.0)
    aligned = float(np.exp(-0.5 * ((meeting[1] - HORIZON) / _HORIZON_SPREAD) ** 2))
    trust = together * clean * (sum(lane.weight for lane in judged) + _LANE_WORTH * (len(judged) - 1))
    value = 0.0 if crossed else trust * aligned
    column, row = map(float, view.to_photo(meeting))
    return Judgement(value, (column, row), trust, paint, supported, crossed)


class _JudgedLane(NamedTuple):
    """A lane of a view that is long enough to be judged.

    Attributes:
        paint: fraction of it that lies on paint.
        clutter: the same of lines beside it.
        supported: it lies on paint rather than by chance.
        slope, start: of the straight line u = start + slope v through it.
        weight: in the trust of the view.
    """

    paint: float
    clutter: float
    supported: bool
    slope: float
    start: float
    weight: float


def _judge_lane(
    grey: UInt8[np.ndarray, "h w"], view: Placement, lane: Float[np.ndarray, "p 2"], score: float
) -> _JudgedLane | None:
    """Return what is found about one lane; None if fewer than `_LEAST_POINTS` of its points can be judged."""
    u, v = lane[_judged(lane)].T
    if len(u) < _LEAST_POINTS:
        return None
    paint, clutter, parts = _paint(grey, view, u, v)
    supported = paint >= _SUPPORTED and paint - clutter >= _MORE and parts >= _SPREAD
    slope, start = np.polyfit(v, u, 1, w=v - HORIZON)
    return _JudgedLane(paint, clutter, supported, slope, start, float(score) * max(paint - clutter, 0.0))


def agreement(
    lanes: Sequence[Float[np.ndarray, "p 2"]],
    others: Sequence[Sequence[Float[np.ndarray, "q 2"]]],
    values: Sequence[float],
    size: tuple[int, int],
) -> Float[np.ndarray, " l"]:
    """Return how much of each lane other views of the photo show too: the mean over views, weighted by their values.

    A view that the network was not made for bends and shifts what it finds in its own way, and the truth is what many
    have in common.

    Args:
        lanes: of one view, (column, row) in pixels of the photo, rows ascending.
        others: of each other view.
        values: of the other views, see `Judgement`.
        size: height and width of the photo.
    """
    rows = np.linspace(0, size[0] - 1, _ROWS)
    mine = np.array([_columns(lane, rows) for lane in lanes]).reshape(-1, _ROWS)
    extent = np.maximum(np.isfinite(mine).sum(1), 1)
    found, total = np.zeros(len(lanes)), max(sum(values), 1e-9)
    for view, value in zip(others, values, strict=True):
        if view and value:
            theirs = np.stack([_columns(lane, rows) for lane in view])
            near = np.abs(theirs - mine[:, None]) < _SAME * size[1]
            found += value / total * near.sum(-1).max(1) / extent
    return found


def plausibility(
    value: float, agreed: Float[np.ndarray, " l"], lanes: Sequence[Float[np.ndarray, "p 2"]], height: int
) -> float:
    """Return how plausible one of many views of a photo is: of long lanes, on which other views agree.

    Args:
        value: of the view alone, see `Judgement`.
        agreed: of each lane, see `agreement`.
        lanes: (column, row) in pixels of the photo, rows ascending.
        height: of the photo, pixels.
    """
    length = sum(float(np.ptp(lane[:, 1])) for lane in lanes if len(lane)) / height
    return float(agreed.sum()) ** 0.5 * value**0.25 * length


def _columns(lane: Float[np.ndarray, "p 2"], rows: Float[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
    """Return the columns of a lane at rows, NaN beyond its ends."""
    if not len(lane):
        return np.full(rows.shape, np.nan)
    return np.interp(rows, lane[:, 1], lane[:, 0], left=np.nan, right=np.nan)


def common_horizon(judgements: Sequence[Judgement], height: int) -> tuple[float, float] | None:
    """Return the column and row in which the lanes of several views meet, pixels of the photo; None if none do.

    It is the densest place of the rows, each with its trust, in steps of a hundredth of the photo.
    """
    known = [(*one.meeting, one.trust) for one in judgements if one.meeting is not None and one.trust > 0.0]
    known = [(u, v, w) for u, v, w in known if 0.0 < v < height]
    if not known:
        return None
    columns, rows, trust = np.array(known).T
    bandwidth = 0.02 * height
    density = (np.exp(-0.5 * ((rows[:, None] - rows) / bandwidth) ** 2) * trust[:, None]).sum(0)
    close = np.abs(rows - rows[density.argmax()]) < bandwidth
    weights = trust[close] / trust[close].sum()
    return float(columns[close] @ weights), float(rows[close] @ weights)


def is_blank(grey: UInt8[np.ndarray, "h w"]) -> bool:
    """Return whether a photo shows nothing: almost all of it has one brightness."""
    low, high = np.percentile(grey, (2, 98))
    return bool(high - low < 8)


def without_crossings(
    lanes: Sequence[Float[np.ndarray, "p 2"]], worth: Sequence[float], width: float
) -> Bool[np.ndarray, " l"]:
    """Return which lanes to keep so that none cross within their extents: of two that cross, the one worth more.

    Args:
        lanes: (column, row) in pixels, rows ascending.
        worth: of each lane.
        width: of the view, pixels.
    """
    kept = np.ones(len(lanes), bool)
    for i in np.argsort(worth, kind="stable")[::-1]:
        if kept[i]:
            for j in range(len(lanes)):
                if j != i and kept[j] and worth[j] <= worth[i] and _cross(lanes[i], lanes[j], _CROSSED * width):
                    kept[j] = False
    return kept


def _cross(one: Float[np.ndarray, "p 2"], other: Float[np.ndarray, "q 2"], margin: float) -> bool:
    low, high = max(one[0, 1], other[0, 1]), min(one[-1, 1], other[-1, 1])
    if low >= high:
        return False
    rows = np.linspace(low, high, 50)
    apart = np.interp(rows, one[:, 1], one[:, 0]) - np.interp(rows, other[:, 1], other[:, 0])
    return bool((apart > margin).any() and (apart < -margin).any())


def _judged(lane: Float[np.ndarray, "p 2"]) -> Bool[np.ndarray, " p"]:
    u, v = lane.T
    return (v > HORIZON + _LEAST_DEPTH) & (v < 1.0) & (u >= 0.0) & (u < 1.0)


def _paint(
    grey: UInt8[np.ndarray, "h w"], view: Placement, u: Float[np.ndarray, " p"], v: Float[np.ndarray, " p"]
) -> tuple[float, float, int]:
    """Return the fraction of a lane on paint, the same of lines beside it, and how many parts of the lane have some."""
    metre = (v - HORIZON) * _ASPECT / _CAMERA_HEIGHT  # along a row, as a fraction of the view's width
    offsets = np.add.outer([0.0, *_BESIDE], np.add.outer(_SEARCH, [0.0, -_APART, _APART]))
    places = view.to_photo(np.stack(np.broadcast_arrays(u + offsets[..., None] * metre, v), -1))
    maps = places.astype(np.float32).reshape(-1, 1, 2)
    cv2 = opencv()
    values = cv2.remap(grey, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    middle, left, right = np.moveaxis(values.reshape(places.shape[:-1]).astype(np.float64), 2, 0)
    brighter = (middle - np.maximum(left, right)) / (np.minimum(left, right) + 20.0)
    paint = brighter.max(1) > _BRIGHTER
    parts = sum(part.mean() > _SOME for part in np.array_split(paint[0], _PARTS))
    return float(paint[0].mean()), float(paint[1:].mean()), int(parts)

"""Lane segments from above: centerlines, boundaries by type, crossings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit

from tflane_jax.errors import UserError
from tflane_jax.plots import style
from tflane_jax.plots.lines import add_arrows, add_crossings, add_lines, add_links, faded, valid_rows
from tflane_jax.scene import (
    AreaType,
    CenterlinePrediction,
    Example,
    LaneGraph,
    LanePrediction,
    LinePrediction,
    LineType,
    SegmentPrediction,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINE_STYLES = {LineType.NONE: (0, (1.0, 2.5)), LineType.SOLID: "solid", LineType.DASHED: (0, (5.0, 3.0))}
"""Dashes of boundaries, in widths of the line; NONE is dotted and thin."""
_THIN = 0.75


def true_lanes(example: Example, prediction: CenterlinePrediction | SegmentPrediction | None) -> LaneGraph:
    """Return the ground truth of a prediction: segments, or else merged centerlines."""
    return example.segments if isinstance(prediction, SegmentPrediction) else example.lanes


def truth_lines(example: Example, prediction: LanePrediction | None) -> Float[np.ndarray, "g p 3"]:
    """Return the ground truth of a prediction as lines, padded: of lanes their centerlines.

    Raises UserError for lines of a vector map that the example does not label.
    """
    if not isinstance(prediction, LinePrediction):
        return np.asarray(true_lanes(example, prediction).points)
    if example.map_lines is None:
        raise UserError("these examples label no lines of a vector map: set data.example.map_lines")
    return np.asarray(example.map_lines.points)


def chosen_segments(
    prediction: SegmentPrediction, threshold: float
) -> tuple[Bool[np.ndarray, " q"], Bool[np.ndarray, " q"]]:
    """Return which queries are lane segments, and which are crossings, with a score of at least `threshold`."""
    logits = np.asarray(prediction.logits)
    shown, crossing = np.asarray(prediction.scores) >= threshold, logits.argmax(-1) == 1
    return shown & ~crossing, shown & crossing


def chosen_areas(
    prediction: SegmentPrediction, threshold: float, kind: AreaType
) -> tuple[Float[np.ndarray, "a p 3"], Float[np.ndarray, " a"]]:
    """Return outlines and scores of the areas of a kind with a score of at least `threshold`.

    Crossings are the outlines of segments of the second class, where areas have no queries of their own.
    """
    if prediction.areas is not None:
        column = int(kind) - int(AreaType.PEDESTRIAN_CROSSING)
        scores = expit(np.asarray(prediction.areas.logits, np.float64))[:, column]
        shown = scores >= threshold
        return np.asarray(prediction.areas.points)[shown], scores[shown]
    crossings = chosen_segments(prediction, threshold)[1] & (kind == AreaType.PEDESTRIAN_CROSSING)
    left, right = np.asarray(prediction.left)[crossings], np.asarray(prediction.right)[crossings]
    return outline_of_sides(left, right), np.asarray(prediction.scores)[crossings]


def boundary_types(prediction: SegmentPrediction, chosen: Bool[np.ndarray, " q"]) -> list[Int[np.ndarray, " n"]]:
    """Return the types of left and right boundaries of the chosen queries; SOLID where types are not predicted."""
    both = (prediction.left_type_logits, prediction.right_type_logits)
    return [
        np.full(chosen.sum(), LineType.SOLID) if logits is None else np.asarray(logits)[chosen].argmax(-1)
        for logits in both
    ]


def outline_of_sides(left: Float[np.ndarray, "n p 3"], right: Float[np.ndarray, "n p 3"]) -> Float[np.ndarray, "n k 3"]:
    """Return the outline of areas between two lines that run in the same direction."""
    return np.concatenate([left, right[:, ::-1]], 1)


def draw_segments(ax: Axes, segments: LaneGraph) -> None:
    """Draw true segments: arrows along thin centerlines, coloured by visibility, and light boundaries by type."""
    points, left, right, left_type, right_type, visibility = valid_rows(
        segments.valid,
        segments.points,
        segments.left,
        segments.right,
        segments.left_type,
        segments.right_type,
        segments.visibility,
    )
    colours = visibility_colours(visibility)
    add_lines(ax, points, colours, width=0.7, alpha=0.8, zorder=3.0)
    add_arrows(ax, points, colours, zorder=3.1)
    for line, types in ((left, left_type), (right, right_type)):
        draw_boundaries(ax, line, types, style.BOUNDARY, width=1.0, zorder=3.05)


def draw_boundaries(
    ax: Axes,
    lines: Float[np.ndarray, "n p 3"],
    types: Int[np.ndarray, " n"],
    colours: str | Float[np.ndarray, "n 4"],
    *,
    width: float = 1.2,
    zorder: float = 3.5,
) -> None:
    """Draw boundaries of lanes by `LineType`: solid, dashed, or dotted and thin for none."""
    for kind, dashes in LINE_STYLES.items():
        mine = np.asarray(types) == kind
        add_lines(
            ax,
            lines[mine],
            colours if isinstance(colours, str) else colours[mine],
            width=width * (_THIN if kind == LineType.NONE else 1.0),
            zorder=zorder,
            dashes=dashes,
        )


def draw_segment_prediction(ax: Axes, prediction: SegmentPrediction, *, threshold: float = 0.3) -> None:
    """Draw segments and areas with a score of at least `threshold`, opacity by score, and the topology."""
    lanes, _ = chosen_segments(prediction, threshold)
    points, left, right, scores = (
        np.asarray(array) for array in (prediction.points, prediction.left, prediction.right, prediction.scores)
    )
    add_crossings(ax, *chosen_areas(prediction, threshold, AreaType.PEDESTRIAN_CROSSING), zorder=3.2)
    kerbs, sure = chosen_areas(prediction, threshold, AreaType.ROAD_BOUNDARY)
    add_lines(ax, kerbs, faded(style.ROAD_BOUNDARY, sure), width=1.4, zorder=3.3)
    colours = faded(style.PREDICTION, scores[lanes])
    add_lines(ax, points[lanes], colours, width=0.7, alpha=0.8, zorder=3.5)
    add_arrows(ax, points[lanes], colours, zorder=3.6)
    for lines, types in zip((left, right), boundary_types(prediction, lanes), strict=True):
        draw_boundaries(ax, lines[lanes], types, colours, width=1.5, zorder=3.55)
    if prediction.successor_logits is not None:
        add_links(ax, points[lanes], np.asarray(prediction.successor_logits)[np.ix_(lanes, lanes)])


def visibility_colours(visibility: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4"]:
    """Return the colours of true lanes by the fraction in line of sight."""
    from matplotlib.colors import LinearSegmentedColormap

    by_visibility = LinearSegmentedColormap.from_list("visibility", [style.LANE_HIDDEN, style.LANE_CLEAR])
    return by_visibility(np.clip(visibility, 0.0, 1.0))

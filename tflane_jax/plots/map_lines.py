"""Lines of a vector map from above: dividers, crossings, boundaries and centerlines, by class."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from tflane_jax.plots import style
from tflane_jax.plots.lines import add_arrows, add_crossings, add_lines, faded, valid_rows
from tflane_jax.scene import LineClass, LinePrediction, MapLines

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def chosen_lines(
    prediction: LinePrediction, threshold: float
) -> tuple[Float[np.ndarray, "n p 3"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return points, classes and scores of the pairs of query and class with a score of at least `threshold`.

    Lines without heights lie on the plane z = 0 of the ego frame.
    """
    scores, points = expit(np.asarray(prediction.logits, np.float64)), np.asarray(prediction.points)
    query, category = np.nonzero(scores >= threshold)
    if points.shape[-1] == 2:
        points = np.concatenate([points, np.zeros((*points.shape[:-1], 1), points.dtype)], -1)
    return points[query], category, scores[query, category]


def draw_map_lines(
    ax: Axes, lines: MapLines, *, colour: str | None = None, width: float = 1.5, alpha: float = 1.0
) -> None:
    """Draw true lines; without a `colour`, in that of their class, crossings shaded and centerlines with arrows."""
    points, category = valid_rows(lines.valid, lines.points, lines.category)
    if colour is None:
        draw_lines_by_class(ax, points, category, np.ones(len(points)), width=width)
    else:
        add_lines(ax, points, colour, width=width, alpha=alpha, zorder=3.0)


def draw_line_prediction(ax: Axes, prediction: LinePrediction, *, threshold: float = 0.3) -> None:
    """Draw lines with a score of at least `threshold` in the colour of their class, opacity by score."""
    draw_lines_by_class(ax, *chosen_lines(prediction, threshold))


def draw_lines_by_class(
    ax: Axes,
    points: Float[np.ndarray, "n p 3"],
    category: Int[np.ndarray, " n"],
    scores: Float[np.ndarray, " n"],
    *,
    width: float = 1.5,
) -> None:
    """Draw lines in the colours of their classes, opacity by score."""
    for kind, colour in style.MAP_LINE.items():
        mine = np.asarray(category) == kind
        colours = faded(colour, scores[mine])
        if kind == LineClass.CROSSING:
            add_crossings(ax, points[mine], scores[mine], zorder=3.3)
        elif kind == LineClass.CENTERLINE:
            add_lines(ax, points[mine], colours, width=0.6 * width, alpha=0.8, zorder=3.4)
            add_arrows(ax, points[mine], colours, zorder=3.6)
        else:
            add_lines(ax, points[mine], colours, width=width, zorder=3.5)


def class_entries() -> list:
    """Return the entries of a legend for the classes of lines."""
    from matplotlib.lines import Line2D

    names = {
        LineClass.DIVIDER: "divider",
        LineClass.CROSSING: "crossing",
        LineClass.BOUNDARY: "boundary",
        LineClass.CENTERLINE: "centerline",
    }
    return [Line2D([], [], color=style.MAP_LINE[kind], lw=2, label=name) for kind, name in names.items()]

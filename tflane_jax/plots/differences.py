"""Where models differ: truth, evidence and predictions side by side, with outlined lanes."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.plots import style
from tflane_jax.plots.bev import GROUND, INPUTS, VIEW, Layer, draw_found, draw_scene, inputs_title, truth_layers
from tflane_jax.plots.figure import new_figure, save_figure
from tflane_jax.plots.gallery import label_edges, panel_size
from tflane_jax.plots.legends import (
    boundary_entries,
    evidence_entries,
    hidden_entries,
    prediction_entries,
    truth_entry,
    visibility_entries,
)
from tflane_jax.plots.map_lines import class_entries
from tflane_jax.plots.priors import prior_entries
from tflane_jax.plots.segments import truth_lines
from tflane_jax.scene import BevChannel, Example, LanePrediction, RoadUser, row_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_WIDTH = 4.0  # inches
_TITLE = 52  # characters of a line above a panel
_HALF_WIDTH = 1.3  # metres
Outline = Literal["edge", "filled", "dashed"]


@dataclass(frozen=True)
class Findings:
    """What a model predicts for the B drawn examples, and which true lanes it finds.

    Attributes:
        lanes: predictions, stacked.
        threshold: lowest confidence of a lane that is drawn.
        found: (B, G) by row of the padded truth.
    """

    lanes: LanePrediction
    threshold: float
    found: Bool[np.ndarray, "b g"]


def save_differences(
    path: Path,
    examples: Example,
    models: Mapping[str, Findings],
    outlined: Bool[np.ndarray, "b g"],
    *,
    title: str,
    titles: Sequence[str],
    caption: str = "",
    meaning: str = "outlined lane",
    ground: PerceptionRange = GROUND,
    view: PerceptionRange = VIEW,
) -> Path:
    """Write one row per example: truth | evidence and priors | one panel per model.

    Outlined lanes are marked in every panel. In that of a model, the outline is filled if the model finds the lane and
    dashed if it misses it.

    Args:
        path: .png, .pdf or .svg.
        examples: B of them, stacked along a leading axis.
        models: by name.
        outlined: (B, G) by row of the padded truth.
        title, caption: above and below the picture.
        titles: one per row.
        meaning: of an outline, for the legend.
        ground, view: see `draw_scene`.

    Returns:
        `path`.
    """
    size = panel_size(view, _PANEL_WIDTH)
    figure, axes = new_figure(len(titles), 2 + len(models), panel=size, footer=1.5)
    shown = next((findings.lanes for findings in models.values()), None)
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    for row, (panels, name) in enumerate(zip(axes, titles, strict=True)):
        example = row_of(examples, row)
        truth, seen, *places = panels
        lanes = truth_lines(example, shown)
        draw_scene(
            truth,
            example,
            layers=("hidden", *truth_layers(shown)),
            ground=ground,
            view=view,
            title=f"truth, {name}",
        )
        draw_scene(seen, example, layers=INPUTS, ground=ground, view=view, title=inputs_title(example))
        for ax in (truth, seen):
            draw_outlines(ax, lanes[outlined[row]])
        for ax, (model, findings) in zip(places, models.items(), strict=True):
            found = findings.found[row] & outlined[row]
            heading = textwrap.fill(f"{model}: finds {found.sum()} of {outlined[row].sum()} outlined", _TITLE)
            prediction = row_of(findings.lanes, row)
            draw_found(ax, example, prediction, ground=ground, view=view, threshold=findings.threshold, title=heading)
            draw_outlines(ax, lanes[found], "filled")
            draw_outlines(ax, lanes[outlined[row] & ~found], "dashed")
    label_edges(axes)
    _add_legend(figure, caption, meaning, truth_layers(shown), examples)
    return save_figure(figure, path)


def draw_outlines(ax: Axes, lanes: Float[np.ndarray, "l n 3"], outline: Outline = "edge") -> None:
    """Draw a band around each lane: its edge alone, filled, or dashed."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba

    ax.add_collection(
        PolyCollection(
            [band(line[:, :2], _HALF_WIDTH) for line in lanes],
            facecolors=[to_rgba(style.OUTLINE, 0.3 if outline == "filled" else 0.0)],
            edgecolors=[to_rgba(style.OUTLINE)],
            linestyles="dashed" if outline == "dashed" else "solid",
            linewidths=1.2,
            zorder=3.3,
        )
    )


def band(line: Float[np.ndarray, "n 2"], half_width: float) -> Float[np.ndarray, "2n 2"]:
    """Return the polygon between the parallels of a line to its right, forward, and to its left, backward.

    Args:
        line: points in driving direction, at least two.
        half_width: distance of the parallels, metres.
    """
    step = np.gradient(np.asarray(line, float), axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], -1) / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-9)
    return np.concatenate([line - half_width * left, (line + half_width * left)[::-1]])


def _add_legend(figure: Figure, caption: str, meaning: str, drawn: Collection[Layer], examples: Example) -> None:
    from matplotlib.patches import Patch

    edge = {"edgecolor": style.OUTLINE, "lw": 1.3}
    car = style.ROAD_USER[RoadUser.CAR]
    traffic = [
        Patch(facecolor=car + "8c", edgecolor=car, label="road user, its track"),
        Patch(facecolor="none", edgecolor=car, label="not seen at present"),
    ]
    entries: list = [  # column by column
        Patch(facecolor="none", label=meaning, **edge),
        truth_entry(),
        Patch(facecolor=style.OUTLINE + "4d", label="this model finds it", **edge),
        Patch(facecolor="none", ls="--", label="this model misses it", **edge),
        *(class_entries() if "map_lines" in drawn else [*prediction_entries(), *visibility_entries()]),
        *hidden_entries(examples),
        *([] if examples.traffic_flow is None else traffic),
        *evidence_entries(examples, (BevChannel.LANE_PAINT, BevChannel.ROAD_EDGE, BevChannel.OBSTACLE)),
        *prior_entries(examples),
        *(boundary_entries() if "segments" in drawn else ()),
    ]
    legend = figure.legend(
        handles=entries,
        title=caption,
        loc="outside lower left",
        ncols=7,
        fontsize=8,
        title_fontsize=9,
        alignment="left",
        frameon=False,
    )
    legend.get_title().set_multialignment("left")

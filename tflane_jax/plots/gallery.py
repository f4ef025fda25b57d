"""Pages of pictures: predictions beside the truth, and a contact sheet of a dataset."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from tflane_jax.geometry import PerceptionRange
from tflane_jax.plots.bev import GROUND, INPUTS, VIEW, Layer, draw_found, draw_scene, inputs_title, truth_layers
from tflane_jax.plots.figure import hide_unused, new_figure, save_figure
from tflane_jax.plots.legends import (
    area_entries,
    boundary_entries,
    element_entries,
    evidence_entries,
    hidden_entries,
    prediction_entries,
    traffic_entries,
    truth_entry,
    visibility_entries,
)
from tflane_jax.plots.map_lines import class_entries
from tflane_jax.plots.priors import prior_entries
from tflane_jax.scene import Example, LanePrediction, row_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PANEL_WIDTH = 4.8  # inches
# Of a contact sheet with two examples side by side: text stays readable where a page shows the whole sheet.
_SMALL_PANEL_WIDTH, _SMALL_PANEL_DPI = 3.4, 150
# Room for the legend: with less, the titles of a single row are cut off.
_FOOTER = 0.9
# More panels than this are wrapped to the next line.
_MOST_COLUMNS = 7


def save_examples(
    path: Path,
    examples: Example,
    predictions: Mapping[str, LanePrediction] | None = None,
    *,
    titles: Sequence[str] = (),
    ground: PerceptionRange = GROUND,
    view: PerceptionRange = VIEW,
    threshold: float = 0.3,
) -> Path:
    """Write one row per example: truth | evidence and priors | one panel per model; many models take several lines.

    Args:
        path: .png, .pdf or .svg.
        examples: B of them, stacked along a leading axis.
        predictions: by the name of the model, stacked in the same way. The truth is that of the first: lane segments
            with boundaries by type, merged centerlines, or lines of a vector map by class.
        titles: one per row; default their numbers.
        ground, view: see `draw_scene`.
        threshold: lowest score of a lane that is drawn.

    Returns:
        `path`.

    Raises:
        ValueError: the numbers of examples, predictions and titles differ.
    """
    predictions = predictions or {}
    count = len(examples.has_previous)
    titles = titles or [f"example {row}" for row in range(count)]
    sizes = {"titles": len(titles)} | {name: len(stacked.points) for name, stacked in predictions.items()}
    if any(size != count for size in sizes.values()):
        raise ValueError(f"{count} examples, but {sizes}")
    true = truth_layers(next(iter(predictions.values()), None))
    panels = 2 + len(predictions)
    lines = -(-panels // _MOST_COLUMNS)
    figure, axes = new_figure(count * lines, -(-panels // lines), panel=panel_size(view), footer=_FOOTER)
    for row, title in enumerate(titles):
        example, (truth, seen, *places) = row_of(examples, row), axes[row * lines : (row + 1) * lines].flat
        columns, unused = places[: len(predictions)], places[len(predictions) :]
        for ax in unused:
            ax.set_axis_off()
        draw_scene(
            truth,
            example,
            layers=("hidden", *true, "elements"),
            ground=ground,
            view=view,
            title=f"{title}: truth",
        )
        draw_scene(seen, example, layers=INPUTS, ground=ground, view=view, title=inputs_title(example))
        for ax, (name, stacked) in zip(columns, predictions.items(), strict=True):
            draw_found(ax, example, row_of(stacked, row), ground=ground, view=view, threshold=threshold, title=name)
    label_edges(axes)
    add_legend(figure, "with predictions" if predictions else "scenes", drawn=true, examples=examples)
    return save_figure(figure, path)


def save_contact_sheet(
    path: Path,
    examples: Sequence[Example],
    titles: Sequence[str],
    *,
    ground: PerceptionRange = GROUND,
    view: PerceptionRange = VIEW,
) -> Path:
    """Write a contact sheet of one or more examples: of each the truth, and evidence with priors.

    Args:
        path: .png, .pdf, .svg or .jpg.
        examples: what is drawn.
        titles: one for each example.
        ground: range of evidence and line of sight in the examples.
        view: range that is shown.

    Returns the path. Raises UserError where the file cannot be written.
    """
    pairs, inches, dpi = (2, _SMALL_PANEL_WIDTH, _SMALL_PANEL_DPI) if len(examples) > 1 else (1, _PANEL_WIDTH, 110)
    figure, axes = new_figure(-(-len(examples) // pairs), 2 * pairs, panel=panel_size(view, inches), footer=_FOOTER)
    true: tuple[Layer, ...] = ()
    for (truth, seen), example, title in zip(axes.reshape(-1, 2), examples, titles, strict=False):
        true = truth_layers(None) if example.map_lines is None else ("map_lines",)
        draw_scene(
            truth,
            example,
            layers=("hidden", *true, "elements"),
            ground=ground,
            view=view,
            title=f"{title}, truth",
        )
        draw_scene(seen, example, layers=INPUTS, ground=ground, view=view, title=inputs_title(example))
    hide_unused(axes, 2 * len(examples))
    label_edges(axes)
    add_legend(figure, "scenes", drawn=true, examples=examples[-1])
    return save_figure(figure, path, dpi=dpi)


def add_legend(
    figure: Figure,
    kind: Literal["scenes", "with predictions"] = "scenes",
    *,
    drawn: Collection[Layer] = ("lanes",),
    examples: Example | None = None,
) -> None:
    """Add the legend of all colours below the panels, once for the figure.

    Args:
        figure: to which it is added.
        kind: whether it has predictions.
        drawn: layers of true lanes.
        examples: whose inputs are named, one or several; None: evidence and traffic.
    """
    entries: list = [
        *(class_entries() if "map_lines" in drawn else visibility_entries()),
        *hidden_entries(examples),
        *traffic_entries(examples),
        *element_entries(examples),
        *evidence_entries(examples),
        *([] if examples is None else prior_entries(examples)),
    ]
    if kind == "with predictions":
        entries.append(truth_entry())
        if "map_lines" not in drawn:
            entries += prediction_entries()
    if "segments" in drawn:
        entries += boundary_entries()
    if "areas" in drawn:
        entries += area_entries()[: 1 if "segments" in drawn else 2]  # which have an entry for crossings already
    fitting = max(4, int(figure.get_figwidth() // 1.6))
    rows = -(-len(entries) // fitting)
    columns = -(-len(entries) // rows)
    figure.legend(handles=entries, loc="outside lower center", ncols=columns, fontsize=7, frameon=False)


def panel_size(view: PerceptionRange, inches: float = _PANEL_WIDTH) -> tuple[float, float]:
    """Return width and height of a panel of a width in inches; 0.35 of the height is for title and axis."""
    width, height = view.size(2)
    return inches, inches * height / width + 0.35


def label_edges(axes: np.ndarray) -> None:
    """Label only the axes along the left and lower edge of the grid; the lowest panel of a column that is not blank."""
    for column in axes.T:
        *others, lowest = [ax for ax in column if ax.axison] or [column[-1]]
        lowest.set_xlabel("x, forward [m]", fontsize=8)
        for ax in others:
            ax.tick_params(labelbottom=False)
    for ax in axes[:, 0]:
        ax.set_ylabel("y, left [m]", fontsize=8)
    for ax in axes[:, 1:].flat:
        ax.tick_params(labelleft=False)

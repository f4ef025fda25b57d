"""Camera images overlaid with lanes and traffic elements, beside the scene from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, invert_pose
from tflane_jax.plots import style
from tflane_jax.plots.bev import GROUND, VIEW, draw_found, draw_scene, truth_layers
from tflane_jax.plots.figure import new_figure, save_figure
from tflane_jax.plots.images import draw_image
from tflane_jax.plots.legends import above_entries, boundary_entries, truth_entry
from tflane_jax.plots.lines import valid_rows
from tflane_jax.plots.map_lines import chosen_lines, class_entries
from tflane_jax.plots.projection import (
    direction_colours,
    draw_boxes,
    draw_projected,
    draw_projected_boundaries,
    draw_projected_by_class,
)
from tflane_jax.plots.segments import boundary_types, chosen_areas, chosen_segments
from tflane_jax.scene import (
    AreaType,
    CameraViews,
    ElementPrediction,
    Example,
    LanePrediction,
    LinePrediction,
    MapLines,
    SegmentPrediction,
    row_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL = 3.4  # inches
# Entries of a legend in a row, and the height of a row, inches.
_ENTRIES, _ROW = 7, 0.16
# Images smaller than this are shown with sharp pixels.
_PIXELATED = 400


def save_camera_views(
    path: Path,
    examples: Example,
    lanes: LanePrediction | None = None,
    elements: ElementPrediction | None = None,
    *,
    titles: Sequence[str] = (),
    threshold: float = 0.3,
    ground: PerceptionRange = GROUND,
    view: PerceptionRange = VIEW,
) -> Path:
    """Write two rows per example: the front cameras with the scene from above, then the rear cameras.

    Camera images show the predictions, or the truth if there are none; the view from above shows both, the truth thin.
    The colour of a lane is its driving direction relative to the vehicle. Lines of a vector map have the colours of
    their classes, and their truth is thin and white in the camera images, too.

    Args:
        path: .png, .pdf or .svg.
        examples: B of them with camera images, stacked along a leading axis.
        lanes, elements: predictions, stacked in the same way, one layer.
        titles: one per example; default their numbers.
        threshold: lowest score of what is drawn.
        ground, view: see `draw_scene`.

    Returns:
        `path`.

    Raises:
        UserError: the examples have no camera images.
        ValueError: the numbers of examples, predictions and titles differ.
    """
    if examples.cameras is None:
        raise UserError("these examples have no camera images: set ExampleConfig.cameras")
    count = len(examples.has_previous)
    titles = titles or [f"example {row}" for row in range(count)]
    sizes = {"titles": len(titles)}
    sizes |= {} if lanes is None else {"lanes": len(lanes.points)}
    sizes |= {} if elements is None else {"elements": len(elements.box)}
    if any(size != count for size in sizes.values()):
        raise ValueError(f"{count} examples, but {sizes}")
    first = row_of(examples, 0)
    assert first.cameras is not None
    ahead, back = _rows_of_cameras(first.cameras)
    columns = max(len(ahead) + 1, len(back))
    height, width = examples.cameras.image.shape[2:4]
    entries = _page_entries(lanes, examples)
    rows = -(-len(entries) // _ENTRIES)
    size = _PANEL, _PANEL * min(height / width, 0.8) + 0.25
    figure, axes = new_figure(2 * count, columns, panel=size, footer=0.13 + _ROW * rows)
    for ax in axes.flat:
        ax.set_axis_off()
    for row, title in enumerate(titles):
        example = row_of(examples, row)
        found = None if lanes is None else row_of(lanes, row)
        boxes = None if elements is None else row_of(elements, row)
        for numbers, line in ((ahead, axes[2 * row]), (back, axes[2 * row + 1])):
            for number, ax in zip(numbers, line, strict=False):
                draw_camera(ax, example, number, found, boxes, threshold=threshold)
        above = axes[2 * row, len(ahead)]
        above.set_axis_on()
        _draw_above(above, example, found, title, threshold, ground, view)
    across = -(-len(entries) // rows)
    figure.legend(handles=entries, loc="outside lower center", ncols=across, fontsize=7, frameon=False)
    return save_figure(figure, path)


def _page_entries(lanes: LanePrediction | None, examples: Example) -> list:
    """Return the entries of the legend: what the camera images show, then what the view from above adds."""
    entries = legend_entries(lanes)
    for entry in above_entries(lanes, examples):
        entry.set_label(f"from above: {entry.get_label()}")
        entries.append(entry)
    return entries


def draw_camera(
    ax: Axes,
    example: Example,
    number: int,
    lanes: LanePrediction | None = None,
    elements: ElementPrediction | None = None,
    *,
    threshold: float = 0.3,
) -> None:
    """Draw one camera's image with lanes, and camera 0 with traffic elements: the predictions, or else the truth.

    Args:
        ax: where to draw.
        example: one example with camera images.
        number: of the camera; one without an image is named so.
        lanes, elements: predictions for the example; with either, the truth is not drawn.
        threshold: lowest score of what is drawn.
    """
    views = example.cameras
    assert views is not None
    if not bool(np.asarray(views.valid)[number]):  # it has no size either
        ax.set_axis_off()
        ax.set_title("no image", fontsize=8, loc="left")
        return
    width, height = (int(side) for side in np.asarray(views.size)[number])
    draw_image(ax, np.asarray(views.image)[number, :height, :width], _heading(views, number))
    if max(width, height) < _PIXELATED:
        ax.images[-1].set_interpolation("nearest")
    if lanes is not None:
        _draw_predicted_lanes(ax, views, number, lanes, example.map_lines, threshold)
    if number == 0 and elements is not None:
        attribute, shown = np.asarray(elements.logits).argmax(-1), np.asarray(elements.scores) >= threshold
        draw_boxes(ax, np.asarray(elements.box), attribute, shown)
    if lanes is None and elements is None:
        _draw_truth(ax, views, number, example)


def _draw_predicted_lanes(
    ax: Axes, views: CameraViews, number: int, lanes: LanePrediction, truth: MapLines | None, threshold: float
) -> None:
    """Draw predicted lanes, segments or map lines; behind map lines, the true ones thin and white."""
    if isinstance(lanes, SegmentPrediction):
        _draw_segments(ax, views, number, lanes, threshold)
    elif isinstance(lanes, LinePrediction):
        if truth is not None:
            known = np.asarray(truth.points)[np.asarray(truth.valid)]
            draw_projected(ax, views, number, known, colour="white", width=0.6)
        points, category, _ = chosen_lines(lanes, threshold)
        draw_projected_by_class(ax, views, number, points, category)
    else:
        draw_projected(ax, views, number, np.asarray(lanes.points)[np.asarray(lanes.scores) >= threshold])


def _draw_truth(ax: Axes, views: CameraViews, number: int, example: Example) -> None:
    """Draw the map lines of an example, or its lanes where it has none; in camera 0 the traffic elements, too."""
    lines, elements = example.map_lines, example.traffic_elements
    if lines is not None:
        points, category = valid_rows(lines.valid, lines.points, lines.category)
        draw_projected_by_class(ax, views, number, points, category)
    else:
        draw_projected(ax, views, number, np.asarray(example.lanes.points)[np.asarray(example.lanes.valid)])
    if number == 0 and elements is not None:
        draw_boxes(ax, np.asarray(elements.box), np.asarray(elements.attribute), np.asarray(elements.valid))


def _draw_segments(ax: Axes, views: CameraViews, number: int, found: SegmentPrediction, threshold: float) -> None:
    """Draw predicted segments: thin centerlines by direction, boundaries by type, outlines of crossings, kerbs."""
    lanes, _ = chosen_segments(found, threshold)
    left, right = np.asarray(found.left), np.asarray(found.right)
    draw_projected(ax, views, number, np.asarray(found.points)[lanes], width=0.8)
    for lines, types in zip((left, right), boundary_types(found, lanes), strict=True):
        draw_projected_boundaries(ax, views, number, lines[lanes], types)
    rings, _ = chosen_areas(found, threshold, AreaType.PEDESTRIAN_CROSSING)
    closed = np.concatenate([rings, rings[:, :1]], 1)
    draw_projected(ax, views, number, closed, colour=style.CROSSING, width=1.5)
    kerbs, _ = chosen_areas(found, threshold, AreaType.ROAD_BOUNDARY)
    draw_projected(ax, views, number, kerbs, colour=style.ROAD_BOUNDARY, width=1.5)


def _draw_above(
    ax: Axes,
    example: Example,
    lanes: LanePrediction | None,
    title: str,
    threshold: float,
    ground: PerceptionRange,
    view: PerceptionRange,
) -> None:
    ax.set_xlabel("x, forward [m]", fontsize=7, labelpad=1.0)
    ax.set_ylabel("y, left [m]", fontsize=7, labelpad=1.0)
    if lanes is None:
        true = truth_layers(None) if example.map_lines is None else ("map_lines",)
        layers = ("hidden", *true, "sd_map", "traffic", "markers", "elements")
        draw_scene(ax, example, layers=layers, ground=ground, view=view, title=title)
        return
    draw_found(ax, example, lanes, ground=ground, view=view, threshold=threshold, title=title)


def legend_entries(lanes: LanePrediction | None) -> list:
    """Return the entries of a legend for what the camera images show; None: the truth."""
    from matplotlib.lines import Line2D

    if isinstance(lanes, LinePrediction):
        return [*class_entries(), truth_entry()]
    names = ("lane ahead", "to the left", "back", "to the right")
    colours = direction_colours(np.array([0.0, 0.5, 1.0, -0.5]) * np.pi)
    ways = [Line2D([], [], color=colour, lw=1.5, label=name) for colour, name in zip(colours, names, strict=True)]
    return [*boundary_entries(style.PREDICTION), *ways] if isinstance(lanes, SegmentPrediction) else ways


def _azimuth(views: CameraViews) -> Float[np.ndarray, " v"]:
    axis = invert_pose(np.asarray(views.camera_from_ego, np.float64))[:, :3, 2]
    return np.arctan2(axis[:, 1], axis[:, 0])


def _rows_of_cameras(views: CameraViews) -> tuple[list[int], list[int]]:
    """Return the front cameras and the rear cameras, each in the order of turning clockwise."""
    azimuth = _azimuth(views)
    order = np.argsort(-azimuth, kind="stable")
    ahead = np.cos(azimuth) > 0.25
    # Rear cameras go from the left shoulder over the back to the right shoulder.
    back = order[~ahead[order]]
    return order[ahead[order]].tolist(), sorted(back.tolist(), key=lambda number: azimuth[number] % (2.0 * np.pi))


def _heading(views: CameraViews, number: int) -> str:
    degrees = round(float(np.rad2deg(_azimuth(views)[number])))
    if abs(degrees) <= 2:
        return "ahead"
    return "back" if abs(degrees) >= 178 else f"{abs(degrees)}° {'left' if degrees > 0 else 'right'}"

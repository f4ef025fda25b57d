"""Camera images overlaid with lanes and traffic elements, beside the scene from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, invert_pose
from tflane_jax.geometry.cameras import project
from tflane_jax.geometry.polylines import resample_lines
from tflane_jax.plots import style
from tflane_jax.plots.bev import GROUND, VIEW, draw_found, draw_scene, truth_layers
from tflane_jax.plots.figure import new_figure, save_figure
from tflane_jax.plots.images import draw_image
from tflane_jax.plots.legends import above_entries, boundary_entries, truth_entry
from tflane_jax.plots.lines import valid_rows
from tflane_jax.plots.map_lines import chosen_lines, class_entries
from tflane_jax.plots.segments import boundary_types, chosen_areas, chosen_segments
from tflane_jax.scene import (
    AreaType,
    CameraViews,
    ElementPrediction,
    Example,
    LanePrediction,
    LineClass,
    LinePrediction,
    LineType,
    SegmentPrediction,
    TrafficElements,
    row_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ATTRIBUTE_NAMES = (
    "?",
    "red",
    "green",
    "yellow",
    "straight",
    "left",
    "right",
    "no left",
    "no right",
    "U-turn",
    "no U-turn",
    "slight left",
    "slight right",
)
"""Short names of OpenLane-V2's attributes of traffic elements, by number."""

_PANEL = 3.4  # inches
# Points on a lane in an image: less than half a metre apart on the longest lanes.
_POINTS = 201
# Length of a dash and of dash with gap, metres; None: no gaps.
_DASHES = {LineType.NONE: (0.5, 2.0), LineType.SOLID: None, LineType.DASHED: (2.5, 5.0)}
# Lanes are cut off at this depth, metres.
_NEAR = 0.5
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
    predicted = lanes is not None or elements is not None
    if isinstance(lanes, SegmentPrediction):
        _draw_segments(ax, views, number, lanes, threshold)
    elif isinstance(lanes, LinePrediction):
        if example.map_lines is not None:
            known = np.asarray(example.map_lines.points)[np.asarray(example.map_lines.valid)]
            draw_projected(ax, views, number, known, colour="white", width=0.6)
        points, category, _ = chosen_lines(lanes, threshold)
        draw_projected_by_class(ax, views, number, points, category)
    elif lanes is not None:
        draw_projected(ax, views, number, np.asarray(lanes.points)[np.asarray(lanes.scores) >= threshold])
    elif not predicted and example.map_lines is not None:
        points, category = valid_rows(example.map_lines.valid, example.map_lines.points, example.map_lines.category)
        draw_projected_by_class(ax, views, number, points, category)
    elif not predicted:
        draw_projected(ax, views, number, np.asarray(example.lanes.points)[np.asarray(example.lanes.valid)])
    if number == 0 and elements is not None:
        attribute, shown = np.asarray(elements.logits).argmax(-1), np.asarray(elements.scores) >= threshold
        draw_boxes(ax, np.asarray(elements.box), attribute, shown)
    elif number == 0 and not predicted and example.traffic_elements is not None:
        truth: TrafficElements = example.traffic_elements
        draw_boxes(ax, np.asarray(truth.box), np.asarray(truth.attribute), np.asarray(truth.valid))


def draw_projected(
    ax: Axes,
    views: CameraViews,
    number: int,
    lines: Float[np.ndarray, "n p 3"],
    *,
    colour: str | None = None,
    width: float = 1.3,
    dash: tuple[float, float] | None = None,
) -> None:
    """Draw lines of the ego frame into a camera's image.

    Args:
        ax, views, number: where, and which camera.
        lines: metres.
        colour: of all lines; None: by direction, ahead green, left blue, back magenta, right orange.
        width: of the lines, points.
        dash: length of a dash and of dash with gap on the ground, metres; None draws whole lines.
    """
    from matplotlib.collections import LineCollection

    if not len(lines):
        return
    dense = resample_lines(list(np.asarray(lines, np.float64)), _POINTS)
    columns, height = np.asarray(views.size)[number]
    pixels, depth, _ = project(
        dense.reshape(-1, 3),
        np.asarray(views.intrinsics, np.float64)[number],
        np.asarray(views.camera_from_ego, np.float64)[number],
    )
    pixels, depth = pixels.reshape(*dense.shape[:2], 2), depth.reshape(dense.shape[:2])
    margin = 0.1 * max(columns, height)
    shown = (depth > _NEAR) & ((pixels > -margin) & (pixels < [columns + margin, height + margin])).all(-1)
    step = np.diff(dense[..., :2], axis=1)
    pieces = shown[:, 1:] & shown[:, :-1]
    if dash is not None:
        along = np.cumsum(np.linalg.norm(step, axis=-1), axis=1)
        pieces &= along % dash[1] < dash[0]
    colours = colour or _direction_colours(np.arctan2(step[..., 1], step[..., 0]))[pieces]
    parts = np.stack([pixels[:, :-1], pixels[:, 1:]], 2)[pieces]
    ax.add_collection(LineCollection(list(parts), colors=colours, linewidths=width, alpha=0.85, zorder=2.0))


def draw_projected_boundaries(
    ax: Axes, views: CameraViews, number: int, lines: Float[np.ndarray, "n p 3"], types: Int[np.ndarray, " n"]
) -> None:
    """Draw boundaries into a camera's image by `LineType`: solid, dashed, or dotted and thin for none."""
    for kind, dash in _DASHES.items():
        width = 0.9 if kind == LineType.NONE else 1.3
        mine = lines[np.asarray(types) == kind]
        draw_projected(ax, views, number, mine, colour=style.PREDICTION, width=width, dash=dash)


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


def draw_projected_by_class(
    ax: Axes, views: CameraViews, number: int, points: Float[np.ndarray, "n p 3"], category: Int[np.ndarray, " n"]
) -> None:
    """Draw lines of a vector map into a camera's image, in the colours of their classes."""
    for kind, colour in style.MAP_LINE.items():
        width = 0.8 if kind == LineClass.CENTERLINE else 1.5
        draw_projected(ax, views, number, points[category == kind], colour=colour, width=width)


def draw_boxes(
    ax: Axes, box: Float[np.ndarray, "e 2 2"], attribute: Int[np.ndarray, " e"], chosen: Bool[np.ndarray, " e"]
) -> None:
    """Draw boxes of traffic elements (pixels) with the names of their attributes."""
    from matplotlib.patches import Rectangle

    for (low, high), shows in zip(box[chosen], attribute[chosen].tolist(), strict=True):
        colour = style.LIGHT.get(shows, style.PREDICTION)
        ax.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=colour, linewidth=1.0, zorder=3.0))
        label = ATTRIBUTE_NAMES[shows]
        ax.text(low[0], low[1], label, color=colour, fontsize=5, va="bottom", ha="left", clip_on=True, zorder=3.1)


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
    colours = _direction_colours(np.array([0.0, 0.5, 1.0, -0.5]) * np.pi)
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


def _direction_colours(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    from matplotlib.colors import hsv_to_rgb

    hue = (angle / (2.0 * np.pi) + 1.0 / 3.0) % 1.0
    return hsv_to_rgb(np.stack([hue, np.full_like(hue, 0.75), np.ones_like(hue)], -1))

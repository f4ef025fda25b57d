"""Scenes and predictions from above: x (forward) to the right, y (left) upward, metres.

Each `draw_*` adds one layer to a matplotlib `Axes`; `draw_scene` draws the usual ones. Padding is not drawn.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Array, Bool, UInt8

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.plots import style
from tflane_jax.plots.lines import add_arrows, add_crossings, add_lines, add_links, box_corners, faded, valid_rows
from tflane_jax.plots.map_lines import draw_line_prediction, draw_map_lines
from tflane_jax.plots.priors import draw_markers, draw_sd_map, draw_traffic
from tflane_jax.plots.segments import (
    draw_segment_prediction,
    draw_segments,
    true_lanes,
    visibility_colours,
)
from tflane_jax.scene import (
    Areas,
    AreaType,
    Example,
    LaneGraph,
    LanePrediction,
    LinePrediction,
    SegmentPrediction,
    TrafficElements,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Layer = Literal[
    "evidence", "hidden", "areas", "lanes", "segments", "map_lines", "sd_map", "traffic", "markers", "elements"
]
# The ground that rasters cover, and the part of it that is shown by default.
GROUND = BevGrid().range
VIEW = PerceptionRange()

_EGO_SIZE = (4.8, 2.0)
# What a model is given.
INPUTS: tuple[Layer, ...] = ("evidence", "sd_map", "traffic", "markers")
ALL_LAYERS: tuple[Layer, ...] = (*INPUTS, "hidden", "areas", "lanes", "elements")


def draw_scene(
    ax: Axes,
    example: Example,
    *,
    layers: Collection[Layer] = ALL_LAYERS,
    ground: PerceptionRange = GROUND,
    view: PerceptionRange = VIEW,
    strength: float = 1.0,
    title: str = "",
) -> None:
    """Draw one example (no batch axis): the given layers, the ego vehicle, and axes in metres.

    Args:
        ax: where to draw.
        example: layers that it does not have are skipped.
        layers: to draw, in a fixed order; by default all but "segments" and "map_lines", which cover the
            lanes.
        ground: range of `example.bev` and `example.hidden`.
        view: range to show.
        strength: of the evidence, 0 to 1.
        title: above the picture.
    """
    prepare(ax, view, title)
    if "evidence" in layers and example.bev is not None:
        draw_evidence(ax, example.bev, ground, strength=strength)
    if "hidden" in layers and example.hidden is not None:
        draw_hidden(ax, example.hidden, ground)
    if "areas" in layers:
        draw_areas(ax, example.areas)
    if "lanes" in layers:
        draw_lanes(ax, example.lanes)
    if "segments" in layers:
        draw_segments(ax, example.segments)
    if "map_lines" in layers and example.map_lines is not None:
        draw_map_lines(ax, example.map_lines)
    if "sd_map" in layers and example.sd_map is not None:
        draw_sd_map(ax, example.sd_map)
    if "traffic" in layers and example.traffic_flow is not None:
        draw_traffic(ax, example.traffic_flow)
    if "markers" in layers and example.markers is not None:
        draw_markers(ax, example.markers)
    if "elements" in layers and example.traffic_elements is not None:
        draw_elements(ax, example.traffic_elements)
    draw_ego(ax)


def prepare(ax: Axes, view: PerceptionRange = VIEW, title: str = "") -> None:
    """Set up empty ground: limits, equal scale, a faint grid."""
    ax.set_facecolor(style.ROAD)
    ax.set(xlim=view.x, ylim=view.y, aspect="equal")
    ax.set_title(title, fontsize=9, loc="left")
    ax.tick_params(labelsize=7, length=2)
    ax.grid(color=style.GRID, linewidth=0.4, zorder=0)
    ax.set_axisbelow(True)


def draw_evidence(
    ax: Axes, bev: UInt8[Array, "h w c"], ground: PerceptionRange = GROUND, *, strength: float = 1.0
) -> None:
    """Draw the evidence raster (H, W, C) uint8 as light on dark ground; `strength` 0 to 1 dims it."""
    from matplotlib.colors import to_rgb

    colour = np.asarray([style.EVIDENCE[channel] for channel in style.EVIDENCE], np.float32)
    light = np.asarray(bev, np.float32)[..., list(style.EVIDENCE)] / 255.0 * strength
    # Channels blend like layers of translucent paint: none hides another.
    road = np.asarray(to_rgb(style.ROAD), np.float32)
    shown = 1.0 - (1.0 - road) * np.prod(1.0 - light[..., None] * colour, axis=-2)
    ax.imshow(shown, extent=_extent(ground), origin="lower", interpolation="bilinear", zorder=0.5)


def draw_hidden(ax: Axes, hidden: Bool[Array, "h w"], ground: PerceptionRange = GROUND) -> None:
    """Darken and hatch the ground out of sight."""
    from matplotlib.colors import ListedColormap

    dark = np.asarray(hidden, bool)
    if not dark.any():
        return
    shade = np.ma.masked_where(~dark, np.ones(dark.shape))
    ax.imshow(shade, extent=_extent(ground), origin="lower", cmap=ListedColormap(["black"]), alpha=0.45, zorder=0.8)
    filled = ax.contourf(
        dark.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"], extent=_extent(ground), origin="lower"
    )
    # The default edge colour would draw the hatch black on black.
    filled.set(edgecolor=style.HATCH, linewidth=0.0, zorder=0.9)


def draw_areas(ax: Axes, areas: Areas) -> None:
    """Draw crossings (shaded) and road boundaries."""
    points, category = valid_rows(areas.valid, areas.points, areas.category)
    add_lines(ax, points[category == AreaType.ROAD_BOUNDARY], style.ROAD_BOUNDARY, width=1.0, zorder=1.0)
    add_crossings(ax, points[category == AreaType.PEDESTRIAN_CROSSING])


def draw_lanes(
    ax: Axes, lanes: LaneGraph, *, colour: str | None = None, width: float = 1.5, alpha: float = 1.0
) -> None:
    """Draw true lanes with arrows in driving direction; without a `colour`, they are coloured by visibility."""
    points, visibility = valid_rows(lanes.valid, lanes.points, lanes.visibility)
    colours = visibility_colours(visibility) if colour is None else colour
    add_lines(ax, points, colours, width=width, alpha=alpha, zorder=3.0)
    add_arrows(ax, points, colours, alpha=alpha, zorder=3.1)


def draw_elements(ax: Axes, elements: TrafficElements) -> None:
    """Draw traffic lights (round, in the colour of their state) and signs (square)."""
    position, category, attribute = valid_rows(elements.valid, elements.position, elements.category, elements.attribute)
    for kind, marker in ((1, "o"), (2, "s")):
        mine = category == kind
        colours = [
            style.LIGHT.get(int(a), style.OTHER_ELEMENT) if kind == 1 else style.OTHER_ELEMENT for a in attribute[mine]
        ]
        ax.scatter(
            position[mine, 0],
            position[mine, 1],
            c=colours,
            marker=marker,
            s=22,
            edgecolors="black",
            linewidths=0.6,
            zorder=5.0,
        )


def draw_ego(ax: Axes) -> None:
    """Draw the ego vehicle at the origin, heading along x."""
    from matplotlib.collections import PolyCollection

    body = box_corners(np.zeros((1, 2)), np.zeros(1), np.asarray([_EGO_SIZE]))
    ax.add_collection(PolyCollection(list(body), facecolors=style.EGO, edgecolors="black", linewidths=0.6, zorder=6.0))
    nose = np.asarray([[[1.6, 0.0], [0.2, 0.7], [0.2, -0.7]]])
    ax.add_collection(PolyCollection(list(nose), facecolors=style.ROAD, zorder=6.1))


def draw_prediction(ax: Axes, prediction: LanePrediction, *, threshold: float = 0.3) -> None:
    """Draw lanes with a score of at least `threshold`, opacity by score, and their topology.

    A link runs from the end of a lane to the start of its successor if the score of the edge is above 0.5. Segments
    have boundaries by type, see `draw_boundaries`; crossings are shaded. Lines of a vector map are coloured by class.
    """
    if isinstance(prediction, LinePrediction):
        draw_line_prediction(ax, prediction, threshold=threshold)
        return
    if isinstance(prediction, SegmentPrediction):
        draw_segment_prediction(ax, prediction, threshold=threshold)
        return
    scores = np.asarray(prediction.scores)
    chosen = scores >= threshold
    points = np.asarray(prediction.points)[chosen]
    colours = faded(style.PREDICTION, scores[chosen])
    add_lines(ax, points, colours, width=1.7, zorder=3.5)
    add_arrows(ax, points, colours, zorder=3.6)
    if prediction.successor_logits is not None:
        add_links(ax, points, np.asarray(prediction.successor_logits)[np.ix_(chosen, chosen)])


def draw_found(
    ax: Axes,
    example: Example,
    prediction: LanePrediction,
    *,
    ground: PerceptionRange = GROUND,
    view: PerceptionRange = VIEW,
    threshold: float = 0.3,
    title: str = "",
) -> None:
    """Draw a prediction over its ground truth, thin and white, and dim evidence; arguments as of `draw_scene`."""
    prepare(ax, view, title)
    if example.bev is not None:
        draw_evidence(ax, example.bev, ground, strength=0.3)
    if not isinstance(prediction, LinePrediction):
        draw_lanes(ax, true_lanes(example, prediction), colour="white", width=0.8, alpha=0.45)
    elif example.map_lines is not None:
        draw_map_lines(ax, example.map_lines, colour="white", width=0.8, alpha=0.45)
    draw_prediction(ax, prediction, threshold=threshold)
    draw_ego(ax)


def inputs_title(example: Example) -> str:
    """Return the title of a panel with `INPUTS`: those that the example has."""
    given = {
        "evidence": example.bev,
        "SD map": example.sd_map,
        "traffic": example.traffic_flow,
        "boards": example.markers,
    }
    *others, last = [name for name, value in given.items() if value is not None] or ["nothing"]
    return f"{', '.join(others)} and {last}" if others else last


def truth_layers(prediction: LanePrediction | None) -> tuple[Layer, ...]:
    """Return the layers that show the ground truth of a prediction; crossings and boundaries are lines of a map."""
    if isinstance(prediction, LinePrediction):
        return ("map_lines",)
    return ("areas", "segments") if isinstance(prediction, SegmentPrediction) else ("areas", "lanes")


def _extent(ground: PerceptionRange) -> tuple[float, float, float, float]:
    return (*ground.x, *ground.y)

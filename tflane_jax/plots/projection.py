"""Lines and boxes drawn into a camera's image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry.cameras import project
from tflane_jax.geometry.polylines import resample_lines
from tflane_jax.plots import style
from tflane_jax.scene import CameraViews, LineClass, LineType

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

# Points on a lane in an image: less than half a metre apart on the longest lanes.
_POINTS = 201
# Length of a dash and of dash with gap, metres; None: no gaps.
_DASHES = {LineType.NONE: (0.5, 2.0), LineType.SOLID: None, LineType.DASHED: (2.5, 5.0)}
# Lanes are cut off at this depth, metres.
_NEAR = 0.5


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
    colours = colour or direction_colours(np.arctan2(step[..., 1], step[..., 0]))[pieces]
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


def direction_colours(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """Return the RGB colour of each direction (radians, 0 ahead, left positive)."""
    from matplotlib.colors import hsv_to_rgb

    hue = (angle / (2.0 * np.pi) + 1.0 / 3.0) % 1.0
    return hsv_to_rgb(np.stack([hue, np.full_like(hue, 0.75), np.ones_like(hue)], -1))

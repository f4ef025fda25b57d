"""Priors from above: the tracks of road users, the boards of markers with their lanes, the roads of an SD map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tflane_jax.plots import style
from tflane_jax.plots.lines import add_arrows, add_lines, box_corners, valid_rows
from tflane_jax.scene import Example, MarkerObservations, RoadUser, SdMap, TrafficFlow

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_traffic(ax: Axes, flow: TrafficFlow) -> None:
    """Draw tracks: a trail that fades with age, and the box of the latest frame, not filled if it was not seen."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    known = np.asarray(flow.valid).any(-1)
    position, yaw, size, category, occluded, valid = valid_rows(
        known, flow.position, flow.yaw, flow.size, flow.category, flow.occluded, flow.valid
    )
    if len(valid) == 0:
        return
    colours = to_rgba_array([style.ROAD_USER[RoadUser(c)] for c in category])
    frames = valid.shape[1]
    user, frame = np.nonzero(valid[:, 1:] & valid[:, :-1])
    trail = np.stack([position[user, frame, :2], position[user, frame + 1, :2]], 1)
    fading = colours[user]
    fading[:, 3] = 0.08 + 0.8 * (frame + 1) / max(frames - 1, 1)
    ax.add_collection(LineCollection(list(trail), colors=fading, linewidths=1.4, zorder=4.0))

    each, last = np.arange(len(valid)), frames - 1 - np.argmax(valid[:, ::-1], axis=1)
    boxes = box_corners(position[each, last, :2], yaw[each, last], size[:, :2])
    filled = colours.copy()
    filled[:, 3] = np.where(occluded[each, last], 0.0, 0.55)
    ax.add_collection(PolyCollection(list(boxes), facecolors=filled, edgecolors=colours, linewidths=0.9, zorder=4.1))


def draw_markers(ax: Axes, markers: MarkerObservations) -> None:
    """Draw the boards detected in a frame, where they seem to stand, and the lanes that their store puts around them.

    Errors of a detection move its lanes, too: what is drawn is what a model is given.
    """
    pose, lanes, known = valid_rows(markers.valid, markers.pose, markers.lanes, markers.lane_valid)
    lines = lanes[known]
    add_lines(ax, lines, style.BOARD_LANE, width=1.1, zorder=4.2)
    add_arrows(ax, lines, style.BOARD_LANE, zorder=4.3)
    ax.scatter(
        pose[:, 0, 3], pose[:, 1, 3], c=style.BOARD, marker="s", s=26, edgecolors="black", linewidths=0.6, zorder=5.1
    )


def draw_sd_map(ax: Axes, sd_map: SdMap) -> None:
    """Draw the roads of an SD map, where its errors put them."""
    (lines,) = valid_rows(sd_map.valid, sd_map.points)
    add_lines(ax, lines, style.SD_ROAD, width=2.4, alpha=0.75, zorder=2.0)


def prior_entries(examples: Example) -> list:
    """Return the entries of a legend for boards and SD map, where examples have them."""
    from matplotlib.lines import Line2D

    entries: list = []
    if examples.markers is not None:
        entries.append(Line2D([], [], color=style.BOARD, lw=0, marker="s", ms=5, mec="black", label="board detected"))
        entries.append(Line2D([], [], color=style.BOARD_LANE, lw=1.4, label="lane in its store"))
    if examples.sd_map is not None:
        entries.append(Line2D([], [], color=style.SD_ROAD, lw=2.4, label="road of the SD map"))
    return entries

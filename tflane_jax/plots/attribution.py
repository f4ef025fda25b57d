"""Pictures of how a lane depends on road users: bands along lanes, numbered tracks, bars, scores without road users."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float, Int

from tflane_jax.plots import style
from tflane_jax.plots.lines import box_corners
from tflane_jax.scene import TrafficFlow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAINT = 0.12
"""Opacity of a track with weight 0; the largest weight of a picture has opacity 1."""
# Labels of points above this fraction of the panel's height stand below them: above, they would cover its title.
_HIGHEST_LABEL = 0.85


def draw_lane_bands(ax: Axes, lanes: Float[Array, "g n 3"]) -> None:
    """Draw translucent bands of 2.6 m along lanes (metres, ego frame), under all other lines."""
    from matplotlib.collections import PolyCollection

    colour = style.LANE_HIDDEN
    points = np.asarray(lanes, np.float64)[..., :2]
    step = np.gradient(points, axis=1)
    across = np.stack([-step[..., 1], step[..., 0]], -1)
    across *= 1.3 / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    bands = np.concatenate([points + across, (points - across)[:, ::-1]], 1)
    ax.add_collection(
        PolyCollection(list(bands), facecolors=[f"{colour}38"], edgecolors=colour, linewidths=1.0, zorder=2.0)
    )


def draw_road_users(
    ax: Axes,
    flow: TrafficFlow,
    road_users: Int[Array, " t"],
    weights: Float[Array, " t"],
    *,
    absent: Collection[int] = (),
) -> None:
    """Draw tracks with an opacity by weight, numbered 0, 1, ... in the order given, over a scene with its limits set.

    Tracks without a valid frame are left out; the others keep their numbers.

    Args:
        ax: where to draw.
        flow: traffic flow of the frame.
        road_users: tracks in it.
        weights: of each, for example attention.
        absent: positions in `road_users` that are drawn as an empty, crossed-out box.
    """
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba

    values = np.asarray(weights, np.float64)
    strength = (FAINT + (1.0 - FAINT) * values / max(values.max(initial=0.0), 1e-9)).tolist()
    paths: dict[int, np.ndarray] = {}
    for i, user in enumerate(np.asarray(road_users).tolist()):
        seen = np.flatnonzero(np.asarray(flow.valid)[user])
        if not len(seen):
            continue
        paths[i] = path = np.asarray(flow.position)[user, seen, :2]
        last = seen[-1]
        (box,) = box_corners(path[-1:], np.asarray(flow.yaw)[[user], last], np.asarray(flow.size)[[user], :2])
        lines, colour, fill = [path], to_rgba(style.LINK, strength[i]), to_rgba(style.LINK, 0.6 * strength[i])
        if i in absent:
            lines, colour, fill = [box[[0, 2]], box[[1, 3]]], to_rgba(style.OTHER_ELEMENT), "none"
        ax.add_collection(LineCollection(lines, colors=[colour], linewidths=1.6, zorder=3.3))
        ax.add_collection(PolyCollection([box], facecolors=[fill], edgecolors=[colour], linewidths=1.0, zorder=4.1))
    for i, place in _label_places(ax, paths).items():
        edge = style.OTHER_ELEMENT if i in absent else to_rgba(style.LINK, strength[i])
        ax.annotate(
            str(i),
            place.tolist(),
            (0, -11 if ax.transLimits.transform(place)[1] > _HIGHEST_LABEL else 11),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            color=style.OTHER_ELEMENT if i in absent else "white",
            zorder=7.0,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": style.ROAD, "edgecolor": edge, "lw": 1.0},
        )


def draw_bars(
    ax: Axes,
    values: Float[Array, " t"],
    *,
    title: str,
    label: str,
    highlighted: Collection[int] = (),
    reference: float | None = None,
) -> None:
    """Draw a bar for each road user, numbered 0, 1, ... from the top.

    Args:
        ax: where to draw.
        values: one per road user.
        title: above the picture.
        label: of the axis of values.
        highlighted: positions of bars in the colour of attention; the others are grey.
        reference: value at which a dashed line is drawn, None for none.
    """
    places = np.arange(len(values))
    colours = [style.LINK if i in highlighted else "#8b93a3" for i in range(len(values))]
    ax.barh(places, np.asarray(values), color=colours, height=0.7)
    if reference is not None:
        ax.axvline(reference, color="black", lw=0.9, ls="--")
    ax.set_yticks(places, [str(place) for place in places])
    ax.invert_yaxis()
    ax.set_title(title, fontsize=9, loc="left")
    ax.set_xlabel(label, fontsize=8)
    ax.set_ylabel("road user", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.margins(y=0.02)


def draw_removal(ax: Axes, scores: Mapping[str, Float[Array, " n"]], *, title: str) -> None:
    """Draw scores of a lane after 0, 1, 2, ... road users were removed, a curve for each order by name."""
    for name, curve in scores.items():
        ax.plot(np.arange(len(curve)), np.asarray(curve), marker="o", ms=3, lw=1.4, label=name)
    ax.set_ylim(bottom=0.0)
    ax.set_title(title, fontsize=9, loc="left")
    ax.set_xlabel("road users taken away", fontsize=8)
    ax.set_ylabel("score of the lane", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.3, lw=0.5)
    if scores:
        ax.legend(fontsize=7, frameon=False)


def _label_places(ax: Axes, paths: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Return for each path that has a point in view, 1.5 m inside the limits, the point to label.

    That is its last point. If it is out of view, it is the point in view that is farthest from the other labels.
    """
    (left, right), (low, high) = ((start + 1.5, end - 1.5) for start, end in (ax.get_xlim(), ax.get_ylim()))
    inside = {
        i: (path[:, 0] > left) & (path[:, 0] < right) & (path[:, 1] > low) & (path[:, 1] < high)
        for i, path in paths.items()
    }
    places = {i: path[-1] for i, path in paths.items() if inside[i][-1]}
    for i, path in paths.items():
        if i not in places and inside[i].any():
            points, others = path[inside[i]], np.array([*places.values()]).reshape(-1, 2)
            nearest = np.linalg.norm(points[:, None] - others, axis=-1).min(1, initial=1e9)
            places[i] = points[nearest.argmax()]
    return dict(sorted(places.items()))

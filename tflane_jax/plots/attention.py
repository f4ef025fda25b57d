"""Masks and attention weights of the traffic-flow module (TF-Lane, section 3.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.plots import style
from tflane_jax.scene import TrafficFlow

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_lane_attention(
    ax: Axes,
    lanes: Float[Array, "q p 3"],
    flow: TrafficFlow,
    weights: Float[Array, "q t"],
    *,
    instance: Int[Array, " t"],
    valid: Bool[Array, " t"],
    lane_valid: Bool[Array, " q"] | None = None,
    least: float = 0.1,
) -> None:
    """Draw the attention of lanes to road users as links over a scene that was drawn before (`draw_scene`).

    Args:
        ax: where to draw.
        lanes: the lanes of the queries, metres, ego frame.
        flow: the traffic flow of the tokens.
        weights: attention of lane q to token t, 0 to 1.
        instance: index in `flow` of each token.
        valid: tokens that are not padding.
        lane_valid: queries to draw; None draws all.
        least: smallest weight to draw.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba

    strength, seen = np.asarray(weights), np.asarray(flow.valid)
    drawn = np.asarray(valid)[None] & (strength >= least)
    if lane_valid is not None:
        drawn &= np.asarray(lane_valid)[:, None]
    query, token = np.nonzero(drawn)
    user, strength = np.asarray(instance)[token], strength[query, token]
    latest = seen.shape[1] - 1 - np.argmax(seen[user][:, ::-1], axis=1)
    there = np.asarray(flow.position)[user, latest, :2]
    here = np.asarray(lanes)[query, lanes.shape[1] // 2, :2]
    colours = np.tile(to_rgba(style.LINK), (len(query), 1))
    colours[:, 3] = np.clip(strength, 0.0, 1.0)
    ax.add_collection(
        LineCollection(list(np.stack([here, there], 1)), colors=colours, linewidths=0.5 + 2.5 * strength, zorder=5.5)
    )
    ax.scatter(here[:, 0], here[:, 1], s=8, c=style.PREDICTION, linewidths=0, zorder=5.6)


def draw_attention_matrix(
    ax: Axes, weights: Float[Array, "q t"], *, valid: Bool[Array, " t"] | None = None, title: str = ""
) -> None:
    """Draw attention weights as a matrix, lanes down, road users across; padding tokens are grey."""
    shown = np.asarray(weights, np.float64)
    if valid is not None:
        shown = np.where(np.asarray(valid)[None], shown, np.nan)
    ax.set_facecolor("#d5d7db")
    image = ax.imshow(np.ma.masked_invalid(shown), aspect="auto", cmap="magma", vmin=0.0, interpolation="nearest")
    bar = ax.figure.colorbar(image, ax=ax, fraction=0.04, pad=0.02)
    bar.ax.tick_params(labelsize=7)
    _label(ax, title)
    ax.set_xlabel("road user", fontsize=8)
    ax.set_ylabel("lane query", fontsize=8)


def draw_temporal_mask(ax: Axes, frame_valid: Bool[Array, "t n"]) -> None:
    """Draw which frames of each road user are attended to (light), oldest frame on the left."""
    _grid(ax, np.asarray(frame_valid), "temporal mask")
    ax.set_xlabel("frame, oldest first", fontsize=8)
    ax.set_ylabel("road user", fontsize=8)


def draw_spatial_mask(ax: Axes, mask: Bool[Array, "s s"], lanes: int, *, title: str = "spatial mask $M_s$") -> None:
    """Draw M_s, (L+T, L+T), as the four quadrants L->L, L->T, T->L, T->T. Light: row attends to column.

    Args:
        ax: where to draw.
        mask: true where attention is allowed.
        lanes: L; road users follow the lanes.
        title: above the picture.
    """
    size = len(mask)
    _grid(ax, np.asarray(mask), title)
    for cut in (ax.axhline, ax.axvline):
        cut(lanes - 0.5, color=style.LINK, lw=1.2)
    middle = ((lanes - 1) / 2, (lanes + size - 1) / 2)
    for row, first in zip(middle, "LT", strict=True):
        for column, second in zip(middle, "LT", strict=True):
            ax.text(
                column,
                row,
                f"{first}→{second}",
                ha="center",
                va="center",
                fontsize=9,
                color="black",
                bbox={"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.5},
            )
    ax.set_aspect("equal")


def _grid(ax: Axes, allowed: np.ndarray, title: str) -> None:
    from matplotlib.colors import ListedColormap

    colours = ListedColormap([style.ROAD, style.LANE_CLEAR])
    ax.imshow(allowed, aspect="auto", cmap=colours, vmin=0, vmax=1, interpolation="nearest")
    _label(ax, title)


def _label(ax: Axes, title: str) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.set_title(title, fontsize=9, loc="left")
    ax.tick_params(labelsize=7)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))

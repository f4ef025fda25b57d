"""Masks of the traffic-flow module (TF-Lane, section 3.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Bool

from tflane_jax.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_temporal_mask(ax: Axes, frame_valid: Bool[Array, "t n"]) -> None:
    """Draw which frames of each road user are attended to (light), oldest frame on the left."""
    _grid(ax, np.asarray(frame_valid), "temporal mask")
    ax.set_xlabel("frame, oldest first", fontsize=8)
    ax.set_ylabel("road user", fontsize=8)


def draw_spatial_mask(ax: Axes, mask: Bool[Array, "s s"], lanes: int, *, title: str = "spatial mask M_s") -> None:
    """Draw M_s, (L+T, L+T), as the four quadrants L->L, L->T, T->L, T->T. Light: row attends to column.

    To leave padding out, give rows and columns of valid tokens alone.

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
    ax.set_xlabel("is attended to (key)", fontsize=8)
    ax.set_ylabel("attends (query)", fontsize=8)
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

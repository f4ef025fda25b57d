"""Lines, arrows and turned shapes on matplotlib axes, for all pictures from above."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from tflane_jax.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def turned(shapes: Float[np.ndarray, "#k n 2"], angle: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k n 2"]:
    """Return each shape turned about the origin by its angle, counter-clockwise."""
    along = np.stack([np.cos(angle), np.sin(angle)], -1)[:, None]
    across = np.stack([-np.sin(angle), np.cos(angle)], -1)[:, None]
    return shapes[..., :1] * along + shapes[..., 1:] * across


def box_corners(
    center: Float[np.ndarray, "k 2"], yaw: Float[np.ndarray, " k"], size: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k 4 2"]:
    """Return the corners of boxes of (length, width) turned by `yaw`, counter-clockwise from front left."""
    corners = np.asarray([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]) * size[:, None]
    return turned(corners, yaw) + center[:, None]


def valid_rows(valid: ArrayLike, *arrays: ArrayLike) -> list[np.ndarray]:
    """Return the valid rows of each array."""
    chosen = np.asarray(valid, bool)
    return [np.asarray(array)[chosen] for array in arrays]


def add_lines(
    ax: Axes,
    points: np.ndarray,
    colours,
    *,
    width: float,
    zorder: float,
    alpha: float = 1.0,
    dashes: str | tuple = "solid",
) -> None:
    """Draw lines (n, p, 2 or 3) in one colour or one of each; `alpha` multiplies their opacity."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array

    shown = to_rgba_array(colours)
    shown[:, 3] *= alpha
    caps = "round" if dashes == "solid" else "butt"
    ax.add_collection(
        LineCollection(
            list(points[..., :2]), colors=shown, linewidths=width, linestyles=dashes, capstyle=caps, zorder=zorder
        )
    )


def add_arrows(ax: Axes, points: np.ndarray, colours, *, zorder: float, alpha: float = 1.0) -> None:
    """Draw an arrow head in the middle of each line of at least two points."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba_array

    if len(points) == 0 or points.shape[1] < 2:
        return
    middle = points.shape[1] // 2
    tip, tail = points[:, middle, :2], points[:, middle - 1, :2]
    heading = np.arctan2(tip[:, 1] - tail[:, 1], tip[:, 0] - tail[:, 0])
    head = np.asarray([[[1.0, 0.0], [-0.9, 0.75], [-0.9, -0.75]]])
    shown = to_rgba_array(colours)
    shown[:, 3] *= alpha
    triangles = turned(head, heading) + tip[:, None]
    ax.add_collection(PolyCollection(list(triangles), facecolors=shown, linewidths=0, zorder=zorder))


def add_links(ax: Axes, points: Float[np.ndarray, "n p 3"], logits: Float[np.ndarray, "n n"]) -> None:
    """Draw a link from the end of a lane to the start of its successor where the edge's score is above 0.5."""
    from matplotlib.collections import LineCollection

    before, after = np.nonzero(logits > 0.0)  # a logit of 0 is a score of 0.5
    links = np.stack([points[before, -1, :2], points[after, 0, :2]], 1)
    ax.add_collection(LineCollection(list(links), colors=style.LINK, linewidths=1.1, zorder=3.7))
    joints = links.mean(1)
    ax.scatter(joints[:, 0], joints[:, 1], s=7, c=style.LINK, linewidths=0, zorder=3.8)


def add_crossings(
    ax: Axes, rings: Float[np.ndarray, "n p 3"], opacity: Float[np.ndarray, " n"] | None = None, *, zorder: float = 1.1
) -> None:
    """Draw shaded crossings with an outline; `opacity` 0 to 1, default 1."""
    from matplotlib.collections import PolyCollection

    outline = np.tile(faded(style.CROSSING, np.ones(1)), (len(rings), 1))
    outline[:, 3] = 0.8 if opacity is None else 0.8 * np.asarray(opacity)
    shade = outline * [1.0, 1.0, 1.0, 0.275]
    ax.add_collection(
        PolyCollection(list(rings[..., :2]), facecolors=shade, edgecolors=outline, linewidths=0.7, zorder=zorder)
    )


def faded(colour: str, scores: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4"]:
    """Return a colour with an opacity between 0.25 and 1 by score."""
    from matplotlib.colors import to_rgba

    colours = np.tile(to_rgba(colour), (len(scores), 1))
    colours[:, 3] = 0.25 + 0.75 * np.asarray(scores)
    return colours

"""Lane lines drawn over front-view images: truth and predictions on pages, and one picture for one photo."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.evaluation.lane_shapes import left_to_right
from tflane_jax.files.images import opencv
from tflane_jax.files.tusimple import ROWS, SIZE
from tflane_jax.geometry.lane_shapes import curve_columns
from tflane_jax.plots import style
from tflane_jax.plots.figure import hide_unused, new_figure, save_figure
from tflane_jax.scene import CurvePrediction, LaneLines, RoadImage, row_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

# Distinct colours for neighbouring lanes, all visible on asphalt; none is near the green of the truth.
LANE_COLOURS = ("#ff4d6d", "#ffd166", "#4dd2ff", "#c792ea", "#ff9d3c", "#f5f5f5")
TRUTH = "#8be28b"
# Images in a row of a sheet without predictions.
_COLUMNS = 4
_TALLEST = 19.2  # inches of the picture of one photo; portraits of a phone need 17


def save_road_images(
    path: Path,
    examples: RoadImage,
    predictions: Mapping[str, CurvePrediction] | None = None,
    *,
    titles: Sequence[str] = (),
    threshold: float | None = None,
) -> Path:
    """Write one row per image: truth, then one column per model with the truth as thin dashes; return the path.

    Without predictions, several images share a row.

    Args:
        path: .png, .pdf or .svg.
        examples: B of them, stacked along a leading axis.
        predictions: by the name of the model, stacked in the same way.
        titles: one per row; default their numbers.
        threshold: least score of a lane; None: where lane exceeds background.

    Raises:
        ValueError: the numbers of examples, predictions and titles differ.
    """
    predictions, count = predictions or {}, len(examples.image)
    titles = titles or [f"image {row}" for row in range(count)]
    sizes = {"titles": len(titles)} | {name: len(stacked.logits) for name, stacked in predictions.items()}
    if any(size != count for size in sizes.values()):
        raise ValueError(f"{count} images, but {sizes}")
    height, width = examples.image.shape[1:3]
    columns = 1 + len(predictions) if predictions else min(count, _COLUMNS)
    rows = count if predictions else -(-count // columns)
    figure, axes = new_figure(rows, columns, panel=(4.8, 4.8 * height / width + 0.25), footer=0.25 * bool(predictions))
    for row, (title, panels) in enumerate(zip(titles, axes.reshape(-1, 1 + len(predictions)), strict=False)):
        example, (truth, *others) = row_of(examples, row), panels
        draw_image(truth, example.image, f"{title}: truth")
        draw_lines(truth, example.lines, (height, width), width=1.6)
        for ax, (name, stacked) in zip(others, predictions.items(), strict=True):
            draw_image(ax, example.image, name)
            draw_lines(ax, example.lines, (height, width), width=0.9, style="--")
            draw_lanes(ax, predicted_lines(row_of(stacked, row), threshold) * [width, height])
    hide_unused(axes, count * (1 + len(predictions)))
    if predictions:
        figure.legend(handles=_entries(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return save_figure(figure, path)


def _entries() -> list[Line2D]:
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=TRUTH, lw=1.6, label="truth"),
        Line2D([], [], color=TRUTH, lw=0.9, ls="--", label="truth, in predictions"),
        Line2D([], [], color=LANE_COLOURS[0], lw=2.2, label="prediction: a colour for each lane, left to right"),
    ]


def save_photo(
    path: Path, photo: UInt8[np.ndarray, "h w 3"], lanes: Sequence[Float[np.ndarray, "p 2"]], title: str
) -> Path:
    """Write one photo with the lanes found in it, columns and rows in pixels, and return the path."""
    height, width = photo.shape[:2]
    # A strip one pixel wide would otherwise become a picture of gigabytes, higher than matplotlib can draw.
    tall = min(9.6 * height / width, _TALLEST)
    figure, axes = new_figure(1, 1, panel=(9.6, tall + 0.3))
    draw_image(axes[0, 0], photo, title)
    draw_lanes(axes[0, 0], lanes)
    return save_figure(figure, path)


def lanes_drawn(
    photo: UInt8[np.ndarray, "h w 3"], lanes: Iterable[Float[np.ndarray, "p 2"]]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a photo with lanes drawn by OpenCV: for videos, where matplotlib would be slow.

    A lane has gaps where points are NaN, as in the pictures of `draw_lanes`.
    """
    cv2, drawn = opencv(), np.ascontiguousarray(photo).copy()
    width = max(2, round(photo.shape[1] / 300))
    for lane, colour in zip(lanes, itertools.cycle(LANE_COLOURS), strict=False):
        parts = [np.round(part).astype(np.int32) for part in _finite_parts(lane)]
        cv2.polylines(drawn, parts, False, style.rgb(colour), width, cv2.LINE_AA)
    return drawn


def _finite_parts(lane: Float[np.ndarray, "p 2"]) -> list[np.ndarray]:
    """Return the pieces of a line between points that are not finite."""
    known = np.flatnonzero(np.isfinite(lane).all(-1))
    pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [lane[piece] for piece in pieces if len(piece)]


def predicted_lines(prediction: CurvePrediction, threshold: float | None = None) -> Float[np.ndarray, "l p 2"]:
    """Return (u, v) of the detected lanes, left to right, as fractions of the image.

    The points are those that TuSimple's metric reads, on its rows, between the ends of a lane; NaN elsewhere and
    outside the image. Between two rows a curve that ends above its own horizon f'' leaves the image and comes back from
    the other side: nobody scores that.

    Args:
        prediction: one example, one layer.
        threshold: see `lane_shapes.detected`.
    """
    curves = np.asarray(prediction.curves, np.float64)[left_to_right(prediction, threshold)]
    rows = np.broadcast_to(ROWS / SIZE[0], (len(curves), len(ROWS)))
    columns = curve_columns(curves[:, 2:], rows)
    read = (rows >= curves[:, :1]) & (rows <= curves[:, 1:2]) & (columns >= 0.0) & (columns <= 1.0)
    return np.where(read[..., None], np.stack([columns, rows], -1), np.nan)


def draw_image(ax: Axes, image: UInt8[np.ndarray, "h w 3"], title: str = "") -> None:
    """Show an image without axes; pixel coordinates run from 0 to width and height."""
    height, width = image.shape[:2]
    ax.imshow(image, extent=(0, width, height, 0))
    ax.set(xlim=(0, width), ylim=(height, 0))
    ax.set_axis_off()
    ax.set_title(title, fontsize=8, loc="left")


def draw_lines(ax: Axes, lines: LaneLines, size: tuple[int, int], *, width: float, style: str = "-") -> None:
    """Draw true lane lines; `size` is the image's height and width."""
    scale = np.array([size[1], size[0]])
    for points, point_valid, valid in zip(lines.points, lines.point_valid, lines.valid, strict=True):
        if valid:
            u, v = (np.asarray(points)[np.asarray(point_valid)] * scale).T
            ax.plot(u, v, style, color=TRUTH, linewidth=width)


def draw_lanes(ax: Axes, lanes: Iterable[Float[np.ndarray, "p 2"]]) -> None:
    """Draw lanes, pixels, each in a colour of its own."""
    for lane, colour in zip(lanes, itertools.cycle(LANE_COLOURS), strict=False):
        ax.plot(lane[:, 0], lane[:, 1], color=colour, linewidth=2.2, solid_capstyle="round")

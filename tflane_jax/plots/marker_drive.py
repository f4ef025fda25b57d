"""A frame of a drive with markers: boards and lanes in the cameras that see them, and from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.cameras import project
from tflane_jax.markers.detection import DetectedMarkers
from tflane_jax.markers.observe import Outcome
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.plots import style
from tflane_jax.plots.bev import draw_ego, draw_prediction, prepare
from tflane_jax.plots.figure import new_figure, save_figure
from tflane_jax.plots.images import draw_image
from tflane_jax.plots.lines import add_arrows, add_lines
from tflane_jax.plots.map_lines import chosen_lines, class_entries
from tflane_jax.plots.projection import draw_projected, draw_projected_by_class
from tflane_jax.plots.segments import chosen_segments
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.scene import CameraViews, LanePrediction, LinePrediction, SegmentPrediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Most cameras in a picture, and most pixels along the longer side of one.
_CAMERAS, _PIXELS = 3, 900
# A board narrower than this fraction of the image is magnified.
_SMALL = 0.1
# Size of labels, points; half the length and height of one, as a fraction of the panel's width.
_FONT, _LABEL = 6, np.array([0.06, 0.016])
# Height of a label in an image, as a fraction of the image's.
_LINE = 0.06
# Boards by what became of them; lanes of a marker from no to full confidence.
OUTCOMES: dict[Outcome, str] = {
    "used": style.BOARD,
    "unknown": "#ffcc00",
    "stale": "#ff9d3c",
    "contradictory": "#ff3b30",
    "dropped": "#c8ccd4",
    "no lanes": "#5ac8fa",
}
_DOUBTED, _TRUSTED = np.array([0.45, 0.30, 0.36]), np.array(style.BOARD_LANE)


def save_drive_frame(
    path: Path,
    views: CameraViews,
    detected: DetectedMarkers,
    outcomes: Mapping[int, Outcome],
    confidence: Mapping[int, float],
    guidance: MarkerGuidance,
    prediction: LanePrediction | None = None,
    *,
    view: PerceptionRange,
    names: Sequence[str] = (),
    title: str = "",
    threshold: float = 0.3,
) -> Path:
    """Write one frame and return the path.

    A board's colour is its outcome (green used, yellow unknown, orange out of date, red read at two places, grey one
    too many, light blue without lanes in the store), its label id, outcome and confidence. Lanes of markers are yellow,
    the darker the less they are trusted; predicted lanes are blue.

    Args:
        path: .png, .pdf or .svg.
        views: native images.
        detected: all markers.
        outcomes, confidence: by id, see `markers.observe` and Eq. (2); ids without confidence give no prior.
        guidance: lanes after gate and memory.
        prediction: lanes of a model.
        view: range that is shown from above.
        names: of the cameras.
        title: above the view from above.
        threshold: lowest score of predicted lanes.
    """
    shown = _cameras(views, detected)
    found, category = (None, None) if prediction is None else _found(prediction, threshold)
    figure, axes = new_figure(1, len(shown) + 1, panel=(4.4, 3.6), footer=0.3)
    for number, ax in zip(shown, axes[0], strict=False):
        name = names[number] if names else f"camera {number}"
        draw_boards(ax, views, number, detected, outcomes, confidence, guidance, title=name)
        if found is not None:
            small = _at_scale(views, _factor(views, number))
            if category is not None:
                draw_projected_by_class(ax, small, number, found, category)
            else:
                draw_projected(ax, small, number, found, colour=style.PREDICTION, width=0.9)
    above: Any = axes[0, -1]
    prepare(above, view, title)
    above.set_xlabel("x, forward [m]", fontsize=8)
    above.set_ylabel("y, left [m]", fontsize=8)
    draw_guidance(above, guidance)
    if prediction is not None:
        draw_prediction(above, prediction, threshold=threshold)
    drawn = [np.zeros((1, 2)), *(line[:, :2] for line in _lanes(guidance)[0])]  # the ego vehicle, and lanes
    if found is not None:
        drawn += [line[:, :2] for line in found]
    for k in np.flatnonzero(detected.valid).tolist():
        number = int(detected.marker_id[k])
        x, y = detected.pose[k, :2, 3].tolist()
        above.plot([x], [y], "s", color=OUTCOMES[outcomes[number]], markersize=6, zorder=6.0)
        if view.contains(np.array([x, y])):
            side, up = _free_side(np.array([x, y]), drawn, view)
            above.annotate(
                _label(number, outcomes, confidence),
                (x, y),
                xytext=(5 * side, 5 * up),
                textcoords="offset points",
                ha="left" if side > 0 else "right",
                va="bottom" if up > 0 else "top",
                color=OUTCOMES[outcomes[number]],
                fontsize=_FONT,
                path_effects=_outlined(),
                zorder=6.3,  # above the ego vehicle
            )
    draw_ego(above)
    figure.legend(handles=_entries(prediction), loc="outside lower center", ncols=5, fontsize=7, frameon=False)
    return save_figure(figure, path)


def frame_title(number: int, guidance: MarkerGuidance, *, remembered: bool) -> str:
    """Return what lanes of boards a frame has, and how far they are trusted, as title of its view from above."""
    if not np.asarray(guidance.valid).any():
        return f"frame {number}: no lanes of a board"
    where = "from memory" if remembered else "of a board in sight"
    return f"frame {number}: lanes {where}, c = {float(guidance.gate):.2f}"


def _found(
    prediction: LanePrediction, threshold: float
) -> tuple[Float[np.ndarray, "n p 3"], Int[np.ndarray, " n"] | None]:
    """Return the lanes that cameras show: centerlines, those of segments that are lanes, or map lines and classes."""
    if isinstance(prediction, LinePrediction):
        points, category, _ = chosen_lines(prediction, threshold)
        return points, category
    shown = np.asarray(prediction.scores) >= threshold
    if isinstance(prediction, SegmentPrediction):
        shown, _ = chosen_segments(prediction, threshold)
    return np.asarray(prediction.points)[shown], None


def _entries(prediction: LanePrediction | None) -> list[Any]:
    from matplotlib.lines import Line2D

    doubted, trusted = lane_colours(np.array([0.0, 1.0]))
    lanes = {"lane of a board, c = 1": trusted, "c = 0": doubted}
    if prediction is not None and not isinstance(prediction, LinePrediction):
        lanes["predicted lane"] = style.PREDICTION
    return [
        Line2D([], [], color=OUTCOMES["used"], lw=0, marker="s", ms=5, label="board, its id and c"),
        *(Line2D([], [], color=colour, lw=2, label=label) for label, colour in lanes.items()),
        *(class_entries() if isinstance(prediction, LinePrediction) else ()),
    ]


def draw_boards(
    ax: Axes,
    views: CameraViews,
    number: int,
    detected: DetectedMarkers,
    outcomes: Mapping[int, Outcome],
    confidence: Mapping[int, float],
    guidance: MarkerGuidance,
    *,
    title: str = "",
) -> None:
    """Draw a camera's image, reduced, with the lanes of markers and the boards it sees; see `save_drive_frame`.

    A small nearest board is shown magnified in an upper corner.
    """
    factor = _factor(views, number)
    width, height = np.asarray(views.size)[number].tolist()
    draw_image(ax, np.asarray(views.image)[number, :height, :width][::factor, ::factor], title)
    scaled = _at_scale(views, factor)
    for line, colour in zip(*_lanes(guidance), strict=True):
        draw_projected(ax, scaled, number, line[None], colour=colour, width=1.0)
    seen = np.flatnonzero(detected.valid & (detected.camera == number)).tolist()
    for k in seen:
        _draw_board(ax, scaled, number, detected, k, outcomes, confidence)
    if seen:
        _magnify(ax, views, number, detected, min(seen, key=lambda k: float(np.hypot(*detected.pose[k, :2, 3]))))


def draw_guidance(ax: Axes, guidance: MarkerGuidance) -> None:
    """Draw the lanes of markers from above, the darker the less they are trusted."""
    lanes, colours = _lanes(guidance)
    if len(lanes):
        add_lines(ax, lanes, colours, width=1.5, zorder=3.0)
        add_arrows(ax, lanes, colours, zorder=3.1)


def lane_colours(factor: float | Float[np.ndarray, " n"]) -> list[str]:
    """Return the colours of lanes by their factor in Eq. (3), c times weight, 0 to 1."""
    from matplotlib.colors import to_hex

    fraction = np.clip(np.atleast_1d(factor), 0.0, 1.0)[:, None]
    return [to_hex(colour) for colour in _DOUBTED + fraction * (_TRUSTED - _DOUBTED)]


def _lanes(guidance: MarkerGuidance) -> tuple[Float[np.ndarray, "n k 3"], list[str]]:
    """Return the lanes of markers on the ground, with their colours; trusted ones last, so that they lie on top."""
    factor = np.asarray(guidance.weight) * float(guidance.gate)
    chosen = np.flatnonzero(guidance.valid)
    chosen = chosen[np.argsort(factor[chosen], kind="stable")]
    return np.pad(np.asarray(guidance.points)[chosen], ((0, 0), (0, 0), (0, 1))), lane_colours(factor[chosen])


def _cameras(views: CameraViews, detected: DetectedMarkers) -> list[int]:
    """Return the cameras that see boards, most boards first; the first camera if none does."""
    seen = np.bincount(detected.camera[detected.valid], minlength=len(views.valid))
    order = [number for number in np.argsort(-seen, kind="stable").tolist() if seen[number]]
    valid = np.flatnonzero(views.valid).tolist()
    return order[:_CAMERAS] or valid[:1]


def _factor(views: CameraViews, number: int) -> int:
    """Return by how much an image is reduced."""
    return max(1, -(-int(np.max(np.asarray(views.size)[number])) // _PIXELS))


def _at_scale(views: CameraViews, factor: int) -> CameraViews:
    """Return the calibration of images reduced by a factor."""
    small: Float[np.ndarray, "3 3"] = np.diag([1.0 / factor, 1.0 / factor, 1.0])
    return CameraViews(
        image=views.image,
        size=np.asarray(views.size) // factor,
        intrinsics=small @ np.asarray(views.intrinsics, np.float64),
        camera_from_ego=views.camera_from_ego,
        valid=views.valid,
    )


def _magnify(ax: Axes, views: CameraViews, number: int, detected: DetectedMarkers, k: int) -> None:
    """Show a board that is too small to be recognised in the picture, in the corner on the other side of it."""
    width, height = np.asarray(views.size)[number].tolist()
    outline = board_outline(views, detected, k)
    side, (x, y) = float((outline.max(0) - outline.min(0)).max()), outline.mean(0).tolist()
    if side > _SMALL * width:
        return
    left, right, low, high = (round(v) for v in (x - side, x + side, y - side, y + side))
    left, low = max(left, 0), max(low, 0)
    part = np.asarray(views.image)[number, low : min(high, height), left : min(right, width)]
    if not part.size:
        return
    corner = "NE" if x < 0.5 * width else "NW"
    inset = ax.inset_axes((0.66 if corner == "NE" else 0.01, 0.66, 0.33, 0.33))
    inset.imshow(part)
    inset.set(xticks=[], yticks=[], anchor=corner)
    inset.spines[:].set_color("white")


def board_outline(views: CameraViews, detected: DetectedMarkers, k: int) -> Float[np.ndarray, "4 2"]:
    """Return the pixels of a detected board's corners in its camera."""
    number = int(detected.camera[k])
    intrinsics = np.asarray(views.intrinsics, np.float64)[number]
    camera_from_ego = np.asarray(views.camera_from_ego, np.float64)[number]
    return marker_outline(
        np.asarray(detected.pose[k], np.float64), float(detected.size[k]), intrinsics, camera_from_ego
    )


def _draw_board(
    ax: Axes,
    views: CameraViews,
    number: int,
    detected: DetectedMarkers,
    k: int,
    outcomes: Mapping[int, Outcome],
    confidence: Mapping[int, float],
) -> None:
    intrinsics = np.asarray(views.intrinsics, np.float64)[number]
    camera_from_ego = np.asarray(views.camera_from_ego, np.float64)[number]
    pose, marker = np.asarray(detected.pose[k], np.float64), int(detected.marker_id[k])
    outline = board_outline(views, detected, k)
    colour = OUTCOMES[outcomes[marker]]
    ax.plot(*np.concatenate([outline, outline[:1]]).T, color=colour, linewidth=1.2, zorder=4.0)
    foot = project(pose[None, :3, 3] - [0.0, 0.0, float(detected.size[k])], intrinsics, camera_from_ego)[0][0]
    place, ha, va = _in_picture(foot, outline, np.asarray(views.size)[number])
    ax.annotate(
        _label(marker, outcomes, confidence),
        place,
        color=colour,
        fontsize=_FONT,
        ha=ha,
        va=va,
        path_effects=_outlined(),
        zorder=4.1,
        clip_on=True,
    )


def _in_picture(
    foot: Float[np.ndarray, "2"], outline: Float[np.ndarray, "4 2"], size: Int[np.ndarray, "2"]
) -> tuple[tuple[float, float], Literal["left", "center", "right"], Literal["bottom", "top"]]:
    """Return place and alignment of a board's label: below it, above it where there is no room, in the picture."""
    (x, y), (width, height) = foot.tolist(), size.tolist()
    ha = "left" if x < width / 3 else "right" if x > 2 * width / 3 else "center"
    x, room, top = float(np.clip(x, 0.0, width)), _LINE * height, float(outline[:, 1].min())
    if y <= height - room:
        return (x, max(y, 0.0)), ha, "top"
    return (x, top if room <= top <= height else height), ha, "bottom"


def _outlined() -> list[Any]:
    """Return the dark outline with which a label can be read on lanes, paint and vehicles."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=1.6, foreground=style.ROAD)]


def _free_side(
    place: Float[np.ndarray, " 2"], drawn: Sequence[Float[np.ndarray, "n 2"]], view: PerceptionRange
) -> tuple[int, int]:
    """Return on which sides of a board, -1 or 1 along x and y, its label is farthest from lines and in the panel."""
    low, high = np.array([view.x, view.y]).T
    half = _LABEL * (high[0] - low[0])
    points = np.concatenate(drawn)
    inwards = np.where(place > 0.5 * (low + high), -1, 1)  # first, so that it is taken where all are as free
    best, most = (int(inwards[0]), int(inwards[1])), -1.0
    for turn in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        side = inwards * turn
        middle = place + side * (half + 0.5 * half[1])
        free = float(np.linalg.norm((points - middle) / half, axis=1).min())
        if (middle - half >= low).all() and (middle + half <= high).all() and free > most:
            best, most = (int(side[0]), int(side[1])), free
    return best


def _label(marker: int, outcomes: Mapping[int, Outcome], confidence: Mapping[int, float]) -> str:
    outcome = outcomes[marker]
    return f"{marker}: {confidence[marker]:.2f}" if marker in confidence else f"{marker}: {outcome}"

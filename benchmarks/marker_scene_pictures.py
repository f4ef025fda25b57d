"""Pictures of `marker_scenes`: gaps in which lanes come from memory, and the confidence of every frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.geometry import relative_pose
from tflane_jax.plots import new_figure, save_figure
from tflane_jax.plots.bev import draw_ego, draw_found, draw_lanes, draw_scene, prepare
from tflane_jax.plots.gallery import label_edges, panel_size
from tflane_jax.plots.legends import hidden_entries, prediction_entries, truth_entry, visibility_entries
from tflane_jax.plots.marker_drive import OUTCOMES, draw_boards, draw_guidance, lane_colours
from tflane_jax.plots.style import ROAD
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.scene import CameraViews, Example, Prediction
from tflane_jax.scene.logs import KeyFrame
from tflane_jax.tasks.marker_drive import DriveStep

# Gaps in the picture, each of a scene of its own.
_SHOWN = 4


class Sighting(NamedTuple):
    """The latest frame of a scene in which a board gave lanes.

    Attributes:
        moment: time and pose.
        step: of the drive.
        views: the image of the camera that reads the nearest such board, alone.
        camera: its number in the ring.
        board: row of that board in the detections.
    """

    moment: KeyFrame
    step: DriveStep
    views: CameraViews
    camera: int
    board: int


@dataclass(frozen=True)
class Gap:
    """A frame without a board in sight whose lanes come from memory.

    Attributes:
        scene: number of the scene.
        moment: time and pose.
        sighting: the latest frame before it with a board.
        truth, guidance: of this frame.
        found: by the name of the row.
    """

    scene: int
    moment: KeyFrame
    sighting: Sighting
    truth: Example
    guidance: MarkerGuidance
    found: Mapping[str, Prediction]


class Cell(NamedTuple):
    """A frame in the table of confidences: its scene, group, and the confidence c of Eq. (3)."""

    scene: int
    group: str
    gate: float


def sighting(views: CameraViews, moment: KeyFrame, step: DriveStep) -> Sighting | None:
    """Return the frame as a sighting; None where no board gives lanes."""
    detected, used = step.reading.detected, step.reading.observed.outcomes
    rows = [k for k in np.flatnonzero(detected.valid).tolist() if used[int(detected.marker_id[k])] == "used"]
    if not rows:
        return None
    board = min(rows, key=lambda k: float(np.hypot(*detected.pose[k, :2, 3])))
    camera = int(detected.camera[board])
    names = ("image", "size", "intrinsics", "camera_from_ego", "valid")
    # Copies: the other images are not kept.
    image, size, intrinsics, extrinsics, valid = (np.array(getattr(views, name)[camera : camera + 1]) for name in names)
    alone = CameraViews(image, size, intrinsics, extrinsics, valid)
    return Sighting(moment, step, alone, camera, board)


def save_gaps(path: Path, gaps: Sequence[Gap], source: ProceduralConfig) -> Path | None:
    """Draw the gap of each scene in which memory is trusted most, whichever model is better there; None without any.

    A row is a gap: the last image that shows the board, the truth, what memory holds, and the lanes of each model.
    """
    best = {each.scene: each for each in sorted(gaps, key=lambda each: float(each.guidance.gate))}
    chosen = sorted(best.values(), key=lambda each: -float(each.guidance.gate))[:_SHOWN]
    if not chosen:
        return None
    example, rows = source.example, list(chosen[0].found)
    view, ground = example.range, example.ground
    width, height = panel_size(view, 4.2)
    # An image is taller than the ground beside it.
    figure, axes = new_figure(len(chosen), 3 + len(rows), panel=(width, max(height, 2.9)), footer=0.4)
    for gap, (image, truth, memory, *models) in zip(chosen, axes, strict=True):
        later = 1e-9 * (gap.moment.timestamp_ns - gap.sighting.moment.timestamp_ns)
        _draw_sighting(image, gap.sighting, f"scene {gap.scene}, {later:.1f} s before the gap")
        shown = ("hidden", "lanes")
        draw_scene(truth, gap.truth, layers=shown, ground=ground, view=view, title=f"gap, {later:.1f} s later: truth")
        prepare(memory, view, f"lanes in memory, c = {float(gap.guidance.gate):.2f}")
        draw_lanes(memory, gap.truth.lanes, colour="white", width=0.8, alpha=0.45)
        draw_guidance(memory, gap.guidance)
        _draw_place(memory, gap)
        draw_ego(memory)
        for ax, name in zip(models, rows, strict=True):
            draw_found(ax, gap.truth, gap.found[name].lanes, ground=ground, view=view, title=name)
    label_edges(axes[:, 1:])
    figure.legend(handles=_entries(), loc="outside lower center", ncols=10, fontsize=8, frameon=False)
    return save_figure(figure, path)


def _draw_sighting(ax: Any, seen: Sighting, title: str) -> None:
    step, only = seen.step, np.zeros(len(seen.step.reading.detected.valid), bool)
    only[seen.board] = True
    detected = step.reading.detected._replace(valid=only, camera=np.zeros(len(only), int))
    marker, markers = int(detected.marker_id[seen.board]), step.reading.observed.markers
    trust = {int(each): float(c) for each, c in zip(markers.marker_id, step.confidence, strict=True)}
    distance = float(np.hypot(*detected.pose[seen.board, :2, 3]))
    title = f"{title}: board {marker} at {distance:.0f} m, c = {trust[marker]:.2f}"
    draw_boards(ax, seen.views, 0, detected, {marker: "used"}, trust, step.guidance, title=title)


def _draw_place(ax: Any, gap: Gap) -> None:
    """Mark where the board was read, in the frame of the gap."""
    seen = gap.sighting
    now_from_then = relative_pose(gap.moment.global_from_ego, seen.moment.global_from_ego)
    x, y = (now_from_then @ seen.step.reading.detected.pose[seen.board])[:2, 3].tolist()
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    if left <= x <= right and low <= y <= high:
        ax.plot([x], [y], "s", color=OUTCOMES["used"], markersize=6, zorder=6.0)
    else:
        ax.text(0.01, 0.02, f"board {np.hypot(x, y):.0f} m away, outside", transform=ax.transAxes, **_small("used"))


def _small(outcome: Any) -> dict[str, Any]:
    return {"fontsize": 7, "color": OUTCOMES[outcome], "zorder": 6.0}


def _entries() -> list[Any]:
    from matplotlib.lines import Line2D

    doubted, half, trusted = lane_colours(np.array([0.0, 0.5, 1.0]))
    return [
        Line2D([], [], color=OUTCOMES["used"], lw=0, marker="s", ms=5, label="board (read before)"),
        *(
            Line2D([], [], color=colour, lw=2, label=f"lane of a board, c = {c}")
            for colour, c in ((trusted, 1), (half, 0.5), (doubted, 0))
        ),
        *visibility_entries(),
        *hidden_entries(),
        truth_entry(),
        *prediction_entries(),
    ]


def save_confidence(path: Path, cells: Sequence[Cell], interval: float) -> Path:
    """Draw a table of scenes by frames: c of Eq. (3), in a colour for each group, the darker the more trusted.

    Args:
        path: of the picture.
        cells: frames of each scene in order.
        interval: between frames, seconds.
    """
    scenes = sorted({each.scene for each in cells})
    frames = max(sum(each.scene == scene for each in cells) for scene in scenes)
    figure, axes = new_figure(panel=(0.62 * frames + 1.6, 0.3 * len(scenes) + 0.8), footer=0.3)
    ax = axes[0, 0]
    for row, scene in enumerate(scenes):
        for column, each in enumerate(cell for cell in cells if cell.scene == scene):
            _draw_cell(ax, column, row, each)
    ax.set(xlim=(-0.5, frames - 0.5), ylim=(len(scenes) - 0.5, -0.5))
    ax.set_xticks(range(frames), [f"{interval * frame:g}" for frame in range(frames)])
    ax.set_yticks(range(len(scenes)), list(map(str, scenes)))
    ax.tick_params(length=0, labelsize=7)
    ax.set_xlabel("time in the scene, s", fontsize=8)
    ax.set_ylabel("scene", fontsize=8)
    ax.set_title("confidence c of the lanes that enter the model, Eq. (3)", fontsize=8, loc="left")
    from matplotlib.patches import Patch

    names = {"seen": "a board is read", "gap": "gap: from memory", "before": "no board so far"}
    entries = [Patch(facecolor=_shade(Cell(0, group, 0.8)), label=name) for group, name in names.items()]
    figure.legend(handles=entries, loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    return save_figure(figure, path)


def _draw_cell(ax: Any, column: int, row: int, cell: Cell) -> None:
    from matplotlib.patches import Rectangle

    shade = _shade(cell)
    ax.add_patch(Rectangle((column - 0.48, row - 0.46), 0.96, 0.92, facecolor=shade, lw=0))
    if cell.group != "before":
        dark = float(np.mean(shade)) < 0.5
        ax.text(column, row, f"{cell.gate:.2f}", ha="center", va="center", fontsize=7, color="white" if dark else ROAD)


def _shade(cell: Cell) -> tuple[float, float, float]:
    """Return white for no board so far; green for boards in sight, orange for gaps, the darker the more trusted."""
    if cell.group == "before":
        return 0.86, 0.86, 0.86
    full = np.array([0.10, 0.55, 0.24]) if cell.group == "seen" else np.array([0.85, 0.45, 0.05])
    light = np.array([0.97, 0.97, 0.97])
    red, green, blue = (light + min(max(cell.gate, 0.0), 1.0) * (full - light)).tolist()
    return red, green, blue

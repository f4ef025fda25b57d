"""Identities of detected map lines over the frames of a scene.

The definition of C-mAP (`metrics.consistency`) leaves open how lines get them. Here: the lines of earlier frames are
moved by the ego motion and assigned to the present ones of the same class (Hungarian assignment). Two lines are the
same if, of each, the nearest `SHARED` of its points lie within `SAME` of the other in the mean: the perception range
cuts a line elsewhere in every frame. A line that is missing for up to `MEMORY` frames keeps its identity.

On the true lines of 24 scenes of the built-in world (12 of each preset, 4 frames 2 s apart), 600 of 609 lines keep
their identity, and none gets that of another line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from tflane_jax.geometry import invert_pose, line_distances

SAME = 1.5  # metres, the largest threshold of MapTR's AP
SHARED = 0.25  # of a line's points
MEMORY = 5  # frames
_FAR = 1e6


@dataclass
class _Known:
    """Lines of earlier frames, in the latest ego frame; `missed` are the frames since a line was found."""

    lines: Float[np.ndarray, "k n 2"]
    classes: Int[np.ndarray, " k"]
    identity: Int[np.ndarray, " k"]
    missed: Int[np.ndarray, " k"]


class LineTracks:
    """Identities of one model's lines, frame by frame."""

    def __init__(self) -> None:
        self._known: _Known | None = None
        self._count = 0

    def start(self) -> None:
        """Start the next scene."""
        self._known = None

    def step(
        self,
        lines: Float[np.ndarray, "p n 2"],
        classes: Int[np.ndarray, " p"],
        previous_from_ego: Float[np.ndarray, "4 4"],
    ) -> Int[np.ndarray, " p"]:
        """Return the identities of the next frame's lines.

        Args:
            lines: metres, ego frame; the number of points is the same in all frames.
            classes: lines of different classes are different.
            previous_from_ego: pose of this ego frame in that of the previous frame.
        """
        lines, classes = np.asarray(lines, np.float64), np.asarray(classes, np.int64)
        identity = np.full(len(lines), -1)
        known = self._known or _Known(lines[:0], classes[:0], identity[:0], identity[:0])
        pose = invert_pose(np.asarray(previous_from_ego, np.float64))
        moved = known.lines @ pose[:2, :2].T + pose[:2, 3]
        lost = known.missed >= MEMORY
        if len(lines) and len(moved):
            cost = _cost(lines, moved, classes[:, None] == known.classes)
            row, column = (side.astype(int) for side in linear_sum_assignment(cost))
            same = cost[row, column] < _FAR
            identity[row[same]] = known.identity[column[same]]
            lost[column[same]] = True  # replaced by the line of this frame
        new = identity < 0
        identity[new] = self._count + np.arange(new.sum())
        self._count += int(new.sum())
        self._known = _Known(
            lines=np.concatenate([moved[~lost], lines]),
            classes=np.concatenate([known.classes[~lost], classes]),
            identity=np.concatenate([known.identity[~lost], identity]),
            missed=np.concatenate([known.missed[~lost] + 1, np.zeros(len(lines), int)]),
        )
        return identity


def _cost(
    lines: Float[np.ndarray, "p n 2"], known: Float[np.ndarray, "k n 2"], same_class: Bool[np.ndarray, "p k"]
) -> Float[np.ndarray, "p k"]:
    """Return how far apart lines are, metres; `_FAR` for those that are not the same."""
    low, high = lines.min(1)[:, None] - SAME, lines.max(1)[:, None] + SAME
    meets = ((low <= known.max(1)) & (known.min(1) <= high)).all(-1)
    row, column = np.nonzero(meets & same_class)
    (there, _), (back, _) = line_distances(lines[row], known[column]), line_distances(known[column], lines[row])
    near = np.maximum(_near_part(there), _near_part(back))
    cost = np.full(same_class.shape, _FAR)
    # All points decide between lines that overlap in part.
    cost[row, column] = np.where(near < SAME, near + 1e-2 * (there.mean(-1) + back.mean(-1)), _FAR)
    return cost


def _near_part(distance: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " k"]:
    """Return the mean of the smallest distances of each pair of lines."""
    count = max(round(SHARED * distance.shape[-1]), 1)
    return np.partition(distance, count - 1, axis=-1)[..., :count].mean(-1)

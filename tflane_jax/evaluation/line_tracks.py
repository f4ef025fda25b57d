"""Identities of detected map lines over the frames of a scene.

The definition of C-mAP (`metrics.consistency`) leaves open how lines get them. Here: the lines of earlier frames are
moved by the ego motion and assigned to the present ones of the same class (Hungarian assignment). Two lines are the
same if the nearest `SHARED` of the points of either lie within `SAME` of the other in the mean: the perception range
cuts a line elsewhere in every frame. A line that is missing for up to `MEMORY` frames keeps its identity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from tflane_jax.datasets.identities import line_distances
from tflane_jax.geometry import invert_pose

SAME = 1.5  # metres, the largest threshold of MapTR's AP
SHARED = 0.4  # of a line's points
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
            there, back = line_distances(lines, moved)[0], line_distances(moved, lines)[0].swapaxes(0, 1)
            # All points decide between lines that overlap in part.
            cost = np.minimum(_near_part(there), _near_part(back)) + 1e-3 * (there.mean(-1) + back.mean(-1))
            cost = np.where((cost < SAME) & (classes[:, None] == known.classes), cost, _FAR)
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


def _near_part(distance: Float[np.ndarray, "p k n"]) -> Float[np.ndarray, "p k"]:
    """Return the mean of the smallest distances of each pair of lines."""
    count = max(round(SHARED * distance.shape[-1]), 1)
    return np.partition(distance, count - 1, axis=-1)[..., :count].mean(-1)

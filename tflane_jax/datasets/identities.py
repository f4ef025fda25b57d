"""Names for lanes, areas and traffic elements that stay the same from frame to frame.

Examples have no ids. What stands in one frame where something stood in the frame before, moved by the ego motion, is
the same thing, as long as it is the only one so near; a lane that the border of the perception range cuts elsewhere
still lies on itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from tflane_jax.geometry import invert_pose, transform_points
from tflane_jax.scene import Example

# Farther apart than this (metres), two things are not the same. Resampled chords of one curve differ by less.
_SAME = 0.75
_FAR = 1e6


def line_distances(
    lines: Float[np.ndarray, "n p 3"], others: Float[np.ndarray, "m q 3"]
) -> tuple[Float[np.ndarray, "n m p"], Float[np.ndarray, "n m p"]]:
    """Return the ground-plane distance from every vertex to every other line, metres, and the place on that line
    nearest to it (0 at its first vertex, q - 1 at its last); q >= 2."""
    points, start, step = lines[:, None, :, None, :2], others[:, :-1, :2], np.diff(others[..., :2], axis=1)
    square = (step**2).sum(-1)
    start, step = start[None, :, None], step[None, :, None]
    share = ((points - start) * step).sum(-1) / np.where(square > 0.0, square, 1.0)[None, :, None]
    share = np.clip(share, 0.0, 1.0)
    distance = np.linalg.norm(start + share[..., None] * step - points, axis=-1)
    nearest = distance.argmin(-1)[..., None]
    place = nearest + np.take_along_axis(share, nearest, -1)
    return np.take_along_axis(distance, nearest, -1)[..., 0], place[..., 0]


@dataclass
class _Kind:
    """Things of one kind in the latest frame: their shapes and labels, and the ids of valid rows."""

    lines: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    names: list[str] = field(default_factory=list)


class Identities:
    """Ids of one scene's things, frame after frame.

    Attributes:
        lanes, segments, areas, elements: id by row of the latest example, for valid rows.
    """

    def __init__(self) -> None:
        self.lanes: dict[int, str] = {}
        self.segments: dict[int, str] = {}
        self.areas: dict[int, str] = {}
        self.elements: dict[int, str] = {}
        self._before: dict[str, _Kind] = {}
        self._count = 0

    def step(self, example: Example) -> None:
        """Take the next frame of the scene; one whose `has_previous` is false starts afresh."""
        if not example.has_previous:
            self._before = {}
        ego_from_previous = invert_pose(np.asarray(example.previous_from_ego, np.float64))
        self.lanes = self._next("lane", example.lanes.points, None, example.lanes.valid, ego_from_previous)
        segments, areas, elements = example.segments, example.areas, example.traffic_elements
        self.segments = self._next("segment", segments.points, None, segments.valid, ego_from_previous)
        self.areas = self._next("area", areas.points, areas.category, areas.valid, ego_from_previous)
        self.elements = {}
        if elements is not None:
            # An element is a point; where positions are not known, all are at the origin and nothing is recognised.
            place = np.repeat(np.asarray(elements.position)[:, None], 2, 1)
            self.elements = self._next("element", place, elements.category, elements.valid, ego_from_previous)

    def _next(
        self, kind: str, lines: np.ndarray, label: np.ndarray | None, valid: Bool[np.ndarray, " n"], moved: np.ndarray
    ) -> dict[int, str]:
        rows = np.flatnonzero(valid)
        now = _Kind(
            np.asarray(lines, np.float64)[rows], np.zeros(len(rows), int) if label is None else np.asarray(label)[rows]
        )
        before, names = self._before.get(kind, _Kind()), {}
        if len(rows) and len(before.names):
            cost = _separation(now, _Kind(transform_points(moved, before.lines), before.label))
            for row, column in zip(*linear_sum_assignment(cost), strict=True):
                if cost[row, column] < _SAME:
                    names[row] = before.names[column]
        for row in range(len(rows)):
            if row not in names:
                names[row] = str(self._count)
                self._count += 1
        now.names = [names[row] for row in range(len(rows))]
        self._before[kind] = now
        return {int(place): now.names[row] for row, place in enumerate(rows)}


def _separation(now: _Kind, before: _Kind) -> Float[np.ndarray, "n m"]:
    """Return how far two things are apart: the mean distance of the one that lies more on the other (a line may be cut
    shorter), plus a little of the other direction to choose among lines that share a stretch."""
    there = line_distances(now.lines, before.lines)[0].mean(-1)
    back = line_distances(before.lines, now.lines)[0].mean(-1).T
    known = np.abs(now.lines).max((1, 2)) > 0.0  # not an element whose position is not known
    apart = np.minimum(there, back) + 1e-3 * np.maximum(there, back)
    return np.where(known[:, None] & (now.label[:, None] == before.label), apart, _FAR)

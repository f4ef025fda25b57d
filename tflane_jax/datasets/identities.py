"""Ids for lanes, areas and traffic elements that stay the same from frame to frame.

Examples have no ids. An item gets the id of the item of the previous frame that, after ego-motion compensation, is
matched to it (Hungarian assignment) and nearer than a threshold. A lane that the border of the perception range cuts at
another place still lies on its previous line.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import invert_pose, line_distances, transform_points
from tflane_jax.scene import Example

# Metres; items farther apart are different. Resampled polylines of one curve differ by less.
_SAME = 0.75
_FAR = 1e6


@dataclass
class _Items:
    """Items of one kind in the latest frame: shapes, labels and ids of the valid rows."""

    lines: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    ids: list[str] = field(default_factory=list)


class Identities:
    """Ids of one scene's items, frame by frame.

    Attributes:
        lanes, segments, areas, elements: from row of the latest example to id, for valid rows.
    """

    def __init__(self) -> None:
        self.lanes: dict[int, str] = {}
        self.segments: dict[int, str] = {}
        self.areas: dict[int, str] = {}
        self.elements: dict[int, str] = {}
        self._before: dict[str, _Items] = {}
        self._count = 0

    def step(self, example: Example) -> None:
        """Take the next frame of the scene; a frame whose `has_previous` is false starts a new scene."""
        if not example.has_previous:
            self._before = {}
        ego_from_previous = invert_pose(np.asarray(example.previous_from_ego, np.float64))
        self.lanes = self._next("lane", example.lanes.points, None, example.lanes.valid, ego_from_previous)
        segments, areas, elements = example.segments, example.areas, example.traffic_elements
        self.segments = self._next("segment", segments.points, None, segments.valid, ego_from_previous)
        self.areas = self._next("area", areas.points, areas.category, areas.valid, ego_from_previous)
        self.elements = {}
        if elements is not None:
            # An element is a point. Datasets without positions put all of them at the origin.
            place = np.repeat(np.asarray(elements.position)[:, None], 2, 1)
            self.elements = self._next("element", place, elements.category, elements.valid, ego_from_previous)

    def _next(
        self,
        kind: str,
        lines: Float[np.ndarray, "n p 3"],
        label: Int[np.ndarray, " n"] | None,
        valid: Bool[np.ndarray, " n"],
        ego_from_previous: Float[np.ndarray, "4 4"],
    ) -> dict[int, str]:
        """Return the ids of one kind's items in the next frame, by row, for valid rows."""
        rows = np.flatnonzero(valid)
        label = np.zeros(len(rows), int) if label is None else np.asarray(label)[rows]
        now = _Items(np.asarray(lines, np.float64)[rows], label)
        before, ids = self._before.get(kind, _Items()), {}
        if len(rows) and len(before.ids):
            moved = _Items(transform_points(ego_from_previous, before.lines), before.label)
            pairs = pairs_within(_separation(now, moved), _SAME)
            ids = {item: before.ids[previous] for item, previous in pairs.items()}
        for item in range(len(rows)):
            if item not in ids:
                ids[item] = str(self._count)
                self._count += 1
        now.ids = [ids[item] for item in range(len(rows))]
        self._before[kind] = now
        return dict(zip(rows.tolist(), now.ids, strict=True))


def pairs_within(apart: Float[np.ndarray, "n m"], limit: float) -> dict[int, int]:
    """Return the column of each row that has one nearer than a limit.

    The pairs minimise the sum of distances clipped at the limit, so that items which appear or disappear do not affect
    the others.
    """
    from scipy.optimize import linear_sum_assignment

    pairs = zip(*linear_sum_assignment(np.minimum(apart, limit)), strict=True)
    return {int(row): int(column) for row, column in pairs if apart[row, column] < limit}


def _separation(now: _Items, before: _Items) -> Float[np.ndarray, "n m"]:
    """Return the distance of items: the smaller of the two mean distances from one to the other.

    The smaller one, because a line may be cut shorter. A small part of the other direction decides between lines that
    overlap in part.
    """
    there = line_distances(now.lines[:, None], before.lines)[0].mean(-1)
    back = line_distances(before.lines[:, None], now.lines)[0].mean(-1).T
    known = np.abs(now.lines).max((1, 2)) > 0.0  # not an element whose position is not known
    apart = np.minimum(there, back) + 1e-3 * np.maximum(there, back)
    return np.where(known[:, None] & (now.label[:, None] == before.label), apart, _FAR)

"""Polylines of a map in one array."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import PerceptionRange, transform_points


@dataclass(frozen=True)
class PackedLines:
    """Polylines of a map in one array, so that one matrix product moves all of them into a frame.

    Attributes:
        points: (M, 3) all points, one line after the other.
        ends: (L,) index after the last point of each line.
    """

    points: np.ndarray
    ends: np.ndarray

    @classmethod
    def pack(cls, lines: Sequence[np.ndarray]) -> PackedLines:
        """Pack lines of any length, none empty."""
        ends = np.cumsum([len(line) for line in lines], dtype=int)
        return cls(np.concatenate([np.zeros((0, 3)), *lines]), ends)

    def line(self, number: int) -> Float[np.ndarray, "n 3"]:
        """Return one line (a view)."""
        return self.points[self.ends[number - 1] if number else 0 : self.ends[number]]

    def moved(self, pose: Float[np.ndarray, "4 4"]) -> PackedLines:
        """Return the lines in another frame."""
        return PackedLines(transform_points(pose, self.points), self.ends)

    def near(self, range_: PerceptionRange) -> list[int]:
        """Return the numbers of the lines whose bounding box meets the range."""
        if len(self.ends) == 0:
            return []
        starts = np.concatenate([[0], self.ends[:-1]])
        low = np.minimum.reduceat(self.points[:, :2], starts, axis=0)
        high = np.maximum.reduceat(self.points[:, :2], starts, axis=0)
        range_low, range_high = np.array([range_.x, range_.y]).T
        return np.flatnonzero(((high >= range_low) & (low <= range_high)).all(-1)).tolist()

"""Divisions of true lanes into groups: by occlusion, and by distance."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool

from tflane_jax.errors import UserError
from tflane_jax.metrics.frames import Lines, check_shape


class TrueLanes(Protocol):
    """True lanes of one frame, or lines of a map in their place."""

    @property
    def points(self) -> Lines:
        """Polylines, metres."""
        ...

    @property
    def visibility(self) -> Any:
        """Fraction of each in direct line of sight; None if it is not known."""
        ...


class Partition(Protocol):
    """A division of true lanes into groups, each lane in one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the groups."""
        ...

    @property
    def suffix(self) -> str:
        """What it adds to the name of the protocol."""
        ...

    def members(self, group: str, truth: TrueLanes) -> Bool[np.ndarray, " g"]:
        """Return which of the true lanes belong to a group; raise UserError if the truth lacks what decides it."""
        ...


@dataclass(frozen=True)
class ByOcclusion:
    """A lane is `occluded` if its visibility (fraction in direct line of sight) is below `below`, else `clear`."""

    below: float = 0.5
    names = ("occluded", "clear")

    @property
    def suffix(self) -> str:
        """What it adds to the name of the protocol."""
        return f", occluded: visibility < {self.below:g}"

    def members(self, group: str, truth: TrueLanes) -> Bool[np.ndarray, " g"]:
        """Return which of the true lanes belong to a group; raise UserError if their visibility is not known."""
        if truth.visibility is None:
            raise UserError("the truth has no visibility of its lanes: leave out the groups by occlusion")
        visibility = np.asarray(truth.visibility)
        check_shape(visibility, (len(truth.points),), "truth: visibility")
        return (visibility < self.below) == (group == "occluded")


BY_OCCLUSION = ByOcclusion()


@dataclass(frozen=True)
class ByDistance:
    """Lanes by the distance of their nearest vertex in the ground plane.

    Attributes:
        edges: distances at which one group ends and the next begins, metres, ascending.
    """

    edges: tuple[float, ...] = (10.0, 20.0, 30.0)
    suffix = ", by distance of a lane's nearest vertex"

    def __post_init__(self) -> None:
        if not all(low < high for low, high in itertools.pairwise((0.0, *self.edges, np.inf))):
            raise UserError(f"edges of groups by distance are {self.edges}: give metres above 0 in ascending order")

    @property
    def _ranges(self) -> dict[str, tuple[float, float]]:
        return {
            f"from {low:g} m" if high == np.inf else f"{low:g} to {high:g} m": (low, high)
            for low, high in itertools.pairwise([0.0, *self.edges, np.inf])
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the groups, nearest first."""
        return tuple(self._ranges)

    def members(self, group: str, truth: TrueLanes) -> Bool[np.ndarray, " g"]:
        """Return which of the true lanes belong to a group."""
        low, high = self._ranges[group]
        distance = np.array([np.linalg.norm(np.asarray(line)[:, :2], axis=-1).min() for line in truth.points])
        return (low <= distance) & (distance < high)

"""Metrics of groups of true lanes, and of groups of frames.

Every frame is matched once, with all lanes and all detections, by the official rules. Then, for the group S of lanes:

- average precisions count the true lanes in S and the detections whose nearest true lane lies in S, false positives
  included. Nearest is by the metric's distance, however large; below the largest threshold it is the official
  candidate. Detections in frames without true lanes count only in `all`;
- topology scores pool the vertex precisions of the lanes in S; their neighbours may lie outside S.

`all` is the official number. The groups of a partition share its lanes and its vertices, and its detections in frames
with lanes. Traffic elements and areas count only in `all` and in groups of frames. Published conventions for what the
truth lacks hold for `all`: in a part of a map, a class without true lines or areas has no average precision.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.bootstrap import Weights, checked_weights
from tflane_jax.metrics.frames import Lines, check_shape
from tflane_jax.metrics.merging import joined

COUNTS = ("frames", "lanes", "lines")
"""Numbers of a group that are no scores, but what its scores rest on."""

Scope = Literal["all", "frames", "lanes"]
"""What an accumulator holds: the whole test set, some of its frames, or some of the lanes or lines of every frame."""


def shown_of_part(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers of a part of the lanes or lines for a table; counts alone if it has none.

    By the official convention it would have DET_l 1, which only the whole test set keeps.
    """
    if values.get("lanes", values.get("lines")) != 0:
        return dict(values)
    return {name: value for name, value in values.items() if name in COUNTS}


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


class Matched(Protocol):
    """A frame that has been matched."""

    @property
    def lanes(self) -> int:
        """Number of true lanes."""
        ...

    @property
    def hits(self) -> Bool[np.ndarray, "k p"]:
        """True positives at each of the K thresholds."""
        ...

    def select(self, lanes: Bool[np.ndarray, " g"]) -> Self:
        """Return the part of the frame that belongs to some of its lanes."""
        ...


class LaneMetrics(Protocol):
    """An accumulator of matched frames: `CenterlineMetrics`, `LaneSegmentMetrics` or `VectorMapMetrics`."""

    @property
    def protocol(self) -> str:
        """Name and version."""
        ...

    def match(self, detections: Any, truth: Any) -> Matched:
        """Match a frame, with the nearest true lane of every detection, however far."""
        ...

    def add(self, frame: Any) -> None:
        """Add a matched frame."""
        ...

    def merge(self, *others: Any) -> Any:
        """Return an accumulator of the frames of all."""
        ...

    def compute(self, scope: Scope = "all") -> dict[str, float]:
        """Return the numbers that this scope has."""
        ...

    def means(self) -> dict[str, Float[np.ndarray, "f 2"]]:
        """Return the scores, recall aside, that are ratios of two sums over frames: the terms of both sums."""
        ...

    def bootstrap(self, weights: Weights, scope: Scope = "all") -> dict[str, Float[np.ndarray, " b"]]:
        """Return the scores that rank detections, in samples that count the frames as often as `weights` says."""
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


FrameGroup = str | Sequence[str] | None
"""The groups of frames that a frame belongs to: one, several, or none."""


class GroupedMetrics:
    """Accumulators of all lanes and of groups of them, see the module's docstring; of map lines in their place.

    Args:
        make: returns an accumulator.
        groups: which of "all" and the groups of the partition to report; default all of them.
        partition: of the lanes; its groups are reported. Default by occlusion.
        frame_groups: names of groups of frames, which are measured like `all` on these frames alone.
        lane_groups: names of further groups of lanes, which may overlap; the caller gives their members.
    """

    def __init__(
        self,
        make: Callable[[], LaneMetrics],
        groups: Sequence[str] | None = None,
        *,
        partition: Partition = BY_OCCLUSION,
        frame_groups: Sequence[str] = (),
        lane_groups: Sequence[str] = (),
    ) -> None:
        self.partition = partition
        self._frame_groups = frozenset(frame_groups)
        self._lane_groups = frozenset(lane_groups)
        groups = ("all", *partition.names) if groups is None else groups
        names = ["all", *partition.names, *lane_groups, *frame_groups]
        if twice := {name for name in names if names.count(name) > 1}:
            raise UserError(f"two groups are called {min(twice)}: give the further one another name")
        self._metrics = {group: make() for group in (*groups, *lane_groups, *frame_groups)}
        self._empty = make()
        # Of every frame: true lanes and hits, summed over the thresholds.
        self._recalled: dict[str, list[tuple[int, int]]] = {group: [] for group in self._metrics}
        # Of every frame: whether the group measures it.
        self._measures: dict[str, list[bool]] = {group: [] for group in self._metrics}

    @property
    def protocol(self) -> str:
        """Name and version, the title of every table of these numbers."""
        return self._metrics.get("all", self._empty).protocol + self._suffix

    @property
    def _suffix(self) -> str:
        return self.partition.suffix if self._metrics.keys() & set(self.partition.names) else ""

    def update(
        self,
        detections: Any,
        truth: TrueLanes,
        frame_group: FrameGroup = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one frame, given as to the accumulator's own `update`; further arguments as of `add`.

        Raises UserError for arrays that do not fit together, or a visibility that is not known.
        """
        self.add(self._empty.match(detections, truth), truth, frame_group, members)

    def add(
        self,
        frame: Matched,
        truth: TrueLanes,
        frame_group: FrameGroup = None,
        members: Mapping[str, Bool[np.ndarray, " g"]] | None = None,
    ) -> None:
        """Add one matched frame.

        Args:
            frame: matching results.
            truth: the lanes that it was matched with.
            frame_group: the groups of frames that it belongs to.
            members: for each of `lane_groups`, which of the true lanes belong to it.
        """
        own = (frame_group,) if isinstance(frame_group, str) else frame_group or ()
        if unknown := set(own) - set(self._frame_groups):
            raise UserError(
                f"there is no group of frames {min(unknown)!r}, only {', '.join(self._frame_groups) or 'none'}"
            )
        for group, metrics in self._metrics.items():
            lanes = hits = 0
            self._measures[group].append(group not in self._frame_groups or group in own)
            if self._measures[group][-1]:
                part = frame
                if group in self._lane_groups:
                    part = frame.select(self._members(group, members, frame.lanes))
                elif group != "all" and group not in own:
                    part = frame.select(self.partition.members(group, truth))
                metrics.add(part)
                lanes, hits = part.lanes, int(part.hits.sum())
            self._recalled[group].append((lanes, hits))

    @staticmethod
    def _members(group: str, members: Mapping[str, Any] | None, lanes: int) -> Bool[np.ndarray, " g"]:
        """Return the members of a further group of lanes; raise UserError for anything but a bool for each lane."""
        if members is None or group not in members:
            raise UserError(f"members lacks {group}, one of the lane_groups")
        found = np.asarray(members[group])
        if found.dtype != bool or found.shape != (lanes,):
            raise UserError(
                f"members of {group} are {found.dtype} of shape {found.shape}, expected bool of shape ({lanes},)"
            )
        return found

    def recalled(self) -> dict[str, Int[np.ndarray, "f 2"]]:
        """Return by group, for every frame: true lanes, and hits summed over the thresholds.

        Recall is the sum of the hits over frames, divided by the number of thresholds times the sum of the lanes.
        """
        return {group: np.array(counts, int).reshape(-1, 2) for group, counts in self._recalled.items()}

    def merge(self, *others: Self) -> Self:
        """Return an accumulator of the frames of all, in this order (none changes)."""
        for other in others:
            # Frames of either may lack a class that the protocol of the others names.
            same = self._empty.protocol == other._empty.protocol and self._suffix == other._suffix
            if not same or self._metrics.keys() != other._metrics.keys():
                raise UserError(f"cannot merge metrics of {self.protocol} with {other.protocol}, or of other groups")
        every, merged = (self, *others), copy.copy(self)
        merged._metrics = {
            group: metrics.merge(*(other._metrics[group] for other in others))
            for group, metrics in self._metrics.items()
        }
        merged._recalled = {group: joined([each._recalled[group] for each in every]) for group in self._metrics}
        merged._measures = {group: joined([each._measures[group] for each in every]) for group in self._metrics}
        return merged

    def compute(self) -> dict[str, dict[str, float]]:
        """Return the numbers of each group."""
        return {group: metrics.compute(self._scope(group)) for group, metrics in self._metrics.items()}

    def means(self) -> dict[str, dict[str, Float[np.ndarray, "f 2"]]]:
        """Return by group the scores that are ratios of two sums over frames: the terms of both sums, by frame."""
        return {
            group: {name: _spread(parts, self._measures[group]) for name, parts in metrics.means().items()}
            for group, metrics in self._metrics.items()
        }

    def bootstrap(self, weights: Weights) -> dict[str, dict[str, Float[np.ndarray, " b"]]]:
        """Return by group the scores that rank detections, in samples that count the frames as often as `weights` says.

        The samples are exact, see `metrics.bootstrap`. Raises UserError for weights of another shape or kind.
        """
        found = {}
        for group, metrics in self._metrics.items():
            measured = np.array(self._measures[group], bool)
            found[group] = metrics.bootstrap(checked_weights(weights, len(measured))[:, measured], self._scope(group))
        return found

    def _scope(self, group: str) -> Scope:
        if group == "all":
            return "all"
        return "frames" if group in self._frame_groups else "lanes"


def _spread(parts: Float[np.ndarray, "m 2"], measured: Sequence[bool]) -> Float[np.ndarray, "f 2"]:
    """Return the terms of all frames; frames that are not measured have none."""
    spread = np.zeros((len(measured), 2))
    spread[np.array(measured, bool)] = parts
    return spread

"""Metrics of groups of true lanes, and of groups of frames.

Every frame is matched once, with all lanes and all detections, by the official rules. Then, for the group S of lanes:

- average precisions count the true lanes in S and the detections whose nearest true lane lies in S, false positives
  included. Nearest is by the metric's distance, however large; below the largest threshold it is the official
  candidate. Detections in frames without true lanes, or map lines of their class, count only in `all`;
- topology scores pool the vertex precisions of the lanes in S; their neighbours may lie outside S.

`all` is the official number. The groups of a partition (`metrics.partitions`) share its lanes and its vertices, and its
detections in frames with lanes (of map lines: with lines of the detection's class). Traffic elements and areas count
only in `all` and in groups of frames. Published conventions for what the truth lacks hold for `all`: in a part of a
map, a class without true lines or areas has no average precision.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.bootstrap import Weights, checked_weights
from tflane_jax.metrics.merging import joined
from tflane_jax.metrics.partitions import BY_OCCLUSION, Partition, TrueLanes

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
        if isinstance(groups, str) or (unknown := set(groups) - {"all", *partition.names}):
            asked = groups if isinstance(groups, str) else min(unknown)
            raise UserError(f"groups names {asked!r}: give a list of {', '.join(('all', *partition.names))}")
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
        # All parts first: a frame that is refused changes nothing.
        parts = {
            group: self._part(group, frame, truth, own, members)
            for group in self._metrics
            if group not in self._frame_groups or group in own
        }
        for group, metrics in self._metrics.items():
            part = parts.get(group)
            self._measures[group].append(part is not None)
            if part is not None:
                metrics.add(part)
            self._recalled[group].append((0, 0) if part is None else (part.lanes, int(part.hits.sum())))

    def _part(
        self, group: str, frame: Matched, truth: TrueLanes, own: Sequence[str], members: Mapping[str, Any] | None
    ) -> Matched:
        """Return the part of a frame that a group measures."""
        if group in self._lane_groups:
            return frame.select(self._members(group, members, frame.lanes))
        return frame if group == "all" or group in own else frame.select(self.partition.members(group, truth))

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

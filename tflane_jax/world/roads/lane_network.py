"""Mutable lane segments of a road network under construction, before they become a `VectorMap`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment

FIRST_ID = 1000


@dataclass(frozen=True)
class LaneEnd:
    """Where a lane enters or leaves a junction: the cross-section that a connector must meet.

    Attributes:
        segment: id of the segment that ends or starts here.
        left, right: (2,) metres.
        heading: of travel, radians.
        vehicle: open to motor vehicles.
        pocket: -1 for a lane that only turns left, 1 for one that only turns right, 0 for any other.
    """

    segment: int
    left: Float[np.ndarray, "2"]
    right: Float[np.ndarray, "2"]
    heading: float
    vehicle: bool
    pocket: int = 0

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Middle of the lane."""
        return 0.5 * (self.left + self.right)

    @property
    def width(self) -> float:
        """Metres."""
        return float(np.hypot(*(self.left - self.right)))


@dataclass
class Draft:
    """A lane segment under construction: paired boundary vertices (n, 2) and its attributes in `RoadNetwork`."""

    left: Float[np.ndarray, "n 2"]
    right: Float[np.ndarray, "n 2"]
    left_type: LineType
    right_type: LineType
    speed: float
    vehicle: bool
    is_intersection: bool
    ego: bool
    successors: list[int] = field(default_factory=list)


@dataclass
class LaneNetwork:
    """Lane segments under construction with their successors and rules of priority.

    Attributes:
        drafts: by segment id.
        yield_to: segment -> segments whose traffic has priority over its own.
        signal_phase: connector -> (intersection index, phase index).
    """

    drafts: dict[int, Draft] = field(default_factory=dict)
    yield_to: dict[int, set[int]] = field(default_factory=dict)
    signal_phase: dict[int, tuple[int, int]] = field(default_factory=dict)

    def add(self, draft: Draft) -> int:
        """Add a segment and return its id."""
        segment = FIRST_ID + len(self.drafts)
        self.drafts[segment] = draft
        return segment

    def connect(self, segment: int, successor: int) -> None:
        """Let `successor` continue `segment`; their boundaries must already meet."""
        self.drafts[segment].successors.append(successor)

    def weld(self, segment: int, successor: int, *, keep: int) -> None:
        """Connect two segments whose boundaries meet up to rounding; the other copies the end vertices of `keep`."""
        a, b = self.drafts[segment], self.drafts[successor]
        if keep == segment:
            b.left[0], b.right[0] = a.left[-1], a.right[-1]
        else:
            a.left[-1], a.right[-1] = b.left[0], b.right[0]
        self.connect(segment, successor)

    def let_pass(self, segment: int, others: set[int]) -> None:
        """Make traffic on `segment` wait for traffic on `others`."""
        self.yield_to.setdefault(segment, set()).update(others)

    def start_of(self, segment: int, vehicle_heading: float) -> LaneEnd:
        """Return the cross-section at which a segment starts."""
        draft = self.drafts[segment]
        return LaneEnd(segment, draft.left[0], draft.right[0], vehicle_heading, draft.vehicle)

    def end_of(self, segment: int, vehicle_heading: float, pocket: int = 0) -> LaneEnd:
        """Return the cross-section at which a segment ends."""
        draft = self.drafts[segment]
        return LaneEnd(segment, draft.left[-1], draft.right[-1], vehicle_heading, draft.vehicle, pocket)

    def segments(self) -> dict[int, LaneSegment]:
        """Return the finished segments on the plane z = 0; a centerline is the mean of its boundaries' vertices."""
        out = {}
        for segment, draft in self.drafts.items():
            lines = np.zeros((3, len(draft.left), 3))
            lines[1, :, :2], lines[2, :, :2] = draft.left, draft.right
            lines[0] = 0.5 * (lines[1] + lines[2])
            out[segment] = LaneSegment(
                id=segment,
                centerline=lines[0],
                left=lines[1],
                right=lines[2],
                left_type=draft.left_type,
                right_type=draft.right_type,
                is_intersection=draft.is_intersection,
                successors=tuple(draft.successors),
                vehicle=draft.vehicle,
            )
        return out

    def routes(self, shortest: float) -> tuple[tuple[int, ...], ...]:
        """Return every route over the segments open to the ego vehicle that is at least `shortest` metres long.

        A route starts at a segment without such a predecessor, goes on as far as possible and repeats no segment.
        """
        inside = {i for i, d in self.drafts.items() if d.ego and d.vehicle}
        entered = {j for i in inside for j in self.drafts[i].successors}
        length = {i: _length(self.drafts[i]) for i in inside}
        ways: list[tuple[int, ...]] = []
        stack: list[tuple[int, ...]] = [(i,) for i in sorted(inside - entered, reverse=True)]
        while stack:
            way = stack.pop()
            onward = [j for j in self.drafts[way[-1]].successors if j in inside and j not in way]
            if onward:
                stack.extend((*way, j) for j in reversed(onward))
            elif sum(length[i] for i in way) >= shortest:
                ways.append(way)
        return tuple(ways)


def _length(draft: Draft) -> float:
    steps = np.diff(0.5 * (draft.left + draft.right), axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())

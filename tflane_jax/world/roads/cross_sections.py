"""Cross-sections of streets: the lanes and strips of one direction of travel.

Each direction of travel is a *side*: strips counted from the axis outwards to the right of travel (half the median,
vehicle lanes, bike lane, parking, gutter, kerb). A side may have extra lanes over a part of its length, which fork from
a neighbour and merge back into it along a taper.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.world.roads.curves import smoothstep

# Stations nearer than this are the same, metres: far below any spacing, far above rounding errors.
SAME_STATION = 1e-6
# A lane that opens or closes has its full width for at least so long, metres.
_FULL = 10.0


class Place(enum.Enum):
    """Where an extra lane lies beside the lanes that run through."""

    MEDIAN = "left, carved out of the median or the left kerb"
    LEFT = "left, pushing the other lanes to the right"
    RIGHT = "right"


@dataclass(frozen=True)
class ExtraLane:
    """A lane that exists along a part of a side.

    Attributes:
        place: which side of the through lanes.
        start, stop: distance along the side in travel direction, metres.
        forks, merges: taper with which it leaves and rejoins its neighbour, metres; 0 where it starts or ends at full
            width (at a junction, at a ramp, at the border of the map).
    """

    place: Place
    start: float
    stop: float
    forks: float = 0.0
    merges: float = 0.0

    def presence(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return its width at distances along the side as a fraction of a lane width: 0 absent, 1 full."""
        up = smoothstep((t - self.start) / self.forks) if self.forks else t >= self.start - SAME_STATION
        down = smoothstep((self.stop - t) / self.merges) if self.merges else t <= self.stop + SAME_STATION
        return up * down


@dataclass(frozen=True)
class SidePlan:
    """Cross-section of one direction of travel. `lanes` = 0 is the bare left edge of a one-way street.

    Attributes:
        lanes: vehicle lanes that run through.
        lane_width, bike, parking, gutter: widths in metres; 0 = none.
        inner: distance from the axis to the first lane.
        extras: lanes along a part of the side.
        pockets: turning lanes before the junction at which the side ends.
        pocket_length, taper: of the turning lanes, metres.
        opens: lanes that fork off and run on to the end: where, and how far behind the start they begin, metres.
        closes: lanes that come from the start and merge: where, and how far before the end they are gone, metres.
        inner_marking, outer_marking, divider_marking: of the leftmost line, the rightmost one, and those between lanes.
    """

    lanes: int
    lane_width: float = 3.3
    inner: float = 0.0
    bike: float = 0.0
    parking: float = 0.0
    gutter: float = 0.4
    extras: tuple[ExtraLane, ...] = ()
    pockets: tuple[Place, ...] = ()
    pocket_length: float = 42.0
    taper: float = 22.0
    opens: tuple[tuple[Place, float], ...] = ()
    closes: tuple[tuple[Place, float], ...] = ()
    inner_marking: LineType = LineType.SOLID
    outer_marking: LineType = LineType.SOLID
    divider_marking: LineType = LineType.DASHED

    @property
    def outer(self) -> float:
        """Distance from the axis to the right line of the last through lane."""
        return self.inner + self.lanes * self.lane_width

    def kerb(self, extra_width: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
        """Return the distance from the axis to the kerb where extra lanes take `extra_width` metres.

        Extra lanes use up the parking strip before they widen the road.
        """
        return self.outer + self.bike + self.gutter + np.maximum(self.parking, extra_width)

    def kerb_before_junction(self) -> float:
        """Return the distance from the axis to the kerb at the stop line."""
        widening = sum(place is not Place.MEDIAN for place in self.pockets)
        return float(self.kerb(widening * self.lane_width))

    def over(self, length: float) -> SidePlan:
        """Return the plan of a side of this length, on which every lane that does not run through is an extra lane.

        A lane opens or closes only where it fits with its taper.
        """
        room = length - self.taper - _FULL
        pockets = [ExtraLane(p, length - self.pocket_length, length, forks=self.taper) for p in self.pockets]
        opens = [ExtraLane(p, start, length, forks=self.taper) for p, start in self.opens if start < room]
        closes = [ExtraLane(p, 0.0, length - before, merges=self.taper) for p, before in self.closes if before < room]
        return replace(self, extras=(*self.extras, *pockets, *opens, *closes), pockets=(), opens=(), closes=())

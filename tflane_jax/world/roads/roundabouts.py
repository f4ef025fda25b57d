"""Roundabouts: a one-lane ring, driven counter-clockwise, with an entry and an exit at each arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.world.roads.curves import blend, direction
from tflane_jax.world.roads.intersections import Arm
from tflane_jax.world.roads.lane_network import Draft, LaneEnd, LaneNetwork
from tflane_jax.world.roads.movements import RIGHT, Approach, Movement

# Distance from the outer kerb of the ring to the crossings and stop lines of the arms, metres.
_APRON = 9.0


@dataclass(frozen=True)
class Ring:
    """The circulating lane around the origin of the map.

    Attributes:
        radius: of its middle, metres.
        width: of the lane, metres.
        gutter: between the lane and its kerbs, metres.
        half_angle: from an arm's heading to where its entry joins and its exit leaves, radians.
        speed: limit, m/s.
    """

    radius: float
    width: float
    gutter: float
    half_angle: float
    speed: float

    @property
    def outer(self) -> float:
        """Radius of the outer kerb."""
        return self.radius + 0.5 * self.width + self.gutter

    def stop_distance(self, crossing: float) -> float:
        """Return how far out an arm's lanes end."""
        return self.outer + _APRON + crossing

    def island(self) -> Float[np.ndarray, "n 2"]:
        """Return the closed kerb ring of the central island."""
        angle = np.linspace(0.0, 2 * np.pi, 49)
        ring = (self.radius - 0.5 * self.width - self.gutter) * direction(angle)
        ring[-1] = ring[0]
        return ring


def kerb_corner(
    ring: Ring, arm: Arm, following: Arm, distance: float, distance_following: float
) -> Float[np.ndarray, "n 2"]:
    """Return the kerb from an arm's incoming side along the ring to the next arm's outgoing side."""
    angles = arm.heading + ring.half_angle, following.heading - ring.half_angle
    sweep = (angles[1] - angles[0]) % (2 * np.pi)
    arc_angle = angles[0] + np.linspace(0.0, sweep, max(int(ring.outer * sweep / 1.2), 2))
    arc = ring.outer * direction(arc_angle)
    start = arm.kerb_corner(distance, -arm.left)
    stop = following.kerb_corner(distance_following, following.right)
    entry = _curve(start, arm.heading + np.pi, arc[0], angles[0] + np.pi / 2)
    leave = _curve(arc[-1], angles[1] + np.pi / 2, stop, following.heading)
    return np.concatenate([entry[:-1], arc, leave[1:]])


def _curve(
    start: Float[np.ndarray, "2"], heading: float, stop: Float[np.ndarray, "2"], stop_heading: float
) -> Float[np.ndarray, "n 2"]:
    count = max(int(np.linalg.norm(stop - start) / 1.2), 5)
    return blend(start[None], np.array([heading]), stop[None], np.array([stop_heading]), count)[0][0]


def lay_ring(
    ring: Ring, approaches: Sequence[Approach], network: LaneNetwork, spacing: float
) -> list[tuple[Movement, int | None]]:
    """Add the ring's segments to the network and return its entries and exits.

    Each movement is paired with the ring segment to which it yields; None for exits.

    Args:
        ring: its shape.
        approaches: arms in counter-clockwise order, one vehicle lane each way.
        network: receives the segments.
        spacing: largest distance between vertices, metres.
    """
    headings = np.array([a.heading for a in approaches])
    # Counter-clockwise: arm 0's entry, arm 1's exit, arm 1's entry, ...
    stops = np.stack([headings + ring.half_angle, np.roll(headings, -1) - ring.half_angle], 1).reshape(-1)
    stops = stops[0] + np.concatenate([[0.0], np.cumsum(np.diff(stops, append=stops[0]) % (2 * np.pi))])
    ids = [_arc(ring, a, b, network, spacing) for a, b in pairwise(stops.tolist())]
    for k, segment in enumerate(ids):
        following = ids[(k + 1) % len(ids)]
        network.weld(segment, following, keep=following)
    movements: list[tuple[Movement, int | None]] = []
    for i, approach in enumerate(approaches):
        between, past = ids[2 * i - 1], ids[2 * i]  # passing the arm, and from its entry on
        entry = network.start_of(past, float(stops[2 * i]) + np.pi / 2)
        leave = network.end_of(ids[2 * i - 2], float(stops[2 * i - 1] if i else stops[-2]) + np.pi / 2)
        for lane in _vehicle(approach.incoming):
            movements.append((Movement(i, i, lane, entry, RIGHT), between))
        for lane in _vehicle(approach.outgoing):
            movements.append((Movement(i, i, leave, lane, RIGHT), None))
    return movements


def _vehicle(lanes: tuple[LaneEnd, ...]) -> list[LaneEnd]:
    return [lane for lane in lanes if lane.vehicle]


def _arc(ring: Ring, start: float, stop: float, network: LaneNetwork, spacing: float) -> int:
    angle = np.linspace(start, stop, max(int(np.ceil(ring.radius * (stop - start) / spacing)), 2) + 1)
    spoke = direction(angle)
    return network.add(
        Draft(
            (ring.radius - 0.5 * ring.width) * spoke,
            (ring.radius + 0.5 * ring.width) * spoke,
            LineType.SOLID,
            LineType.NONE,
            ring.speed,
            vehicle=True,
            is_intersection=True,
            ego=True,
        )
    )

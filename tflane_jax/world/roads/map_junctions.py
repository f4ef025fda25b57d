"""Intersections of a recorded map: which connectors belong together, who gives way, where lights could stand.

Recorded maps hold the connections of lanes, but no right of way. Arms, turns, priorities and signal phases follow from
the geometry by the rules of the built-in intersections (`right_of_way`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import wrap_angle
from tflane_jax.scene.logs import LaneSegment, MapElement
from tflane_jax.world.roads.curves import arc_length, direction, points_at
from tflane_jax.world.roads.movements import LEFT, RIGHT, STRAIGHT, THROUGH
from tflane_jax.world.roads.right_of_way import lines_meet, phases_of
from tflane_jax.world.roads.traffic_control import GREEN, LIGHT, LIGHT_HEIGHT, RED

# Connectors nearer to each other than this belong to one intersection, metres.
_TOGETHER = 3.5
# Entries of one arm start near each other, metres, and with about the same heading.
_ARM, _SAME_WAY = 20.0, np.deg2rad(30.0)
# Lights hang so far behind the stop line, metres.
_NEAREST_LIGHT, _FARTHEST_LIGHT = 8.0, 35.0
_RANKS = {THROUGH: 0, RIGHT: 1, LEFT: 2}


@dataclass(frozen=True)
class MapJunction:
    """An intersection: C connectors from A arms.

    Attributes:
        connectors: (C,) lane ids.
        arm: (C,) from which each comes.
        entry: (C,) it begins at the border of the intersection, not inside.
        turn: (C,) LEFT, THROUGH or RIGHT.
        meet: (C, C) which connectors conflict.
        minor: (A,) the arm gives way to others where there are no signals.
        phase: (A,) of signals.
        incoming: segment ids of the lanes before it, with the arm of each.
        lights: (x, y, yaw) of a light for each of them.
        center: (2,) metres.
    """

    connectors: tuple[int, ...]
    arm: tuple[int, ...]
    entry: tuple[bool, ...]
    turn: tuple[int, ...]
    meet: Bool[np.ndarray, "c c"]
    minor: tuple[bool, ...]
    phase: tuple[int, ...]
    incoming: tuple[tuple[int, int], ...]
    lights: Float[np.ndarray, "i 3"]
    center: Float[np.ndarray, "2"]

    @property
    def may_have_signals(self) -> bool:
        """Three arms or more, whose traffic crosses."""
        return len(self.minor) > 2 and max(self.phase) > 0 and bool(self.meet.any()) and len(self.incoming) > 0

    def gives_way(self, signals: bool) -> dict[int, tuple[int, ...]]:
        """Return connector -> connectors with priority; with signals, only those of the same phase."""
        ranks = [
            (0 if signals else self.minor[arm], _RANKS[turn], arm)
            for arm, turn in zip(self.arm, self.turn, strict=True)
        ]
        found = {}
        for a, connector in enumerate(self.connectors):
            before = [
                self.connectors[b]
                for b in np.flatnonzero(self.meet[a]).tolist()
                if ranks[b] < ranks[a] and (not signals or self.phase[self.arm[a]] == self.phase[self.arm[b]])
            ]
            if before:
                found[connector] = tuple(sorted(before))
        return found

    def signal_phases(self) -> dict[int, int]:
        """Return the phase of each connector at whose start a light stands."""
        columns = zip(self.connectors, self.arm, self.entry, strict=True)
        return {connector: self.phase[arm] for connector, arm, entry in columns if entry}

    def elements(self, green: int) -> list[MapElement]:
        """Return the lights over the incoming lanes; those of phase `green` are green at first."""
        return [
            MapElement(
                np.array([x, y, LIGHT_HEIGHT]), yaw, LIGHT, GREEN if self.phase[arm] == green else RED, (segment,)
            )
            for (segment, arm), (x, y, yaw) in zip(self.incoming, self.lights.tolist(), strict=True)
        ]


def find_junctions(lanes: Mapping[int, LaneSegment], segments: Mapping[int, LaneSegment]) -> list[MapJunction]:
    """Return the intersections of a map.

    Args:
        lanes: from `traffic_lanes`.
        segments: of the map.
    """
    connectors = {i: lane for i, lane in lanes.items() if lane.is_intersection}
    return [_junction(members, lanes, segments) for members in _groups(connectors)]


def merging_lanes(lanes: Mapping[int, LaneSegment]) -> dict[int, tuple[int, ...]]:
    """Return the lanes outside of intersections that end in another one, each with that one: the longest."""
    into: dict[int, list[int]] = {}
    for i, lane in lanes.items():
        for j in lane.successors:
            if lane.vehicle and not lane.is_intersection:
                into.setdefault(j, []).append(i)
    found: dict[int, tuple[int, ...]] = {}
    for rivals in into.values():
        main = max(rivals, key=lambda i: arc_length(lanes[i].centerline[:, :2])[-1])
        found |= {i: (main,) for i in rivals if i != main}
    return found


def _groups(connectors: Mapping[int, LaneSegment]) -> list[list[int]]:
    """Return the connectors that lie together or continue each other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if not connectors:
        return []
    number = {i: k for k, i in enumerate(connectors)}
    lines = [_evenly(lane.centerline[:, :2]) for lane in connectors.values()]
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    pairs = owner[KDTree(np.concatenate(lines)).query_pairs(_TOGETHER, output_type="ndarray")].reshape(-1, 2)
    links = [(number[i], number[j]) for i, lane in connectors.items() for j in lane.successors if j in number]
    a, b = np.concatenate([pairs, np.array(links, int).reshape(-1, 2)]).T
    _, label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(lines),) * 2), directed=False)
    ids = list(connectors)
    return [[ids[k] for k in np.flatnonzero(label == group)] for group in range(label.max() + 1)]


def _evenly(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "k 2"]:
    length = arc_length(line)[-1]
    return points_at(line, np.linspace(0.0, length, max(int(length / 1.5), 1) + 1))


def _heading(line: Float[np.ndarray, "n d"], end: int) -> float:
    """Return the direction at the start (0) or the end (-1) of a line: that of the first or last 2 m."""
    length = arc_length(line[:, :2])[-1]
    reach = min(2.0, length)
    a, b = points_at(line[:, :2], np.array([0.0, reach] if end == 0 else [length - reach, length]))
    return float(np.arctan2(*(b - a)[::-1]))


def _junction(
    members: Sequence[int], lanes: Mapping[int, LaneSegment], segments: Mapping[int, LaneSegment]
) -> MapJunction:
    inside = set(members)
    before: dict[int, list[int]] = {i: [] for i in members}
    for i in members:
        for j in lanes[i].successors:
            if j in inside:
                before[j].append(i)
    starts = {i: _heading(lanes[i].centerline, 0) for i in members}
    ends = {i: _heading(lanes[i].centerline, -1) for i in members}
    arm, heading = _arms([i for i in members if not before[i]] or list(members[:1]), lanes, starts)
    left = [i for i in members if i not in arm]
    while left:  # connectors that begin inside come from the arm of the one before
        known = [i for i in left if any(j in arm for j in before[i])] or left[:1]
        arm |= {i: next((arm[j] for j in before[i] if j in arm), 0) for i in known}
        left = [i for i in left if i not in arm]
    turn = {i: _turn(float(wrap_angle(ends[i] - starts[i]))) for i in members}
    lines = [_evenly(lanes[i].centerline[:, :2]) for i in members]
    arms = [arm[i] for i in members]
    incoming = [
        (segment.id, arm[j])
        for segment in segments.values()
        if segment.vehicle and segment.id not in inside and not segment.is_intersection
        for j in [next((j for j in segment.successors if j in inside and not before[j]), None)]
        if j is not None
    ]
    points = np.concatenate(lines)
    return MapJunction(
        connectors=tuple(members),
        arm=tuple(arms),
        entry=tuple(not before[i] for i in members),
        turn=tuple(turn[i] for i in members),
        meet=lines_meet([line - lines[0][0] for line in lines], arms, [lanes[i].vehicle for i in members]),
        minor=_minor(
            heading, [sum(a == k and turn[i] == THROUGH for i, a in arm.items()) for k, _ in enumerate(heading)]
        ),
        phase=tuple(phases_of([h + np.pi for h in heading])),
        incoming=tuple(incoming),
        lights=np.array([_light(segments[i].centerline[:, :2], points) for i, _ in incoming]).reshape(-1, 3),
        center=points.mean(0),
    )


def _arms(
    entries: Sequence[int], lanes: Mapping[int, LaneSegment], starts: Mapping[int, float]
) -> tuple[dict[int, int], list[float]]:
    """Return the arm of each entry, and the heading of each arm's traffic towards the intersection."""
    arm: dict[int, int] = {}
    first: list[int] = []
    for i in entries:
        here = lanes[i].centerline[0, :2]
        same = [
            k
            for k, j in enumerate(first)
            if abs(float(wrap_angle(starts[i] - starts[j]))) < _SAME_WAY
            and np.linalg.norm(here - lanes[j].centerline[0, :2]) < _ARM
        ]
        if not same:
            first.append(i)
        arm[i] = same[0] if same else len(first) - 1
    return arm, [starts[i] for i in first]


def _turn(angle: float) -> int:
    if abs(angle) < STRAIGHT:
        return THROUGH
    return LEFT if angle > 0.0 else RIGHT


def _minor(heading: Sequence[float], through: Sequence[int]) -> tuple[bool, ...]:
    """Return which arms give way: all but the facing pair with the most lanes straight on, or the arm with the most."""
    pairs = [
        (through[i] + through[j], i, j)
        for i in range(len(heading))
        for j in range(i + 1, len(heading))
        if abs(float(wrap_angle(heading[i] - heading[j] + np.pi))) < STRAIGHT
    ]
    major = {int(np.argmax(through))} if not pairs else set(max(pairs, key=lambda pair: (pair[0], -pair[1]))[1:])
    return tuple(k not in major for k in range(len(heading)))


def _light(lane: Float[np.ndarray, "n 2"], junction: Float[np.ndarray, "p 2"]) -> tuple[float, float, float]:
    """Return x, y and yaw of a light over the far side of the intersection, facing the traffic on a lane."""
    heading = _heading(lane, -1)
    ahead = direction(heading)
    beyond = np.clip(((junction - lane[-1]) @ ahead).max(), _NEAREST_LIGHT, _FARTHEST_LIGHT)
    x, y = lane[-1] + beyond * ahead
    return float(x), float(y), heading + np.pi

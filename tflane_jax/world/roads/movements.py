"""Movements through an intersection: which lane leads where, and the connector curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tflane_jax.scene import LineType
from tflane_jax.world.roads.curves import blend, right_of, wrap
from tflane_jax.world.roads.lane_network import Draft, LaneEnd, LaneNetwork

LEFT, THROUGH, RIGHT = 1, 0, -1
# The exit with the smallest turn counts as straight on if it turns by less than this.
STRAIGHT = np.deg2rad(50.0)
# Between a turning lane and the kerb at the corner, metres.
_KERB_CLEARANCE = 0.5


@dataclass(frozen=True)
class Approach:
    """One arm of an intersection with its lanes, left to right in travel direction.

    Attributes:
        heading: outwards, radians.
        incoming, outgoing: lanes (vehicles and bicycles).
        minor: its traffic yields to that of the other arms.
        no_left: left turns are forbidden.
        speed: limit of the street, m/s.
        incoming_kerb, outgoing_kerb: (2,) kerb beside the incoming and the outgoing lanes at the stop line, metres.
    """

    heading: float
    incoming: tuple[LaneEnd, ...]
    outgoing: tuple[LaneEnd, ...]
    minor: bool
    no_left: bool
    speed: float
    incoming_kerb: Float[np.ndarray, "2"]
    outgoing_kerb: Float[np.ndarray, "2"]


@dataclass(frozen=True)
class Movement:
    """One connector: from a lane of one arm to a lane of another.

    Attributes:
        arm, target: indices of the arms.
        source, sink: the lanes.
        turn: LEFT, THROUGH or RIGHT.
    """

    arm: int
    target: int
    source: LaneEnd
    sink: LaneEnd
    turn: int


def plan_movements(approaches: Sequence[Approach]) -> list[Movement]:
    """Assign exits to lanes; every reachable outgoing lane gets at least one connector."""
    movements: list[Movement] = []
    for i, approach in enumerate(approaches):
        ways = _ways(approaches, i)
        lanes = [lane for lane in approach.incoming if lane.vehicle]
        if lanes and ways:
            movements += _assign_lanes(i, lanes, ways, approaches)
        movements += _bike_movements(i, approaches, ways)
    reached = {m.sink.segment for m in movements}
    for j, approach in enumerate(approaches):
        for lane in approach.outgoing:
            if lane.vehicle and lane.segment not in reached:
                movements += _nearest_movement(movements, j, lane)
    return movements


def _ways(approaches: Sequence[Approach], arm: int) -> dict[int, int]:
    """Return the arm to which each existing and allowed turn leads: LEFT, THROUGH or RIGHT -> arm."""
    inbound = approaches[arm].heading + np.pi
    turns = {
        j: float(wrap(other.heading - inbound))
        for j, other in enumerate(approaches)
        if j != arm and any(lane.vehicle for lane in other.outgoing)
    }
    ways: dict[int, int] = {}
    if turns:
        straight = min(turns, key=lambda j: abs(turns[j]))
        if abs(turns[straight]) < STRAIGHT:
            ways[THROUGH] = straight
        for j in sorted(turns, key=lambda j: abs(turns[j])):
            if j != ways.get(THROUGH):
                ways.setdefault(LEFT if turns[j] > 0 else RIGHT, j)
    if approaches[arm].no_left and len(ways) > 1:
        ways.pop(LEFT, None)
    return ways


def _assign_lanes(
    arm: int, lanes: list[LaneEnd], ways: dict[int, int], approaches: Sequence[Approach]
) -> list[Movement]:
    """Return the movements of one arm: turning lanes only turn, outer lanes turn or go straight, others go straight."""
    general = [lane for lane in lanes if lane.pocket == 0 or _turn_of(lane) not in ways]
    left = [lane for lane in lanes if lane.pocket == -1 and LEFT in ways]
    right = [lane for lane in lanes if lane.pocket == 1 and RIGHT in ways]
    if THROUGH in ways:
        through = list(general)
        if LEFT in ways and not left:
            left = general[:1]
            if len(general) > 2:
                through = through[1:]
        if RIGHT in ways and not right:
            right = general[-1:]
    else:
        through = []
        half = (len(general) + 1) // 2
        if LEFT in ways and RIGHT in ways:
            left, right = left + general[:half], general[len(general) - half :] + right
        elif LEFT in ways:
            left = left + general
        else:
            right = general + right
    chosen = {LEFT: left, THROUGH: through, RIGHT: right}
    movements = []
    for turn, target in ways.items():
        sinks = [lane for lane in approaches[target].outgoing if lane.vehicle]
        for lane, sink in _pair(chosen[turn], sinks, turn):
            movements.append(Movement(arm, target, lane, sink, turn))
    return movements


def _turn_of(lane: LaneEnd) -> int:
    return LEFT if lane.pocket == -1 else RIGHT


def _pair(sources: list[LaneEnd], sinks: list[LaneEnd], turn: int) -> list[tuple[LaneEnd, LaneEnd]]:
    """Pair lanes in order: left turns from the left, right turns from the right, through lanes where they line up."""
    k, m = len(sources), len(sinks)
    if turn == RIGHT:
        return [(sources[k - 1 - i], sinks[max(m - 1 - i, 0)]) for i in range(k)]
    shift = 0
    if turn == THROUGH and k < m:
        shift = min(range(m - k + 1), key=lambda o: sum(_sideways(sources[i], sinks[i + o]) for i in range(k)))
    return [(sources[i], sinks[min(i + shift, m - 1)]) for i in range(k)]


def _sideways(source: LaneEnd, sink: LaneEnd) -> float:
    """Return how far a lane lies beside the straight continuation of another, metres."""
    return abs(float((sink.center - source.center) @ right_of(source.heading)))


def _bike_movements(arm: int, approaches: Sequence[Approach], ways: dict[int, int]) -> list[Movement]:
    sources = [lane for lane in approaches[arm].incoming if not lane.vehicle]
    if THROUGH not in ways:
        return []
    sinks = [lane for lane in approaches[ways[THROUGH]].outgoing if not lane.vehicle]
    return [Movement(arm, ways[THROUGH], a, b, THROUGH) for a, b in zip(sources, sinks, strict=False)]


def _nearest_movement(movements: list[Movement], target: int, lane: LaneEnd) -> list[Movement]:
    """Return a movement that also leads to `lane`, from the best placed lane that already goes to that arm."""
    rivals = [m for m in movements if m.target == target and m.source.vehicle]
    if not rivals:
        return []
    best = min(rivals, key=lambda m: (m.turn != THROUGH, np.linalg.norm(m.sink.center - lane.center)))
    return [Movement(best.arm, target, best.source, lane, best.turn)]


def lay_connectors(
    movements: Sequence[Movement],
    approaches: Sequence[Approach],
    network: LaneNetwork,
    lateral_acceleration: float,
    spacing: float,
    corner_radius: float | None,
) -> list[int]:
    """Add a connector segment for each movement, tangent to both of its lanes, and return their ids.

    Args:
        movements: to lay.
        approaches: arms of the intersection.
        network: receives the segments.
        lateral_acceleration: comfortable, m/s^2; limits the speed in curves.
        spacing: largest distance between vertices, metres.
        corner_radius: of the kerbs' roundings, which turns must not cut, metres; None without roundings.
    """
    if not movements:
        return []
    start = np.stack([m.source.center for m in movements])
    stop = np.stack([m.sink.center for m in movements])
    inbound = np.array([m.source.heading for m in movements])
    onward = np.array([m.sink.heading for m in movements])
    # Turns are tighter than streets bend: closer vertices keep the joints' angles small.
    count = max(int(np.ceil(1.6 * np.linalg.norm(stop - start, axis=-1).max() / spacing)), 6) + 1
    radius = np.full(len(movements), np.inf)
    if corner_radius is not None:
        turns = [k for k, m in enumerate(movements) if m.turn != THROUGH]
        radius[turns] = [_largest_radius(movements[k], approaches, corner_radius) for k in turns]
    center, heading = blend(start, inbound, stop, onward, count, radius)
    share = np.linspace(0.0, 1.0, count)
    widths = np.array([[m.source.width, m.sink.width] for m in movements])
    half = 0.5 * (widths[:, :1] + (widths[:, 1:] - widths[:, :1]) * share)
    side = half[..., None] * right_of(heading)
    left, right = center - side, center + side
    for k, m in enumerate(movements):
        left[k, 0], right[k, 0], left[k, -1], right[k, -1] = m.source.left, m.source.right, m.sink.left, m.sink.right
    speeds = _connector_speeds(center, heading, movements, approaches, lateral_acceleration)
    ids = []
    for k, m in enumerate(movements):
        connector = network.add(
            Draft(
                left[k],
                right[k],
                LineType.NONE,
                LineType.NONE,
                float(speeds[k]),
                vehicle=m.source.vehicle,
                is_intersection=True,
                ego=m.source.vehicle,
            )
        )
        network.connect(m.source.segment, connector)
        network.connect(connector, m.sink.segment)
        ids.append(connector)
    return ids


def _largest_radius(m: Movement, approaches: Sequence[Approach], corner_radius: float) -> float:
    """Return the radius up to which a turn keeps clear of the kerb's rounding at the corner that it goes around."""
    arm, target = approaches[m.arm], approaches[m.target]
    if m.turn == RIGHT:
        kerbs = arm.incoming_kerb, target.outgoing_kerb
    else:
        kerbs = arm.outgoing_kerb, target.incoming_kerb
    to_kerb = float(min(np.hypot(*(m.source.center - kerbs[0])), np.hypot(*(m.sink.center - kerbs[1]))))
    clear = min(to_kerb, 0.5 * max(m.source.width, m.sink.width) + _KERB_CLEARANCE)
    half_gap = 0.5 * (np.pi - abs(float(wrap(m.sink.heading - m.source.heading))))
    # The rounding's circle must lie inside the turn's with `clear` to spare; both touch the sides of the corner, so
    # that their centres are (radius - corner_radius - to_kerb) / sin(half_gap) apart.
    slope = 1.0 / np.sin(half_gap)
    return float(((corner_radius + to_kerb) * slope - corner_radius - clear) / max(slope - 1.0, 1e-6))


def _connector_speeds(
    center: Float[np.ndarray, "c n 2"],
    heading: Float[np.ndarray, "c n"],
    movements: Sequence[Movement],
    approaches: Sequence[Approach],
    lateral_acceleration: float,
) -> Float[np.ndarray, " c"]:
    """Return speeds at which the tightest part of each curve is driven comfortably, at most the street's limit."""
    step = np.linalg.norm(np.diff(center, axis=1), axis=-1)
    curvature = np.abs(wrap(np.diff(heading, axis=1))) / step
    tightest = np.quantile(curvature, 0.8, axis=1)
    limit = np.array([min(approaches[m.arm].speed, approaches[m.target].speed) for m in movements])
    return np.minimum(np.sqrt(lateral_acceleration / np.maximum(tightest, 1e-6)), limit)

"""Movements through an intersection: which lane leads where, and the connector curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import wrap_angle
from tflane_jax.scene import LineType
from tflane_jax.world.roads.curves import blend, right_of
from tflane_jax.world.roads.lane_network import Draft, LaneEnd, LaneNetwork

LEFT, THROUGH, RIGHT = 1, 0, -1
TurnsEnd = Literal["one lane each", "any lane"]
# The exit with the smallest turn counts as straight on if it turns by less than this.
STRAIGHT = np.deg2rad(50.0)
# Between a turning lane and the kerb at the corner, metres.
_KERB_CLEARANCE = 0.5
# Radii tried for turns past an arm, metres, and handles for an S between side streets that lie apart.
_RADII_PAST = tuple(np.geomspace(40.0, 5.0, 10).tolist())
_HANDLES = (0.4, 0.5, 0.6, 0.7, 0.8)


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


def plan_movements(approaches: Sequence[Approach], turns_end: TurnsEnd = "one lane each") -> list[Movement]:
    """Assign exits to lanes; every reachable outgoing lane gets at least one connector.

    Args:
        approaches: arms in counter-clockwise order.
        turns_end: on one lane for each lane that turns, or on any lane that the others leave free.
    """
    movements: list[Movement] = []
    for i, approach in enumerate(approaches):
        ways = _ways(approaches, i)
        lanes = [lane for lane in approach.incoming if lane.vehicle]
        if lanes and ways:
            movements += _assign_lanes(i, lanes, ways, approaches, turns_end)
        movements += _bike_movements(i, approaches, ways)
    reached = {m.sink.segment for m in movements}
    for j, approach in enumerate(approaches):
        for lane in approach.outgoing:
            if lane.vehicle and lane.segment not in reached:
                movements += _nearest_movement(movements, j, lane)
    return movements


def _ways(approaches: Sequence[Approach], arm: int) -> dict[int, list[int]]:
    """Return the arms to which each existing and allowed turn leads: LEFT, THROUGH or RIGHT -> slight turns first.

    Four arms or fewer have at most one on each side, five have two.
    """
    inbound = approaches[arm].heading + np.pi
    turns = {
        j: float(wrap_angle(other.heading - inbound))
        for j, other in enumerate(approaches)
        if j != arm and any(lane.vehicle for lane in other.outgoing)
    }
    ways: dict[int, list[int]] = {}
    for j in sorted(turns, key=lambda j: abs(turns[j])):
        straight = not ways and abs(turns[j]) < STRAIGHT
        ways.setdefault(THROUGH if straight else LEFT if turns[j] > 0 else RIGHT, []).append(j)
    if approaches[arm].no_left and len(ways) > 1:
        ways.pop(LEFT, None)
    return ways


def _assign_lanes(
    arm: int, lanes: list[LaneEnd], ways: dict[int, list[int]], approaches: Sequence[Approach], turns_end: TurnsEnd
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
    for turn, target in ((turn, target) for turn, targets in ways.items() for target in targets):
        sinks = [lane for lane in approaches[target].outgoing if lane.vehicle]
        pairs = _pair(chosen[turn], sinks, turn)
        if turns_end == "any lane" and turn != THROUGH and pairs:
            # The lanes beyond those that the pairs reach; the outermost turning lane leads to all of them.
            k = len(pairs)
            pairs += [(pairs[-1][0], sink) for sink in (sinks[k:] if turn == LEFT else sinks[: max(len(sinks) - k, 0)])]
        movements += [Movement(arm, target, lane, sink, turn) for lane, sink in pairs]
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


def _bike_movements(arm: int, approaches: Sequence[Approach], ways: dict[int, list[int]]) -> list[Movement]:
    sources = [lane for lane in approaches[arm].incoming if not lane.vehicle]
    if THROUGH not in ways:
        return []
    (target,) = ways[THROUGH]
    sinks = [lane for lane in approaches[target].outgoing if not lane.vehicle]
    return [Movement(arm, target, a, b, THROUGH) for a, b in zip(sources, sinks, strict=False)]


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
    corners: Sequence[Float[np.ndarray, "_ 2"]] = (),
) -> list[int]:
    """Add a connector segment for each movement, tangent to both of its lanes, and return their ids.

    Args:
        movements: to lay.
        approaches: arms of the intersection.
        network: receives the segments.
        lateral_acceleration: comfortable, m/s^2; limits the speed in curves.
        spacing: largest distance between vertices, metres.
        corner_radius: of the kerbs' roundings, which turns must not cut, metres; None without roundings.
        corners: kerbs between the arms, given where a turn may lead past an arm, or straight on be an S, which must
            not cut them either, metres.
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
    handle = np.full(len(movements), _HANDLES[0])
    for k, m in enumerate(movements if corners else ()):
        if m.turn == THROUGH:
            handle[k] = _clearest(m, corners, [(np.inf, h) for h in _HANDLES])[1]
        elif _passes_an_arm(m, len(approaches)):
            radius[k] = _clearest(m, corners, [(r, _HANDLES[0]) for r in _RADII_PAST])[0]
    center, heading = blend(start, inbound, stop, onward, count, radius, handle)
    fraction = np.linspace(0.0, 1.0, count)
    widths = np.array([[m.source.width, m.sink.width] for m in movements])
    half = 0.5 * (widths[:, :1] + (widths[:, 1:] - widths[:, :1]) * fraction)
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
    half_gap = 0.5 * (np.pi - abs(float(wrap_angle(m.sink.heading - m.source.heading))))
    # The rounding's circle must lie inside the turn's with `clear` to spare; both touch the sides of the corner, so
    # that their centers are (radius - corner_radius - to_kerb) / sin(half_gap) apart.
    slope = 1.0 / np.sin(half_gap)
    return float(((corner_radius + to_kerb) * slope - corner_radius - clear) / max(slope - 1.0, 1e-6))


def _passes_an_arm(m: Movement, arms: int) -> bool:
    """Return whether a turn leads beyond the next arm on its side; arms are in counter-clockwise order."""
    return (m.target - m.arm) % arms != (1 if m.turn == RIGHT else arms - 1)


def _clearest(
    m: Movement, corners: Sequence[Float[np.ndarray, "_ 2"]], shapes: Sequence[tuple[float, float]]
) -> tuple[float, float]:
    """Return the first of some shapes (radius, handle) whose lane is clear of all kerbs, else the clearest."""
    kerbs = np.concatenate(corners)
    wanted = 0.5 * max(m.source.width, m.sink.width) + _KERB_CLEARANCE
    ends = m.source.center[None], np.array([m.source.heading]), m.sink.center[None], np.array([m.sink.heading])
    clear = []
    for radius, handle in shapes:
        line = blend(*ends, 40, radius, handle)[0][0]
        # At both ends a lane may lie beside the gutter.
        clear.append(float(np.linalg.norm(line[:, None] - kerbs[None], axis=-1)[4:-4].min()))
        if clear[-1] > wanted:
            break
    return shapes[int(np.argmax(clear))]


def _connector_speeds(
    center: Float[np.ndarray, "c n 2"],
    heading: Float[np.ndarray, "c n"],
    movements: Sequence[Movement],
    approaches: Sequence[Approach],
    lateral_acceleration: float,
) -> Float[np.ndarray, " c"]:
    """Return speeds at which the tightest part of each curve is driven comfortably, at most the street's limit."""
    step = np.linalg.norm(np.diff(center, axis=1), axis=-1)
    curvature = np.abs(wrap_angle(np.diff(heading, axis=1))) / step
    tightest = np.quantile(curvature, 0.8, axis=1)
    limit = np.array([min(approaches[m.arm].speed, approaches[m.target].speed) for m in movements])
    return np.minimum(np.sqrt(lateral_acceleration / np.maximum(tightest, 1e-6)), limit)

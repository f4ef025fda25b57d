"""Right of way at an intersection: conflicting connectors, priorities and signal phases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import wrap_angle
from tflane_jax.world.roads.lane_network import LaneNetwork
from tflane_jax.world.roads.movements import LEFT, RIGHT, STRAIGHT, THROUGH, Approach, Movement

# Two connectors conflict if their centerlines come nearer than about a vehicle's width, metres.
_CONFLICT = 2.2


def conflicts(ids: Sequence[int], movements: Sequence[Movement], network: LaneNetwork) -> Bool[np.ndarray, "c c"]:
    """Return which pairs of connectors conflict, see `lines_meet`."""
    lines = [0.5 * (network.drafts[connector].left + network.drafts[connector].right) for connector in ids]
    return lines_meet(lines, [m.arm for m in movements], [m.source.vehicle for m in movements])


def lines_meet(
    lines: Sequence[Float[np.ndarray, "_ 2"]], arms: Sequence[int], vehicles: Sequence[bool]
) -> Bool[np.ndarray, "c c"]:
    """Return which pairs of connectors conflict.

    Connectors of one arm diverge and do not conflict, except a bicycle's with a vehicle's.

    Args:
        lines: their centerlines, metres, near the origin (distances are taken in float32); vertices evenly spaced.
        arms: from which each comes.
        vehicles: whether motor vehicles may use each.
    """
    vertices = [line[np.linspace(0, len(line) - 1, 15).round().astype(int)] for line in lines]
    points = np.stack(vertices).astype(np.float32)
    flat = points.reshape(-1, 2)
    square = ((flat[:, None] - flat[None]) ** 2).sum(-1)
    c = len(lines)
    near = square.reshape(c, 15, c, 15).min((1, 3)) < _CONFLICT**2
    arm, vehicle = np.array(arms), np.array(vehicles)
    return near & ((arm[:, None] != arm[None]) | (vehicle[:, None] != vehicle[None]))


def phases(approaches: Sequence[Approach]) -> list[int]:
    """Return the signal phase of each arm, see `phases_of`."""
    return phases_of([approach.heading for approach in approaches])


def phases_of(headings: Sequence[float]) -> list[int]:
    """Return the signal phase of each arm by its heading: arms that face each other are green together."""
    phase = [-1] * len(headings)
    following = 0
    for i, heading in enumerate(headings):
        if phase[i] >= 0:
            continue
        phase[i] = following
        for j in range(i + 1, len(headings)):
            facing = abs(float(wrap_angle(headings[j] - heading + np.pi))) < STRAIGHT
            if phase[j] < 0 and facing:
                phase[j] = following
                break
        following += 1
    return phase


def set_priorities(
    ids: Sequence[int],
    movements: Sequence[Movement],
    approaches: Sequence[Approach],
    network: LaneNetwork,
    intersection: int,
    signalised: bool,
) -> None:
    """Write right of way, and signal phases where there are signals, into the network.

    Of two conflicting connectors the one of higher rank has priority: major before minor arm, straight before right
    before left, then by arm. The order is strict, so it cannot cause a deadlock. At signals only connectors of the same
    phase yield to each other.
    """
    meet = conflicts(ids, movements, network)
    phase = phases(approaches)
    order = {THROUGH: 0, RIGHT: 1, LEFT: 2}
    ranks = [(0 if signalised else approaches[m.arm].minor, order[m.turn], m.arm) for m in movements]
    for a, connector in enumerate(ids):
        before = {
            ids[b]
            for b in np.flatnonzero(meet[a]).tolist()
            if ranks[b] < ranks[a] and (not signalised or phase[movements[a].arm] == phase[movements[b].arm])
        }
        if before:
            network.let_pass(connector, before)
        if signalised:
            network.signal_phase[connector] = (intersection, phase[movements[a].arm])

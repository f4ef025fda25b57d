"""Traffic lights and signs at intersections, each tied to the incoming lanes that it governs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tflane_jax.geometry import wrap_angle
from tflane_jax.scene.logs import MapElement
from tflane_jax.world.roads.curves import direction, right_of
from tflane_jax.world.roads.lane_network import LaneEnd
from tflane_jax.world.roads.movements import LEFT, RIGHT, STRAIGHT, THROUGH, Approach, Movement
from tflane_jax.world.roads.right_of_way import phases

LIGHT, SIGN = 1, 2
# OpenLane-V2 attributes of traffic elements.
RED, GREEN, YELLOW, GO_STRAIGHT, TURN_LEFT, TURN_RIGHT = 1, 2, 3, 4, 5, 6
NO_LEFT_TURN, NO_RIGHT_TURN, NO_U_TURN = 7, 8, 10
LIGHT_HEIGHT, _SIGN_HEIGHT = 5.5, 2.5


def traffic_lights(approaches: Sequence[Approach], green: int, beyond: float) -> list[MapElement]:
    """Return one light for each incoming vehicle lane, hanging over the far side of the intersection.

    Args:
        approaches: arms of the intersection.
        green: phase that is green at the start.
        beyond: distance from stop line to light, metres.
    """
    lights = []
    for approach, phase in zip(approaches, phases(approaches), strict=True):
        for lane in approach.incoming:
            if lane.vehicle:
                xy = lane.center + beyond * direction(lane.heading)
                state = GREEN if phase == green else RED
                lights.append(_element(xy, LIGHT_HEIGHT, lane, LIGHT, state, (lane.segment,)))
    return lights


def signs(approaches: Sequence[Approach], movements: Sequence[Movement], medians: Sequence[bool]) -> list[MapElement]:
    """Return the signs of an intersection.

    Above an incoming lane with a single allowed turn, on an arm that offers several: the sign of that turn. Beside the
    stop line: "no left turn" or "no right turn" where an arm on that side must not be entered, and "no U-turn" where
    the arm has a median.

    Args:
        approaches: arms of the intersection.
        movements: through it.
        medians: the arm has a raised median.
    """
    out = []
    only = {THROUGH: GO_STRAIGHT, LEFT: TURN_LEFT, RIGHT: TURN_RIGHT}
    for i, (approach, median) in enumerate(zip(approaches, medians, strict=True)):
        lanes = [lane for lane in approach.incoming if lane.vehicle]
        if not lanes:
            continue
        turns = {lane.segment: {m.turn for m in movements if m.source.segment == lane.segment} for lane in lanes}
        offered = set().union(*turns.values())
        if len(offered) > 1:
            for lane in lanes:
                if len(turns[lane.segment]) == 1:
                    attribute = only[next(iter(turns[lane.segment]))]
                    out.append(_element(lane.center, LIGHT_HEIGHT, lane, SIGN, attribute, (lane.segment,)))
        beside = lanes[-1].right + 1.2 * right_of(lanes[-1].heading)
        governed = tuple(lane.segment for lane in lanes)
        banned = _present(approaches, i) - offered
        for attribute in sorted(NO_LEFT_TURN if turn == LEFT else NO_RIGHT_TURN for turn in banned):
            out.append(_element(beside, _SIGN_HEIGHT, lanes[-1], SIGN, attribute, governed))
        if median:
            out.append(_element(beside, _SIGN_HEIGHT + 0.8, lanes[-1], SIGN, NO_U_TURN, governed))
    return out


def _present(approaches: Sequence[Approach], arm: int) -> set[int]:
    """Return on which sides, LEFT and RIGHT, other arms lie, whether they may be entered or not."""
    ahead = approaches[arm].heading + np.pi
    turns = [float(wrap_angle(other.heading - ahead)) for j, other in enumerate(approaches) if j != arm]
    return {LEFT if t > 0 else RIGHT for t in turns if abs(t) > STRAIGHT}


def _element(
    xy: np.ndarray, height: float, lane: LaneEnd, category: int, attribute: int, lanes: tuple[int, ...]
) -> MapElement:
    """Return an element that faces the traffic on `lane`."""
    return MapElement(np.array([*xy, height]), float(lane.heading + np.pi), category, attribute, lanes)

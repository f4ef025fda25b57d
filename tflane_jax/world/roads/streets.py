"""Streets: a reference line with the lanes of each direction laid out beside it, cut into lane segments.

The cross-section of each side is planned in `cross_sections`; here it becomes lines, segments and their successors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.errors import UserError
from tflane_jax.scene import LineType
from tflane_jax.world.roads.cross_sections import SAME_STATION, ExtraLane, Place, SidePlan
from tflane_jax.world.roads.curves import ReferenceLine, clothoid_line, grid_with
from tflane_jax.world.roads.lane_network import Draft, LaneEnd, LaneNetwork

# Smallest distance between two cuts, metres: it avoids very short segments.
_CLOSEST_CUTS = 6.0
# No street is shorter, and its median has room for round noses, metres.
_SHORTEST = 6.0
# No segment between cuts is shorter, metres.
_SHORTEST_SEGMENT = 1.0


@dataclass(frozen=True)
class StreetPlan:
    """A street before it is laid out.

    Attributes:
        origin, heading: the axis at s = 0; for the arm of a junction, the junction's side.
        start, stop: stations between which the street runs.
        bends: knots (station, curvature 1/m) of the axis.
        forward, backward: the side that drives towards increasing and decreasing stations.
        stops_at_start, stops_at_end: this end is at an intersection.
        speed: limit, m/s.
        ego: stations between which ego routes may run.
    """

    origin: Float[np.ndarray, "2"]
    heading: float
    start: float
    stop: float
    forward: SidePlan
    backward: SidePlan
    speed: float
    ego: tuple[float, float]
    bends: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    stops_at_start: bool = False
    stops_at_end: bool = False


@dataclass(frozen=True)
class Side:
    """One laid-out direction of travel; lines run in travel direction.

    Attributes:
        plan: its cross-section.
        line: the axis.
        entries, exits: lanes at the start and at the end, left to right.
        extra_segments: ids of each extra lane's first and last segment, in the order of `plan.extras`.
        kerb: (n,) distance from the axis.
        inner_edge: (n,) distance from the axis to the leftmost line.
    """

    plan: SidePlan
    line: ReferenceLine
    entries: tuple[LaneEnd, ...]
    exits: tuple[LaneEnd, ...]
    extra_segments: tuple[tuple[int, int], ...]
    kerb: Float[np.ndarray, " n"]
    inner_edge: Float[np.ndarray, " n"]

    @property
    def kerb_line(self) -> Float[np.ndarray, "n 2"]:
        """The kerb, in travel direction."""
        return self.line.offset(self.kerb)


@dataclass(frozen=True)
class Street:
    """A laid-out street: both directions along one axis."""

    plan: StreetPlan
    forward: Side
    backward: Side


def build_street(plan: StreetPlan, network: LaneNetwork, solid_before_stop: float, spacing: float) -> Street:
    """Lay out a street: add its lane segments to `network` and return its lines and lane ends.

    Args:
        plan: what to lay out.
        network: receives the segments.
        solid_before_stop: length of the solid divider before a stop line, metres.
        spacing: largest distance between vertices, metres.

    Raises UserError if intersections leave no room for it, or its extra lanes for segments between them.
    """
    length = plan.stop - plan.start
    least = _SHORTEST + plan.forward.inner + plan.backward.inner
    if length < least:
        raise UserError(
            f"roads: a street needs {least:.1f} m, and intersections leave {max(length, 0.0):.1f} m: raise reach or "
            "junction_distance, or lower corner_radius, crossing_width, wide_median or side_lean"
        )
    forward = plan.forward.over(length)
    backward = plan.backward.over(length)
    low, high = max(plan.ego[0] - plan.start, 0.0), min(plan.ego[1] - plan.start, length)
    solid_f = length - solid_before_stop if plan.stops_at_end else length
    solid_b = length - solid_before_stop if plan.stops_at_start else length
    cuts_f = _cuts(forward, length, (low, high), solid_f)
    cuts_b = _cuts(backward, length, (length - high, length - low), solid_b)
    for cuts in (cuts_f, cuts_b):
        if cuts[0] < 0.0 or cuts[-1] > length or np.diff(cuts).min() < _SHORTEST_SEGMENT:
            raise UserError(
                f"roads: turning, merging and opening lanes do not fit into a street of {length:.1f} m: lower pocket, "
                "taper, fast_taper or corner_radius, or raise reach or junction_distance"
            )
    stations = grid_with([*(plan.start + cuts_f), *(plan.stop - cuts_b)], spacing)
    line = clothoid_line(plan.origin, plan.heading, stations, plan.bends)
    onward = ReferenceLine(line.s - plan.start, line.xy, line.heading)
    return Street(
        plan,
        _build_side(forward, onward, cuts_f, (low, high), solid_f, plan.speed, network),
        _build_side(backward, line.backward(), cuts_b, (length - high, length - low), solid_b, plan.speed, network),
    )


def _cuts(plan: SidePlan, length: float, ego: tuple[float, float], solid: float) -> Float[np.ndarray, " k"]:
    """Return the distances at which a side is cut into segments: where markings or neighbours change."""
    if not plan.lanes:
        return np.array([0.0, length])
    fixed = {0.0, length}
    for extra in plan.extras:
        fixed |= {extra.start, extra.start + extra.forks, extra.stop - extra.merges, extra.stop}
    cuts = sorted(fixed)
    lanes = plan.lanes + len(plan.extras)
    for movable in (*((solid,) if lanes > 1 else ()), *ego):
        if 0.0 < movable < length and min(abs(movable - c) for c in cuts) > _CLOSEST_CUTS:
            cuts.append(movable)
    return np.array(sorted(cuts))


@dataclass
class _Column:
    """The boundaries of a lane along the whole side; arbitrary where the lane does not exist."""

    left: Float[np.ndarray, "n 2"]
    right: Float[np.ndarray, "n 2"]
    extra: ExtraLane | None


def _build_side(
    plan: SidePlan,
    line: ReferenceLine,
    cuts: Float[np.ndarray, " k"],
    ego: tuple[float, float],
    solid: float,
    speed: float,
    network: LaneNetwork,
) -> Side:
    """Lay out one direction; `cuts`, `ego` and `solid` are distances along it, as of `_cuts`."""
    presence = [extra.presence(line.s) for extra in plan.extras]
    taken = {
        place: plan.lane_width
        * sum((p for p, e in zip(presence, plan.extras, strict=True) if e.place is place), np.zeros(len(line.s)))
        for place in Place
    }
    shift = taken[Place.LEFT]
    kerb = plan.kerb(shift + taken[Place.RIGHT])
    inner_edge = plan.inner - taken[Place.MEDIAN]
    if not plan.lanes:
        return Side(plan, line, (), (), (), kerb, inner_edge)

    columns = _columns(plan, line, presence, shift)
    bounds = np.searchsorted(line.s, cuts - SAME_STATION)
    rows = _add_sections(plan, columns, line.s, bounds, ego, solid, speed, network)
    bikes: list[int] = []
    if plan.bike:
        edge = plan.outer + shift + taken[Place.RIGHT]
        bikes = [_add_bike_lane(line.offset(edge), line.offset(edge + plan.bike), speed, network)]

    def ends(row: dict[int, int]) -> list[tuple[int, int]]:
        order = sorted(row, key=lambda i: _rank(i, columns[i].extra))
        return [(row[i], _pocket(columns[i].extra)) for i in order] + [(b, 0) for b in bikes]

    extras = range(plan.lanes, len(columns))
    return Side(
        plan,
        line,
        tuple(network.start_of(i, line.heading[0]) for i, _ in ends(rows[0])),
        tuple(network.end_of(i, line.heading[-1], pocket) for i, pocket in ends(rows[-1])),
        tuple((min(r[i] for r in rows if i in r), max(r[i] for r in rows if i in r)) for i in extras),
        kerb,
        inner_edge,
    )


def _columns(
    plan: SidePlan,
    line: ReferenceLine,
    presence: Sequence[Float[np.ndarray, " n"]],
    shift: Float[np.ndarray, " n"],
) -> list[_Column]:
    """Return the lanes of a side, left to right, then its extra lanes.

    Args:
        presence: for each extra lane its width as a fraction of a lane's.
        shift: metres by which lanes on the left push the others outwards.
    """
    w = plan.lane_width
    dividers = line.offset(plan.inner + w * np.arange(plan.lanes + 1)[:, None] + shift)
    columns = [_Column(a, b, None) for a, b in pairwise(dividers)]
    for extra, fraction in zip(plan.extras, presence, strict=True):
        # Where fraction = 1 the boundary is bit-identical to the neighbour's.
        if extra.place is Place.RIGHT:
            left, right = plan.outer + shift - w * (1.0 - fraction), plan.outer + shift + w * fraction
        else:
            left, right = plan.inner + shift - w * fraction, plan.inner + shift + w * (1.0 - fraction)
        columns.append(_Column(line.offset(left), line.offset(right), extra))
    return columns


def _add_sections(
    plan: SidePlan,
    columns: Sequence[_Column],
    stations: Float[np.ndarray, " n"],
    bounds: Int[np.ndarray, " k"],
    ego: tuple[float, float],
    solid: float,
    speed: float,
    network: LaneNetwork,
) -> list[dict[int, int]]:
    """Add a side's segments, cut at the vertices `bounds`, and connect them; return for each section column -> id."""
    rows = []
    for a, b in pairwise(bounds.tolist()):
        middle = 0.5 * float(stations[a] + stations[b])
        present = [i for i, c in enumerate(columns) if c.extra is None or c.extra.start < middle < c.extra.stop]
        order = sorted(present, key=lambda i: _rank(i, columns[i].extra))
        row = {}
        for place, i in enumerate(order):
            row[i] = network.add(
                Draft(
                    columns[i].left[a : b + 1],
                    columns[i].right[a : b + 1],
                    _marking(plan, columns, order, place - 1, middle, solid),
                    _marking(plan, columns, order, place, middle, solid),
                    speed,
                    vehicle=True,
                    is_intersection=False,
                    ego=ego[0] <= middle <= ego[1],
                )
            )
        rows.append(row)
    _connect_sections(plan, rows, stations[bounds], network)
    return rows


def _add_bike_lane(
    left: Float[np.ndarray, "n 2"], right: Float[np.ndarray, "n 2"], speed: float, network: LaneNetwork
) -> int:
    solid = LineType.SOLID
    return network.add(Draft(left, right, solid, solid, speed, vehicle=False, is_intersection=False, ego=False))


def _rank(column: int, extra: ExtraLane | None) -> int:
    """Order columns from left to right."""
    if extra is None:
        return column
    return 10_000 if extra.place is Place.RIGHT else -1


def _pocket(extra: ExtraLane | None) -> int:
    if extra is None or not extra.forks:
        return 0
    return 1 if extra.place is Place.RIGHT else -1


def _marking(
    plan: SidePlan, columns: Sequence[_Column], order: Sequence[int], place: int, middle: float, solid: float
) -> LineType:
    """Return the marking between the columns at `place` and `place + 1` of a section."""
    if place < 0:
        return plan.inner_marking
    if place + 1 >= len(order):
        return plan.outer_marking
    for i in order[place : place + 2]:
        extra = columns[i].extra
        if extra and (middle < extra.start + extra.forks or middle > extra.stop - extra.merges):
            return LineType.NONE  # the two lanes overlap along the taper
    if plan.divider_marking is LineType.NONE:
        return LineType.NONE
    return LineType.SOLID if middle > solid else plan.divider_marking


def _connect_sections(
    plan: SidePlan, rows: Sequence[dict[int, int]], bounds: Float[np.ndarray, " k"], network: LaneNetwork
) -> None:
    """Connect each section's lanes to the next section's: straight on, forks and merges."""
    for row, following, joint in zip(rows[:-1], rows[1:], bounds[1:-1], strict=True):
        for i in row:
            if i in following:
                network.connect(row[i], following[i])
        for k, extra in enumerate(plan.extras):
            i, neighbour = plan.lanes + k, plan.lanes - 1 if extra.place is Place.RIGHT else 0
            if extra.forks and abs(extra.start - joint) < SAME_STATION:
                network.weld(row[neighbour], following[i], keep=row[neighbour])
            if extra.merges and abs(extra.stop - joint) < SAME_STATION:
                network.weld(row[i], following[neighbour], keep=following[neighbour])
                network.let_pass(row[i], {row[neighbour]})

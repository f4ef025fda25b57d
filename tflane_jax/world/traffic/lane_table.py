"""A road network as flat arrays for driving simulation: geometry by station, speeds, and where lanes conflict."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import wrap_angle
from tflane_jax.scene.logs import LaneSegment
from tflane_jax.world.roads.networks import RoadNetwork

# Distance between samples of a centerline, metres.
_SPACING = 2.0
# Vehicles on two lanes nearer to each other than this obstruct each other, metres; bicycles need less room.
_REACH, _BIKE_REACH = 2.5, 1.5
# Nearby lanes whose directions differ by less than acos of this fork or merge; others cross.
_TOGETHER = 0.75
# Comfortable lateral acceleration in curves and braking before them, m/s^2.
_COMFORTABLE_LATERAL, COMFORTABLE_BRAKING = 2.2, 1.6
# Most lanes that may lie beside one vertex.
_PARTNERS = 4


@dataclass(frozen=True)
class LaneTable:
    """S lane segments sampled at V vertices; a place is (segment index, station along the centerline in metres).

    Attributes:
        ids: (S,) segment ids; everything else refers to segments by their index here.
        successors: segment indices for each segment.
        vehicle: (S,) open to motor vehicles.
        length: (S,) metres.
        speed_at_start: (S,) speed with which a segment may be entered, m/s.
        turn: (S,) absolute change of heading, radians.
        station: (S,) position of each segment's start on the common axis.
        axis: (V,) position of each vertex on the common axis: segments one after another, with gaps; increasing.
        xy, heading, speed: (V, ...) metres, radians (unwrapped in a segment), and the speed at which a driver may pass
            so that all curves ahead in the segment are reached at a comfortable speed, m/s.
        first_vertex: (S,) index of a segment's first vertex.
        step: (S,) distance between its vertices.
        beside: (V, Q) segments so close beside the vertex's own that their traffic obstructs it; -1 pads.
        beside_station: (V, Q) the nearest station on it.
        crosses: (S, S) [i, j] traffic must not enter i while there is traffic on j.
        clear_after: (S, S) [i, j] station of j beyond which the rear of that traffic leaves i free.
        yields: (S, S) [i, j] traffic entering i yields to traffic approaching on j.
        merges_into: (S,) parallel segment into which a lane merges; -1 for none.
        intersection, phase: (S,) of the signal that governs the entry; -1 for none.
    """

    ids: Int[np.ndarray, " s"]
    successors: tuple[tuple[int, ...], ...]
    vehicle: Bool[np.ndarray, " s"]
    length: Float[np.ndarray, " s"]
    speed_at_start: Float[np.ndarray, " s"]
    turn: Float[np.ndarray, " s"]
    station: Float[np.ndarray, " s"]
    axis: Float[np.ndarray, " v"]
    xy: Float[np.ndarray, "v 2"]
    heading: Float[np.ndarray, " v"]
    speed: Float[np.ndarray, " v"]
    first_vertex: Int[np.ndarray, " s"]
    step: Float[np.ndarray, " s"]
    beside: Int[np.ndarray, "v q"]
    beside_station: Float[np.ndarray, "v q"]
    crosses: Bool[np.ndarray, "s s"]
    clear_after: Float[np.ndarray, "s s"]
    yields: Bool[np.ndarray, "s s"]
    merges_into: Int[np.ndarray, " s"]
    intersection: Int[np.ndarray, " s"]
    phase: Int[np.ndarray, " s"]

    @cached_property
    def is_gate(self) -> Bool[np.ndarray, " s"]:
        """(S,) segments before which a driver must check signals or priority."""
        return (self.intersection >= 0) | self.yields.any(1) | self.crosses.any(1)

    def vertex(self, segment: Int[np.ndarray, "*b"], s: Float[np.ndarray, "*b"]) -> Int[np.ndarray, "*b"]:
        """Return the vertex nearest to a place."""
        within = np.clip(s, 0.0, self.length[segment]) / self.step[segment]
        return self.first_vertex[segment] + np.rint(within).astype(np.intp)

    def locate(
        self, segment: Int[np.ndarray, "*b"], s: Float[np.ndarray, "*b"]
    ) -> tuple[Float[np.ndarray, "*b 2"], Float[np.ndarray, "*b"]]:
        """Return position and heading of a place; the segment is extended straight beyond its ends."""
        inside = np.clip(s, 0.0, self.length[segment])
        at = self.station[segment] + inside
        heading = np.interp(at, self.axis, self.heading)
        beyond = s - inside
        x = np.interp(at, self.axis, self.xy[:, 0]) + beyond * np.cos(heading)
        y = np.interp(at, self.axis, self.xy[:, 1]) + beyond * np.sin(heading)
        return np.stack([x, y], -1), heading


def build_lane_table(network: RoadNetwork) -> LaneTable:
    """Flatten a road network."""
    segments = list(network.traffic_lanes.values())
    index = {segment.id: i for i, segment in enumerate(segments)}
    ids = np.array([segment.id for segment in segments], np.int64)
    xy, length, count = _sample([segment.centerline[:, :2] for segment in segments])
    owner = np.repeat(np.arange(len(segments)), count)
    first = np.cumsum(count) - count
    step = length / (count - 1)
    own_station = (np.arange(len(owner)) - first[owner]) * step[owner]
    # The gap separates the end of a segment from the start of the next on the axis.
    station = np.cumsum(length + 1.0) - length - 1.0
    heading = _headings(xy, owner, first, count)
    limit = np.array([network.speed_limit[segment.id] for segment in segments])
    speed = _comfortable_speed(heading, own_station, owner, step, limit)

    successors = tuple(tuple(index[j] for j in segment.successors if j in index) for segment in segments)
    vehicle = np.array([segment.vehicle for segment in segments], bool)
    beside, beside_station, crosses, clear_after = _conflicts(xy, heading, own_station, owner, successors, vehicle)
    yields, merges_into = _priorities(network, segments, index)
    _share_exits(segments, successors, length, yields, crosses, clear_after)
    signals = [network.signal_phase.get(segment.id, (-1, -1)) for segment in segments]
    intersection, phase = np.array(signals, np.int64).reshape(-1, 2).T
    return LaneTable(
        ids=ids,
        successors=successors,
        vehicle=vehicle,
        length=length,
        speed_at_start=speed[first],
        turn=np.abs(heading[first + count - 1] - heading[first]),
        station=station,
        axis=station[owner] + own_station,
        xy=xy,
        heading=heading,
        speed=speed,
        first_vertex=first,
        step=step,
        beside=beside,
        beside_station=beside_station,
        crosses=crosses,
        clear_after=clear_after,
        yields=yields,
        merges_into=merges_into,
        intersection=intersection,
        phase=phase,
    )


def _sample(
    lines: list[Float[np.ndarray, "_ 2"]],
) -> tuple[Float[np.ndarray, "v 2"], Float[np.ndarray, " s"], Int[np.ndarray, " s"]]:
    """Return all lines sampled evenly about `_SPACING` apart, their lengths and their numbers of samples."""
    size = np.array([len(line) for line in lines])
    points = np.concatenate(lines)
    last = np.cumsum(size) - 1
    steps = np.hypot(*np.diff(points, axis=0).T)
    steps[last[:-1]] = 1.0  # a gap between lines, so that distances along them never coincide
    along = np.concatenate([[0.0], np.cumsum(steps)])
    start, stop = along[last - size + 1], along[last]
    length = stop - start
    count = np.maximum(np.ceil(length / _SPACING).astype(int), 1) + 1
    owner = np.repeat(np.arange(len(lines)), count)
    fraction = (np.arange(len(owner)) - (np.cumsum(count) - count)[owner]) / (count - 1)[owner]
    at = start[owner] + fraction * length[owner]
    return np.stack([np.interp(at, along, points[:, i]) for i in range(2)], -1), length, count


def _headings(
    xy: Float[np.ndarray, "v 2"],
    owner: Int[np.ndarray, " v"],
    first: Int[np.ndarray, " s"],
    count: Int[np.ndarray, " s"],
) -> Float[np.ndarray, " v"]:
    """Return the direction at each vertex, continuous along a segment: the mean of the chords that meet there."""
    chord = np.arctan2(*np.diff(xy, axis=0).T[::-1])
    inner = owner[1:] == owner[:-1]
    before = np.concatenate([[0.0], np.where(inner, chord, 0.0)])
    after = np.concatenate([np.where(inner, chord, 0.0), [0.0]])
    ends = first + count - 1
    before[first], after[ends] = after[first], before[ends]
    bend = wrap_angle(after - before)
    heading = before + 0.5 * bend
    # End chords point half a step's turn off the tangent: continue the bend of the next vertex.
    if len(xy) > 2:
        inside = count > 2
        heading[first[inside]] -= 0.5 * bend[first[inside] + 1]
        heading[ends[inside]] += 0.5 * bend[ends[inside] - 1]
    turn = np.diff(heading, prepend=heading[0])
    turn = wrap_angle(turn)
    turn[first] = 0.0
    total = np.cumsum(turn)
    return heading[first][owner] + total - total[first][owner]


def _comfortable_speed(
    heading: Float[np.ndarray, " v"],
    s: Float[np.ndarray, " v"],
    owner: Int[np.ndarray, " v"],
    step: Float[np.ndarray, " s"],
    limit: Float[np.ndarray, " s"],
) -> Float[np.ndarray, " v"]:
    """Return the speed that keeps lateral acceleration and the braking for curves ahead comfortable."""
    turn = np.abs(np.diff(heading)) * (owner[1:] == owner[:-1])
    sharpest = np.maximum(np.concatenate([[0.0], turn]), np.concatenate([turn, [0.0]])) / step[owner]
    square = np.minimum(limit[owner] ** 2, _COMFORTABLE_LATERAL / np.maximum(sharpest, 1e-6))
    # v(s)^2 <= v(s')^2 + 2 b (s' - s) for all s' ahead. An offset per segment keeps the running minimum from the back
    # within each segment.
    lift = 1e6 * owner
    braking = 2.0 * COMFORTABLE_BRAKING * s
    ahead = np.minimum.accumulate((square + braking + lift)[::-1])[::-1]
    return np.sqrt(ahead - lift - braking)


def _conflicts(
    xy: Float[np.ndarray, "v 2"],
    heading: Float[np.ndarray, " v"],
    s: Float[np.ndarray, " v"],
    owner: Int[np.ndarray, " v"],
    successors: tuple[tuple[int, ...], ...],
    vehicle: Bool[np.ndarray, " s"],
) -> tuple[Int[np.ndarray, "v q"], Float[np.ndarray, "v q"], Bool[np.ndarray, "s s"], Float[np.ndarray, "s s"]]:
    """Return `beside`, `beside_station`, `crosses` and `clear_after` of `LaneTable`."""
    from scipy.spatial import KDTree

    count = len(vehicle)
    follows = np.zeros((count, count), bool)
    for i, following in enumerate(successors):
        follows[i, list(following)] = True
    follows |= follows.T | np.eye(count, dtype=bool)
    pairs = KDTree(xy).query_pairs(_REACH, output_type="ndarray")
    pairs = pairs[~follows[owner[pairs[:, 0]], owner[pairs[:, 1]]]]
    p, q = np.concatenate([pairs, pairs[:, ::-1]]).T
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    between = xy[p] - xy[q]
    distance = np.hypot(*between.T)
    together = (ahead[p] * ahead[q]).sum(-1) > _TOGETHER

    crosses = np.zeros((count, count), bool)
    clear_after = np.zeros((count, count))
    crosses[owner[q][~together], owner[p][~together]] = True
    np.maximum.at(clear_after, (owner[q][~together], owner[p][~together]), s[p][~together])

    both = vehicle[owner[p]] & vehicle[owner[q]]
    near = together & (both | (distance < _BIKE_REACH))
    p, q, between, distance = p[near], q[near], between[near], distance[near]
    order = np.lexsort((q, distance, owner[q], p))
    p, q, between = p[order], q[order], between[order]
    nearest = np.ones(len(p), bool)
    nearest[1:] = (p[1:] != p[:-1]) | (owner[q][1:] != owner[q][:-1])
    p, q, between = p[nearest], q[nearest], between[nearest]
    slot = np.arange(len(p)) - np.searchsorted(p, p, side="left")
    fits = slot < _PARTNERS
    p, q, between, slot = p[fits], q[fits], between[fits], slot[fits]
    beside = np.full((len(xy), _PARTNERS), -1)
    beside_station = np.zeros((len(xy), _PARTNERS))
    beside[p, slot] = owner[q]
    beside_station[p, slot] = s[q] + (between * ahead[q]).sum(-1)
    return beside, beside_station, crosses, clear_after


def _priorities(
    network: RoadNetwork, segments: list[LaneSegment], index: dict[int, int]
) -> tuple[Bool[np.ndarray, "s s"], Int[np.ndarray, " s"]]:
    """Return `yields` and `merges_into`: yielding means waiting at an intersection and merging elsewhere."""
    yields = np.zeros((len(segments), len(segments)), bool)
    merges_into = np.full(len(segments), -1)
    for segment, others in network.yield_to.items():
        i = index[segment]
        if segments[i].is_intersection:
            yields[i, [index[j] for j in others]] = True
        else:
            merges_into[i] = index[others[0]]
    return yields, merges_into


def _share_exits(
    segments: list[LaneSegment],
    successors: tuple[tuple[int, ...], ...],
    length: Float[np.ndarray, " s"],
    yields: Bool[np.ndarray, "s s"],
    crosses: Bool[np.ndarray, "s s"],
    clear_after: Float[np.ndarray, "s s"],
) -> None:
    """Make connectors into one lane exclude each other, except that priority traffic does not stop."""
    into: dict[int, list[int]] = {}
    for i, following in enumerate(successors):
        if segments[i].is_intersection:
            for j in following:
                into.setdefault(j, []).append(i)
    for rivals in into.values():
        for a in rivals:
            for b in rivals:
                if a != b and not yields[b, a]:
                    crosses[a, b] = True
                    clear_after[a, b] = max(clear_after[a, b], length[b] - 1.0)

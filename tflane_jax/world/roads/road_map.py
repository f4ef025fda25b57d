"""A recorded map for the built-in world: what a reader must hand over, and its lanes as traffic uses them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import line_lengths, without_repeats
from tflane_jax.scene.logs import LaneSegment, Side, VectorMap

# Lanes shorter than this carry no traffic, metres.
_SHORTEST = 0.5
# Two lanes are oncoming if the cosine of their directions is below this; lanes are compared every so many metres, with
# others up to this far beside them.
_OPPOSED, _EVERY, _BESIDE = -0.9, 4.0, 25.0


@dataclass(frozen=True, eq=False)
class RoadMap:
    """A recorded map and where it is complete.

    Attributes:
        name: unique among the maps of a folder: the name of the log.
        source: dataset name.
        map: global metres; heights are ignored. `road_boundaries` may run in either direction.
        places: (n, 2) where a vehicle drove or could drive, metres.
        complete: distance from each place up to which every lane is in the map, metres.
        parked: (p, 3) x, y, yaw of places where vehicles were seen parked.
        area: place, such as a city, in whose coordinates the map is; "" if it is unknown.
    """

    name: str
    source: str
    map: VectorMap
    places: Float[np.ndarray, "n 2"]
    complete: float
    parked: Float[np.ndarray, "p 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    area: str = ""


def drives_on_left(found: VectorMap) -> bool:
    """Return whether traffic keeps to the left; where nothing tells, it keeps to the right."""
    return driving_side(found) == "left"


def driving_side(found: VectorMap) -> Side | None:
    """Return the side on which traffic keeps: opposite to that of most oncoming lanes.

    For every few metres of lane the nearest oncoming lane counts, if one is near. Without any, as in a map of one-way
    streets alone, it is what the source of the map tells; None where that is nothing.
    """
    lanes = [lane for lane in found.segments.values() if not lane.is_intersection and lane.vehicle]
    lines = [lane.centerline[:, :2] for lane in lanes if line_lengths(lane.centerline) >= _SHORTEST]
    if not lines:
        return found.side
    at, ahead = (np.concatenate(parts) for parts in zip(*map(_directed, lines), strict=True))
    oncoming = 0
    for place, heading in zip(at, ahead, strict=True):
        step = at - place
        along, left = np.abs(step @ heading), heading[0] * step[:, 1] - heading[1] * step[:, 0]
        beside = (ahead @ heading < _OPPOSED) & (along < _EVERY) & (np.abs(left) > 1.0) & (np.abs(left) < _BESIDE)
        if beside.any():
            oncoming += int(np.sign(left[beside][np.abs(left[beside]).argmin()]))
    return ("right" if oncoming > 0 else "left") if oncoming else found.side


def _directed(line: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Return points of a line, some metres apart, and its directions there."""
    step = np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=-1)
    ends = np.cumsum(length)
    wanted = np.arange(0.5 * min(_EVERY, ends[-1]), ends[-1], _EVERY)
    k = np.searchsorted(ends, wanted)
    ahead = step[k] / length[k, None]
    return line[k + 1] - (ends[k] - wanted)[:, None] * ahead, ahead


def traffic_lanes(segments: dict[int, LaneSegment]) -> dict[int, LaneSegment]:
    """Return lanes joined over every one-to-one joint at which neither intersection nor kind of vehicle changes.

    A lane has the id of its first segment, and keeps only its centerline: `left` and `right` are the same line. Motor
    vehicles do not turn into bike lanes. Traffic decides at starts of lanes, so there should be no more than needed.
    """
    usable = {i: s for i, s in segments.items() if line_lengths(s.centerline) >= _SHORTEST}
    onward = {
        i: tuple(j for j in s.successors if j in usable and (usable[j].vehicle or not s.vehicle))
        for i, s in usable.items()
    }
    entries: dict[int, int] = {}
    for following in onward.values():
        for j in following:
            entries[j] = entries.get(j, 0) + 1

    def same(i: int, j: int) -> bool:
        a, b = usable[i], usable[j]
        return a.is_intersection == b.is_intersection and a.vehicle == b.vehicle

    next_of = {i: f[0] for i, f in onward.items() if len(f) == 1 and entries[f[0]] == 1 and same(i, f[0])}
    followed = set(next_of.values())
    lanes: dict[int, LaneSegment] = {}
    walked: set[int] = set()
    # The heads of chains first; what they do not reach lies on closed loops.
    for head in sorted(usable, key=lambda i: i in followed):
        if head in walked:
            continue
        chain = [head]
        while (step := next_of.get(chain[-1])) is not None and step != head:
            chain.append(step)
        walked.update(chain)
        line = _joined([usable[i].centerline[:, :2] for i in chain])
        first = usable[head]
        lanes[head] = LaneSegment(
            id=head,
            centerline=line,
            left=line,
            right=line,
            left_type=first.left_type,
            right_type=first.right_type,
            is_intersection=first.is_intersection,
            successors=onward[chain[-1]],
            vehicle=first.vehicle,
        )
    return lanes


def _joined(lines: list[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "n 3"]:
    """Return lines in succession on the plane z = 0, without points that repeat the one before."""
    return np.pad(without_repeats(np.concatenate(lines), 1e-3), ((0, 0), (0, 1)))

"""Road paint of a map as quadrilaterals with wear: lines, crossings, stop lines, arrows.

Global metres. Line types are those of the map. A solid line between opposite directions is double, and may be yellow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry.polylines import arc_length, sample_at
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.bev.map_samples import DASH, DASH_PERIOD, line_key, painted_lines
from tflane_jax.world.bev.sensor import paint_left
from tflane_jax.world.roads.road_map import drives_on_left

WHITE, YELLOW = (0.86, 0.86, 0.84), (0.84, 0.66, 0.2)
# Length of pieces with a constant wear, widths of lines and stop lines, metres.
_PIECE, _WIDTH, _STOP_WIDTH = 1.5, 0.13, 0.4
# Offset of each line of a double line from their common middle, metres.
_DOUBLE = 0.11
# Bars of a crossing and their spacing, metres.
_BAR, _BAR_PERIOD = 0.45, 0.95
_ARROW_BACK, _ARROW_EARLIER = 7.0, 24.0
# Connectors that bend by more than this are turns, radians.
_TURN = np.deg2rad(30.0)
_SHAFT = np.array([[-2.0, -0.09], [1.0, -0.09], [1.0, 0.09], [-2.0, 0.09]])
_STRAIGHT_HEAD = np.array([[0.9, -0.36], [2.1, 0.0], [0.9, 0.36]])
_LEFT_HEAD = np.array([[0.75, 0.62], [-0.2, 0.62], [0.3, 1.15]])
_LEFT_ARM = np.array([[-0.5, 0.0], [0.1, 0.0], [0.5, 0.65], [0.05, 0.65]])


@dataclass(frozen=True)
class Paint:
    """N painted quadrilaterals.

    Attributes:
        corners: (N, 4, 2) global metres; the first edge and the third are the long ones of lines.
        width, length: (N,) metres.
        colour: (N, 3) display values 0 to 1.
        left: (N,) 0 to 1, remaining fraction of the paint.
    """

    corners: Float[np.ndarray, "n 4 2"]
    width: Float[np.ndarray, " n"]
    length: Float[np.ndarray, " n"]
    colour: Float[np.ndarray, "n 3"]
    left: Float[np.ndarray, " n"]


def paint_of(rng: np.random.Generator, vector_map: VectorMap, *, paint_wear: float, log_seed: int) -> Paint:
    """Return all paint on the roads.

    Args:
        rng: stream of the scene's style: yellow or white between directions, bars or lines at crossings, arrows.
        vector_map: with its lanes, crossings and elements.
        paint_wear: 0 (fresh) to 1 (gone).
        log_seed: seed of the log's wear, the same as in the BEV sensor.
    """
    yellow, zebra, arrows = rng.random() < 0.65, rng.random() < 0.75, rng.random() < 0.8
    parts = [
        _lines(vector_map, yellow, paint_wear, log_seed),
        *(_crossing(ring[:, :2], zebra) for ring in vector_map.crossings),
        *_at_lane_ends(vector_map, arrows),
    ]
    worn = 1.0 - 0.8 * paint_wear * rng.random(len(parts) - 1)
    parts[1:] = [replace(part, left=part.left * float(left)) for part, left in zip(parts[1:], worn, strict=True)]
    return Paint(*(np.concatenate([getattr(part, name) for part in parts]) for name in Paint.__dataclass_fields__))


def _lines(vector_map: VectorMap, yellow: bool, paint_wear: float, log_seed: int) -> Paint:
    # The inner boundary of a lane is that on the side of oncoming traffic.
    inner: dict[tuple[float, ...], int] = {}
    shared: dict[tuple[float, ...], int] = {}
    on_left = drives_on_left(vector_map)
    for segment in vector_map.segments.values():
        for line, is_inner in ((segment.left, not on_left), (segment.right, on_left)):
            if len(line) > 1:
                key = line_key(line)
                inner[key] = inner.get(key, 0) + is_inner
                shared[key] = shared.get(key, 0) + 1
    lines = painted_lines(vector_map)
    middles, widths, lengths, normals, colours, numbers, stations = [], [], [], [], [], [], []
    for number, (line, kind) in enumerate(lines):
        total = float(arc_length(line)[-1])
        start, stop = _pieces(total, LineType(kind))
        if not len(start):
            continue
        ends = sample_at(line, np.concatenate([start, stop]))[:, :2].reshape(2, -1, 2)
        step = ends[1] - ends[0]
        length = np.maximum(np.linalg.norm(step, axis=-1), 1e-6)
        normal = np.stack([-step[:, 1], step[:, 0]], -1) / length[:, None]
        key = line_key(line)
        # Inner boundary of two lanes: divides opposite directions. Inner boundary of one lane alone: a median's edge.
        center, edge = inner[key] == 2, inner[key] == 1 and shared[key] == 1
        offsets = (-_DOUBLE, _DOUBLE) if center and kind == LineType.SOLID else (0.0,)
        for offset in offsets:
            middles.append(ends + offset * normal)
            widths.append(np.full(len(length), _WIDTH))
            lengths.append(length)
            normals.append(normal)
            colours.append(np.tile(YELLOW if yellow and (center or edge) else WHITE, (len(length), 1)))
            numbers.append(np.full(len(length), number))
            stations.append(0.5 * (start + stop))
    if not middles:
        return _quads(np.zeros((2, 0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))
    number = np.concatenate(numbers)
    quads = _quads(np.concatenate(middles, 1), np.concatenate(normals), np.concatenate(widths), np.concatenate(colours))
    return replace(quads, left=paint_left(number, np.concatenate(stations), len(lines), paint_wear, log_seed))


def _pieces(total: float, kind: LineType) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return where along a line pieces start and stop; dashes are placed as in `map_samples`."""
    if kind == LineType.DASHED:
        first = (total / 2 - DASH / 2) % DASH_PERIOD - DASH_PERIOD
        start = np.arange(first, total, DASH_PERIOD)
        start, stop = np.maximum(start, 0.0), np.minimum(start + DASH, total)
        keep = stop - start > 0.3
        start, stop = start[keep], stop[keep]
        return np.concatenate([start, 0.5 * (start + stop)]), np.concatenate([0.5 * (start + stop), stop])
    knots = np.linspace(0.0, total, max(int(np.ceil(total / _PIECE)), 1) + 1)
    return knots[:-1], knots[1:]


def _quads(
    ends: Float[np.ndarray, "2 n 2"],
    normal: Float[np.ndarray, "n 2"],
    width: Float[np.ndarray, " n"],
    colour: Float[np.ndarray, "n 3"],
) -> Paint:
    """Return pieces of lines: `ends` of their middle lines, unit normals, and widths."""
    side = 0.5 * width[:, None] * normal
    corners = np.stack([ends[0] - side, ends[1] - side, ends[1] + side, ends[0] + side], 1)
    length = np.linalg.norm(ends[1] - ends[0], axis=-1)
    return Paint(corners, width, length, colour, np.ones(len(width)))


def _strips(start: np.ndarray, stop: np.ndarray, width: float) -> Paint:
    """Return white strips between points (n, 2)."""
    step = stop - start
    normal = np.stack([-step[:, 1], step[:, 0]], -1) / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-6)
    return _quads(np.stack([start, stop]), normal, np.full(len(start), width), np.tile(WHITE, (len(start), 1)))


def _crossing(ring: Float[np.ndarray, "_ 2"], zebra: bool) -> Paint:
    """Return bars along the road, or one line along each side of the crossing."""
    a0, a1, b1, b0 = ring[:4]
    if not zebra:
        return _strips(np.stack([a0, b0]), np.stack([a1, b1]), 0.3)
    across = float(np.linalg.norm(a1 - a0))
    count = max(int(across / _BAR_PERIOD), 1)
    fraction = ((np.arange(count) + 0.5) / count)[:, None]
    return _strips(a0 + fraction * (a1 - a0), b0 + fraction * (b1 - b0), _BAR)


def _at_lane_ends(vector_map: VectorMap, arrows: bool) -> list[Paint]:
    """Return stop lines before traffic lights, and arrows on lanes with a choice of turns."""
    lit = {lane for element in vector_map.elements if element.category == 1 for lane in element.lanes}
    parts = []
    for segment in vector_map.segments.values():
        onward = [vector_map.segments[j] for j in segment.successors if j in vector_map.segments]
        if segment.is_intersection or not segment.vehicle or not any(s.is_intersection for s in onward):
            continue
        if segment.id in lit:
            left, right = segment.left[-1:, :2], segment.right[-1:, :2]
            inward = 0.04 * (right - left)
            parts.append(_strips(left + inward, right - inward, _STOP_WIDTH))
        if arrows and segment.id in lit:
            parts += _arrows(segment, {_turn(s) for s in onward if s.vehicle})
    return parts


def _turn(segment: LaneSegment) -> int:
    """Return 1 for a segment that turns left, -1 for right, 0 for neither."""
    line = segment.centerline[:, :2]
    first, last = line[1] - line[0], line[-1] - line[-2]
    angle = np.arctan2(first[0] * last[1] - first[1] * last[0], (first * last).sum())
    return int(np.sign(angle)) if abs(angle) > _TURN else 0


def _arrows(segment: LaneSegment, turns: set[int]) -> list[Paint]:
    total = float(arc_length(segment.centerline)[-1])
    shapes = [_SHAFT]
    shapes += [_STRAIGHT_HEAD] if 0 in turns else []
    for turn in (1, -1):
        if turn in turns:
            shapes += [shape * [1.0, turn] for shape in (_LEFT_ARM, _LEFT_HEAD)]
    parts = []
    for back in (_ARROW_BACK, _ARROW_EARLIER):
        if total < back + 4.0:
            continue
        (here, ahead) = sample_at(segment.centerline, np.array([total - back, total - back + 0.5]))[:, :2]
        u = (ahead - here) / np.linalg.norm(ahead - here)
        turned = [here + shape @ np.array([u, [-u[1], u[0]]]) for shape in shapes]
        corners = np.stack([ring if len(ring) == 4 else np.concatenate([ring, ring[-1:]]) for ring in turned])
        wide = np.full(len(corners), 0.5)
        parts.append(Paint(corners, wide, wide, np.tile(WHITE, (len(corners), 1)), np.ones(len(corners))))
    return parts

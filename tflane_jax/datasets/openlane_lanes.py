"""The lanes of a whole OpenLane-V2 segment: what its frames annotate, joined in the frame of their poses.

A frame annotates only what lies within 50 m ahead and 25 m to the side. Lanes keep their id over a segment, so the
pieces of one id are joined where they overlap, and edges between lanes are those of any frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import line_distances, line_lengths, transform_points
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment

# Metres: points of two pieces nearer than this are on one lane; an edge joins an end and a start nearer than this.
_SAME, _JOINED = 0.5, 2.0
# Metres between the points that are kept of a line.
_SPACING = 1.0


@dataclass(frozen=True)
class FrameLanes:
    """The N lanes that one frame annotates.

    Attributes:
        global_from_ego: (4, 4) float64.
        ids: of the lanes.
        lines: N centerlines (n, 3), ego frame, metres.
        is_connector: (N,).
        successor: (N, N) [i, j] the end of lane i is the start of lane j.
    """

    global_from_ego: Float[np.ndarray, "4 4"]
    ids: list[str]
    lines: list[Float[np.ndarray, "_ 3"]]
    is_connector: Bool[np.ndarray, " n"]
    successor: Bool[np.ndarray, "n n"]


def segment_lanes(frames: Iterable[FrameLanes], width: float) -> dict[int, LaneSegment]:
    """Return the lanes that the frames of a segment show, in global metres, numbered in the order of appearance.

    Pieces of one id that do not overlap are lanes of their own.

    Args:
        frames: in the order of time.
        width: assumed of every lane, metres; the files of centerlines have no boundaries.
    """
    pieces: dict[str, list[np.ndarray]] = {}
    connector: dict[str, bool] = {}
    edges: dict[tuple[str, str], None] = {}
    for frame in frames:
        for number, line in zip(frame.ids, frame.lines, strict=True):
            if len(line) > 1:
                _add(pieces.setdefault(number, []), transform_points(frame.global_from_ego, _thinned(line)))
        connector |= dict(zip(frame.ids, frame.is_connector.tolist(), strict=True))
        edges |= {(frame.ids[i], frame.ids[j]): None for i, j in np.argwhere(frame.successor)}
    for parts in pieces.values():
        _join(parts)
    numbers: dict[str, list[int]] = {}
    lines: list[tuple[str, np.ndarray]] = []
    for name, parts in pieces.items():
        numbers[name] = list(range(len(lines), len(lines) + len(parts)))
        lines += [(name, part) for part in parts]
    onward: dict[int, list[int]] = {number: [] for number in range(len(lines))}
    for a, b in edges:
        for i in numbers.get(a, []):
            onward[i] += [j for j in numbers.get(b, []) if _apart(lines[i][1][-1], lines[j][1][0]) < _JOINED]
    return {
        number: LaneSegment(
            id=number,
            centerline=line,
            left=_beside(line, 0.5 * width),
            right=_beside(line, -0.5 * width),
            left_type=LineType.NONE,
            right_type=LineType.NONE,
            is_intersection=connector[name],
            successors=tuple(onward[number]),
        )
        for number, (name, line) in enumerate(lines)
    }


def _add(lines: list[np.ndarray], piece: np.ndarray) -> None:
    """Extend the first line that a piece overlaps, or append the piece."""
    for row, line in enumerate(lines):
        longer = _extended(line, piece)
        if longer is not None:
            lines[row] = longer
            return
    lines.append(piece)


def _join(lines: list[np.ndarray]) -> None:
    """Join lines that overlap since they were extended."""
    before = len(lines) + 1
    while 1 < len(lines) < before:
        before, rest = len(lines), lines[:]
        lines.clear()
        for line in rest:
            _add(lines, line)


def _extended(line: Float[np.ndarray, "n 3"], piece: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "k 3"] | None:
    """Return a line with the parts of a piece that lie beyond its ends; None where the two do not overlap."""
    distance, place = line_distances(piece, line)
    last = len(line) - 1
    on = np.flatnonzero(distance < _SAME)
    if not len(on) or not (np.diff(place[on]) >= 0.0).all():
        return None
    before, after = np.arange(len(piece)) < on[0], np.arange(len(piece)) > on[-1]
    between = ~before & ~after
    off = (before & (place > 0.0)) | (after & (place < last)) | (between & (distance >= _SAME))
    if off.any():
        return None
    return np.concatenate([piece[before], line, piece[after]])


def _thinned(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """Return every k-th point of a dense line, and its last one."""
    length = float(line_lengths(line))
    stride = max(int(_SPACING * (len(line) - 1) / length), 1) if length > 0.0 else 1
    rows = np.unique(np.append(np.arange(0, len(line), stride), len(line) - 1))
    return np.asarray(line, np.float64)[rows]


def _beside(line: Float[np.ndarray, "n 3"], left: float) -> Float[np.ndarray, "n 3"]:
    """Return the line `left` metres to the left of another."""
    step = np.gradient(line[:, :2], axis=0)
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    step = step / np.where(length > 0.0, length, 1.0)
    return line + np.pad(left * np.stack([-step[:, 1], step[:, 0]], -1), ((0, 0), (0, 1)))


def _apart(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    return float(np.hypot(*(a - b)[:2]))

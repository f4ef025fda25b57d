"""Merge lane segments into the centerlines of OpenLane-V2.

A lane segment ends wherever a marking or a neighbour changes; a centerline of OpenLane-V2 ends only at forks and
merges (docs/reference/openlane_v2_truth.md, step 7). A and B become one lane if B is A's only successor and A is B's
only predecessor. This is decided on the full map, before cropping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tflane_jax.geometry.polylines import arc_length
from tflane_jax.scene.logs import LaneSegment

# Two points closer than this (metres, ground plane) are one point of a merged line.
_SAME_POINT = 1e-6


@dataclass(frozen=True)
class MergedLanes:
    """Centerlines of a whole map.

    Attributes:
        chains: merged lanes by id; a chain has the id of its first segment and its successors are chain ids.
        chain_of: chain id of every segment id.
    """

    chains: dict[int, LaneSegment]
    chain_of: dict[int, int]


def merge_chains(segments: dict[int, LaneSegment]) -> MergedLanes:
    """Join lane segments over every one-to-one joint.

    Predecessors are the inverse of `successors`, because the predecessor lists of Argoverse 2 are incomplete. A
    successor outside the map counts as a branch but gives no edge. A closed loop of one-to-one joints is cut at its
    lowest id and is its own successor.
    """
    next_of = _one_to_one(segments)
    follows = {b: a for a, b in next_of.items()}
    heads = [s for s in segments if s not in follows]
    members = {head: _walk(head, next_of) for head in heads}
    walked = {s for chain in members.values() for s in chain}
    # Segments that no head reaches lie on closed loops.
    for segment in sorted(segments):
        if segment not in walked:
            members[segment] = _walk(segment, next_of)
            walked.update(members[segment])
    chain_of = {s: head for head, chain in members.items() for s in chain}
    chains = {head: _join([segments[s] for s in chain], chain_of) for head, chain in members.items()}
    return MergedLanes(chains, chain_of)


def _one_to_one(segments: dict[int, LaneSegment]) -> dict[int, int]:
    predecessors: dict[int, int] = {}
    for segment in segments.values():
        for successor in segment.successors:
            predecessors[successor] = predecessors.get(successor, 0) + 1
    return {
        s.id: s.successors[0]
        for s in segments.values()
        if len(s.successors) == 1 and s.successors[0] in segments and predecessors[s.successors[0]] == 1
    }


def _walk(head: int, next_of: dict[int, int]) -> list[int]:
    chain = [head]
    while (step := next_of.get(chain[-1])) is not None and step != head:
        chain.append(step)
    return chain


def _join(parts: list[LaneSegment], chain_of: dict[int, int]) -> LaneSegment:
    def label(values: list[int], lines: list[np.ndarray]) -> int:
        """Return the value that covers the greatest length; the first one in a tie."""
        lengths = [arc_length(line)[-1] for line in lines]
        return max(values, key=lambda v: sum(n for x, n in zip(values, lengths, strict=True) if x == v))

    centerlines = [p.centerline for p in parts]
    lefts, rights = [p.left for p in parts], [p.right for p in parts]
    return LaneSegment(
        id=parts[0].id,
        centerline=_concatenate(centerlines),
        left=_concatenate(lefts),
        right=_concatenate(rights),
        left_type=label([p.left_type for p in parts], lefts),
        right_type=label([p.right_type for p in parts], rights),
        is_intersection=bool(label([p.is_intersection for p in parts], centerlines)),
        successors=tuple(chain_of[s] for s in parts[-1].successors if s in chain_of),
        vehicle=all(p.vehicle for p in parts),
    )


def _concatenate(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate lines; a point where two of them join is kept once."""
    points = np.concatenate(lines)
    joint = np.cumsum([len(line) for line in lines[:-1]], dtype=int)
    repeated = np.linalg.norm(points[joint, :2] - points[joint - 1, :2], axis=-1) < _SAME_POINT
    return np.delete(points, joint[repeated], axis=0)

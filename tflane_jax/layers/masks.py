"""Masks of attention: true where a query may attend to a key. Every mask is made here."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float


def key_mask(valid_keys: Bool[Array, " k"]) -> Bool[Array, "1 k"]:
    """Return the mask by which all queries attend to the valid keys."""
    return valid_keys[None, :]


def pair_mask(valid_queries: Bool[Array, " q"], valid_keys: Bool[Array, " k"]) -> Bool[Array, "q k"]:
    """Return the mask by which valid queries attend to valid keys, and invalid queries to none."""
    return valid_queries[:, None] & valid_keys[None, :]


def radius_mask(
    places: Float[Array, "q 2"], lines: Float[Array, "n p 2"], valid: Bool[Array, " n"], radius: float
) -> Bool[Array, "q n"]:
    """Return the mask by which a query attends to the valid lines within `radius` of its place.

    Args:
        places, lines: in one unit, that of `radius`; a line may be a single point. Invalid ones may hold anything.
        valid: of the lines.
        radius: largest distance.
    """
    lines = jnp.where(valid[:, None, None], lines, 0.0)
    return (squared_line_distance(places, lines) <= radius**2).T & valid[None, :]


def squared_line_distance(places: Float[Array, "q 2"], lines: Float[Array, "n p 2"]) -> Float[Array, "n q"]:
    """Return the squared distance of every line to every place; infinity from lines without points."""
    if not lines.shape[1]:
        return jnp.full((len(lines), len(places)), jnp.inf, places.dtype)
    if lines.shape[1] == 1:
        lines = jnp.repeat(lines, 2, 1)  # a point is a segment without length
    # Segment by segment, coordinates apart: a CPU vectorises the minimum of arrays, not that over an axis of segments.
    x, y = places[None, :, 0], places[None, :, 1]
    segments = [_squared_segment_distance(x, y, lines[:, i], lines[:, i + 1]) for i in range(lines.shape[1] - 1)]
    return functools.reduce(jnp.minimum, segments)


def _squared_segment_distance(
    x: Float[Array, "1 q"], y: Float[Array, "1 q"], start: Float[Array, "n 2"], end: Float[Array, "n 2"]
) -> Float[Array, "n q"]:
    sx, sy = (end[:, i, None] - start[:, i, None] for i in (0, 1))
    dx, dy = x - start[:, 0, None], y - start[:, 1, None]
    square = sx**2 + sy**2
    fraction = jnp.clip((dx * sx + dy * sy) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
    return (dx - fraction * sx) ** 2 + (dy - fraction * sy) ** 2


def track_distance(
    lanes: Float[Array, "l p 2"], tracks: Float[Array, "t n 2"], valid: Bool[Array, "t n"]
) -> Float[Array, "l t"]:
    """Return the least distance between every lane and the valid positions of every track; infinity without any.

    Args:
        lanes: lines, or single points.
        tracks: positions in the same unit; invalid ones may hold anything.
        valid: of the positions.
    """
    if not valid.shape[1]:
        return jnp.full((len(lanes), len(tracks)), jnp.inf, lanes.dtype)
    # Tracks are the last axis, so that the minimum over positions vectorises as well.
    places = jnp.where(valid[..., None], tracks, 0.0).swapaxes(0, 1).reshape(-1, 2)
    square = squared_line_distance(places, lanes).reshape(len(lanes), *valid.T.shape)
    return jnp.sqrt(jnp.where(valid.T[None], square, jnp.inf).min(1))


def nearest_mask(distance: Float[Array, "q k"], count: int) -> Bool[Array, "q k"]:
    """Return the mask by which a query attends to the `count` nearest keys at a finite distance.

    Of keys at equal distances, the first ones count.
    """
    rank = jnp.argsort(jnp.argsort(distance, -1, stable=True), -1, stable=True)
    return (rank < count) & jnp.isfinite(distance)


def causal_mask(frames: int) -> Bool[Array, "n n"]:
    """Return the mask by which a frame attends to itself and to earlier frames."""
    return jnp.tril(jnp.ones((frames, frames), bool))


@struct.dataclass
class SpatialMask:
    """M_s of TF-Lane (Fig. 5): which of L lane queries and T traffic instances attend to which.

    Each fusion module needs one quadrant, which attention broadcasts to its full size; the whole (L+T) x (L+T) matrix
    exists only if `dense` is called. Rows are queries. `restricted` composes further masks of lanes and instances.

    Attributes:
        lanes: L.
        valid: (T,) of the instances.
        lane_lane: (L, L) the host's own mask; None allows all pairs of lanes.
        lane_traffic: (1, T) lanes attend to valid instances; (L, T), or (H, L, T) by head, if restricted.
        traffic_lane: (T, 1) valid instances attend to all lanes; (T, L) or (H, T, L) if restricted.
        traffic_traffic: (T, T) valid instances attend to valid instances.
    """

    lanes: int = struct.field(pytree_node=False)
    valid: Bool[Array, " t"]
    lane_lane: Bool[Array, "l l"] | None
    lane_traffic: Bool[Array, "*h #l t"]
    traffic_lane: Bool[Array, "*h t #l"]
    traffic_traffic: Bool[Array, "t t"]

    @classmethod
    def from_validity(
        cls, lanes: int, traffic_valid: Bool[Array, " t"], lane_mask: Bool[Array, "l l"] | None = None
    ) -> SpatialMask:
        """Return M_s from the validity of instances and the host's L->L mask, None for all lanes (section 3.3)."""
        return cls(
            lanes=lanes,
            valid=traffic_valid,
            lane_lane=lane_mask,
            lane_traffic=key_mask(traffic_valid),
            traffic_lane=traffic_valid[:, None],
            traffic_traffic=pair_mask(traffic_valid, traffic_valid),
        )

    def restricted(self, pairs: Bool[Array, "*h l t"]) -> SpatialMask:
        """Return the mask in which lanes and instances see each other only where `pairs` allows it as well.

        Args:
            pairs: [..., i, j] lane i and instance j; with a leading axis, each head has its own.

        Raises:
            ValueError: they are not those of L lanes and T instances.
        """
        wanted = self.lanes, len(self.valid)
        if pairs.shape[-2:] != wanted:
            raise ValueError(f"pairs have shape {pairs.shape}, expected ([H,] L, T) = ([H,] {wanted[0]}, {wanted[1]})")
        return replace(
            self,
            lane_traffic=_both(self.lane_traffic, pairs),
            traffic_lane=_both(self.traffic_lane, jnp.swapaxes(pairs, -1, -2)),
        )

    def by_group(self, sizes: tuple[int, ...]) -> SpatialMask:
        """Return the mask of as many copies of all instances as there are groups of lanes, one copy for each group.

        A copy sees itself and the lanes of its group, and these see that copy, so that nothing passes from one group
        to another by way of the instances. `lane_lane` stays, and must separate the groups itself.

        Args:
            sizes: numbers of lanes of successive groups; their sum is L.
        """
        count, instances = len(sizes), len(self.valid)
        group = jnp.asarray(np.repeat(np.arange(count), sizes))
        copy = jnp.repeat(jnp.arange(count), instances)
        copies = replace(
            self,
            valid=jnp.tile(self.valid, count),
            lane_traffic=_repeated(self.lane_traffic, count, -1),
            traffic_lane=_repeated(self.traffic_lane, count, -2),
            traffic_traffic=jnp.tile(self.traffic_traffic, (count, count)) & (copy[:, None] == copy[None]),
        )
        return copies.restricted(group[:, None] == copy[None])

    def dense(self) -> Bool[Array, "*h l+t l+t"]:
        """Return the whole matrix, lanes first; one for each head if a restriction has heads."""
        lanes, traffic, heads = self.lanes, self.lane_traffic.shape[-1], self.lane_traffic.shape[:-2]
        lane_lane = jnp.ones((1, 1), bool) if self.lane_lane is None else self.lane_lane

        def full(quadrant, rows, columns):
            return jnp.broadcast_to(quadrant, (*heads, rows, columns))

        return jnp.block(
            [
                [full(lane_lane, lanes, lanes), full(self.lane_traffic, lanes, traffic)],
                [full(self.traffic_lane, traffic, lanes), full(self.traffic_traffic, traffic, traffic)],
            ]
        )


def _repeated(mask: Bool[Array, "*h q k"], count: int, axis: int) -> Bool[Array, "*h q k"]:
    return jnp.concatenate([mask] * count, axis)


def _both(one: Bool[Array, "*h #q #k"], other: Bool[Array, "*h #q #k"]) -> Bool[Array, "*h q k"]:
    """Return where both masks allow a pair; one without heads holds for all heads of the other."""
    rank = max(one.ndim, other.ndim)
    one, other = (mask.reshape((1,) * (rank - mask.ndim) + mask.shape) for mask in (one, other))
    return one & other

"""Masks of attention: true where a query may attend to a key. Every mask is made here."""

from __future__ import annotations

import jax.numpy as jnp
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
        places, lines: in one unit, that of `radius`; lines of at least two points. Invalid ones may hold anything.
        valid: of the lines.
        radius: largest distance.
    """
    lines = jnp.where(valid[:, None, None], lines, 0.0)
    start, step = lines[:, :-1], lines[:, 1:] - lines[:, :-1]
    # Coordinates apart: arrays whose last axis is 2 are slow on a CPU.
    dx, dy = (places[:, None, None, i] - start[None, ..., i] for i in (0, 1))
    sx, sy = (step[None, ..., i] for i in (0, 1))
    square = sx**2 + sy**2
    fraction = jnp.clip((dx * sx + dy * sy) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
    distance = (dx - fraction * sx) ** 2 + (dy - fraction * sy) ** 2
    return (distance.min(-1) <= radius**2) & valid[None, :]


@struct.dataclass
class SpatialMask:
    """M_s of TF-Lane (Fig. 5): which of L lane queries and T traffic instances attend to which.

    Each fusion module needs one quadrant, which attention broadcasts to its full size; the whole (L+T) x (L+T) matrix
    exists only if `dense` is called. Rows are queries.

    Attributes:
        lanes: L.
        lane_lane: (L, L) the host's own mask; None allows all pairs of lanes.
        lane_traffic: (1, T) lanes attend to valid instances.
        traffic_lane: (T, 1) valid instances attend to all lanes.
        traffic_traffic: (T, T) valid instances attend to valid instances.
    """

    lanes: int = struct.field(pytree_node=False)
    lane_lane: Bool[Array, "l l"] | None
    lane_traffic: Bool[Array, "1 t"]
    traffic_lane: Bool[Array, "t 1"]
    traffic_traffic: Bool[Array, "t t"]

    @classmethod
    def from_validity(
        cls, lanes: int, traffic_valid: Bool[Array, " t"], lane_mask: Bool[Array, "l l"] | None = None
    ) -> SpatialMask:
        """Return M_s from the validity of instances and the host's L->L mask, None for all lanes (section 3.3)."""
        return cls(
            lanes=lanes,
            lane_lane=lane_mask,
            lane_traffic=key_mask(traffic_valid),
            traffic_lane=traffic_valid[:, None],
            traffic_traffic=pair_mask(traffic_valid, traffic_valid),
        )

    def dense(self) -> Bool[Array, "l+t l+t"]:
        """Return the whole matrix, lanes first."""
        lanes, traffic = self.lanes, self.lane_traffic.shape[1]
        lane_lane = jnp.ones((1, 1), bool) if self.lane_lane is None else self.lane_lane

        def full(quadrant, rows, columns):
            return jnp.broadcast_to(quadrant, (rows, columns))

        return jnp.block(
            [
                [full(lane_lane, lanes, lanes), full(self.lane_traffic, lanes, traffic)],
                [full(self.traffic_lane, traffic, lanes), full(self.traffic_traffic, traffic, traffic)],
            ]
        )

"""LaneSegNet's ground truth: lane segments and pedestrian crossings as rows of one graph.

A crossing is a pseudo segment: its two long sides are its left and right boundary.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.scene import Areas, AreaType, LaneGraph, LineType

LANE, CROSSING = 0, 1
"""Classes of LaneSegNet's queries."""


@struct.dataclass
class SegmentTargets:
    """N lane segments and crossings, those that are valid first.

    Attributes:
        lanes: both kinds; crossings have no successors, and boundaries of type `LineType.NONE`.
        category: (N,) `LANE` or `CROSSING`.
    """

    lanes: LaneGraph
    category: Int[Array, "*b n"]

    @property
    def valid(self) -> Bool[Array, "*b n"]:
        """(N,) which rows exist."""
        return jnp.asarray(self.lanes.valid)

    @property
    def lines(self) -> Float[Array, "*b n 3 p 3"]:
        """(N, 3, P, 3) centerline, left and right boundary, metres."""
        lanes = self.lanes
        return jnp.stack([jnp.asarray(line) for line in (lanes.points, lanes.left, lanes.right)], -3)


def segment_targets(segments: LaneGraph, areas: Areas) -> SegmentTargets:
    """Return the targets of one example; padding may hold anything and is zero in the result."""
    points = segments.points.shape[1]
    crossing = jnp.asarray(areas.valid) & (jnp.asarray(areas.category) == AreaType.PEDESTRIAN_CROSSING)
    rings = jnp.where(crossing[:, None, None], areas.points, 0.0)
    left, right = crossing_sides(rings, points)
    count, further = len(segments.valid), len(areas.valid)
    label = jnp.full(further, LineType.NONE, jnp.int32)
    crossings = LaneGraph(
        points=(left + right) / 2.0,
        left=left,
        right=right,
        left_type=label,
        right_type=label,
        is_connector=jnp.zeros(further, bool),
        visibility=jnp.zeros(further),
        successor=jnp.zeros((further, further), bool),
        valid=crossing,
    )
    successor = jnp.zeros((count + further,) * 2, bool).at[:count, :count].set(segments.successor)
    joined = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b]),
        *(graph.replace(successor=None) for graph in (segments, crossings)),  # pyright: ignore
    )
    order = jnp.argsort(~joined.valid, stable=True)
    rows = jax.tree.map(lambda leaf: leaf[order], joined)
    rows = jax.tree.map(lambda leaf: jnp.where(rows.valid.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, 0), rows)
    both = rows.valid[:, None] & rows.valid[None]
    lanes = rows.replace(
        successor=successor[order][:, order] & both,
        visibility=rows.visibility.astype(jnp.float32),
        **{name: getattr(rows, name).astype(bool) for name in ("valid", "is_connector")},
    )
    return SegmentTargets(lanes, jnp.where(order < count, LANE, CROSSING))


def crossing_sides(rings: Float[Array, "a k 3"], points: int) -> tuple[Float[Array, "a p 3"], Float[Array, "a p 3"]]:
    """Return the long sides of crossings, metres, each `points` points at equal distances.

    A crossing is the rectangle around its ring along the ring's prevailing edge direction. Both sides head between -45
    and 135 degrees, as those of the published code, and the left one is to the left of that heading.

    Args:
        rings: closed rings, of five corners or resampled.
        points: on each side.
    """
    flat = rings[..., :2]
    edge = flat[:, 1:] - flat[:, :-1]
    length = jnp.sqrt((edge**2).sum(-1))
    unit = edge / jnp.maximum(length, 1e-6)[..., None]
    # The edges of a resampled ring that cut a corner agree with no other.
    agreement = (jnp.einsum("aic,ajc->aij", unit, unit) ** 16 * length[:, None]).sum(-1)
    along = jnp.take_along_axis(unit, agreement.argmax(-1)[:, None, None], 1)[:, 0]
    along = jnp.where(along.sum(-1, keepdims=True) < 0.0, -along, along)
    across = jnp.stack([-along[:, 1], along[:, 0]], -1)
    u, v = (jnp.einsum("akc,ac->ak", flat, axis) for axis in (along, across))
    fraction = jnp.linspace(0.0, 1.0, points)[None, :, None]

    def side(height):
        ends = [jnp.stack([end, height], -1) for end in (u.min(-1), u.max(-1))]
        apart = [(u - end[:, :1]) ** 2 + (v - end[:, 1:]) ** 2 for end in ends]
        z = [jnp.take_along_axis(rings[..., 2], d.argmin(-1)[:, None], 1) for d in apart]
        corners = [
            jnp.concatenate([end[:, :1] * along + end[:, 1:] * across, z], -1)[:, None]
            for end, z in zip(ends, z, strict=True)
        ]
        return corners[0] + fraction * (corners[1] - corners[0])

    return side(v.max(-1)), side(v.min(-1))

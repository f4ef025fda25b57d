"""Multi-scale deformable attention (Deformable DETR), as BEVFormer and TopoNet use it (specs/modules.md section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def sample_bilinear(
    value: Float[Array, "hw d"], shape: tuple[int, int], location: Float[Array, "*s 2"]
) -> Float[Array, "*s d"]:
    """Return features at continuous locations, zero outside (each of the four taps by itself).

    Args:
        value: features of an (h, w) grid, row-major.
        shape: (h, w).
        location: (x, y) in [0, 1] across the grid's outer borders; cell centres lie at (i + 0.5) / size.
    """
    h, w = shape
    pixel = location * jnp.broadcast_to(jnp.array([w, h], location.dtype), location.shape) - 0.5
    corner = jnp.floor(pixel)
    fraction = pixel - corner
    corner = corner.astype(jnp.int32)
    total = jnp.zeros((*location.shape[:-1], value.shape[-1]), value.dtype)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = corner[..., 0] + dx, corner[..., 1] + dy
        weight = jnp.abs(1 - dx - fraction[..., 0]) * jnp.abs(1 - dy - fraction[..., 1])
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        index = jnp.where(inside, y * w + x, 0)
        tap = value.at[index].get(mode="promise_in_bounds")
        total = total + tap * jnp.where(inside, weight, 0.0)[..., None]
    return total


def deformable_attention(
    value: Float[Array, "hw heads d"],
    shapes: Sequence[tuple[int, int]],
    locations: Float[Array, "q heads levels p 2"],
    weights: Float[Array, "q heads levels p"],
) -> Float[Array, "q heads*d"]:
    """Return the weighted sum of bilinear samples over levels and points, heads concatenated.

    Args:
        value: levels one after the other along the first axis.
        shapes: (h, w) of each level.
        locations: (x, y) in [0, 1].
        weights: they need not sum to one.
    """
    queries, heads = weights.shape[:2]
    total = jnp.zeros((heads, queries, value.shape[-1]), value.dtype)
    start = 0
    for level, (h, w) in enumerate(shapes):
        grid = value[start : start + h * w]
        start += h * w
        sample = jax.vmap(lambda v, s, shape=(h, w): sample_bilinear(v, shape, s), in_axes=(1, 1))
        tap = sample(grid, locations[:, :, level])  # (heads, q, p, d)
        total = total + jnp.einsum("hqpd,qhp->hqd", tap, weights[:, :, level])
    return total.transpose(1, 0, 2).reshape(queries, heads * value.shape[-1])


def compass_offsets(heads: int, levels: int, points: int) -> np.ndarray:
    """Return Deformable DETR's initial offsets (heads, levels, points, 2): a direction per head, a radius per point."""
    angle = np.arange(heads) * (2.0 * math.pi / heads)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    direction = direction / np.abs(direction).max(-1, keepdims=True)
    radius = np.arange(1, points + 1)
    grid = direction[:, None, None, :] * radius[None, None, :, None]
    return np.broadcast_to(grid, (heads, levels, points, 2)).astype(np.float32)


class DeformableAttention(nn.Module):
    """Deformable attention with its projections.

    Attributes:
        dim: channels in and out.
        heads, points: sampling points per head and level.
        levels: number of value levels.
    """

    dim: int
    heads: int = 8
    points: int = 4
    levels: int = 1

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "q c"],
        value: Float[Array, "hw c"],
        shapes: Sequence[tuple[int, int]],
        reference: Float[Array, "q r *levels d"],
        valid: Bool[Array, " hw"] | None = None,
    ) -> Float[Array, "q c"]:
        """Return the attended features, without residual.

        Args:
            query: content plus position; it decides where to look and how much to take.
            value: features to look at, levels concatenated.
            shapes: (h, w) of each level.
            reference: where to look, in [0, 1]: (Q, R, D) for all levels together, or (Q, R, levels, D). R = 1 for all
                heads together, or R = heads, one point for each (LaneSegNet's heads-to-regions). D = 2 is a point
                (x, y), offsets then count in cells; D = 4 a box (cx, cy, w, h), offsets then count in halves of the
                box, divided by the number of points (Deformable DETR's refined boxes).
            valid: cells that hold something; the others give nothing, whatever stands in them.

        Raises:
            ValueError: a reference of another shape.
        """
        queries, (heads, levels, points) = query.shape[0], (self.heads, self.levels, self.points)
        bias = compass_offsets(heads, levels, points).reshape(-1)
        offsets = nn.Dense(
            heads * levels * points * 2, kernel_init=nn.initializers.zeros,
            bias_init=lambda *_: jnp.asarray(bias), name="sampling_offsets",
        )(query).reshape(queries, heads, levels, points, 2)  # fmt: skip
        logits = nn.Dense(heads * levels * points, kernel_init=nn.initializers.zeros, name="attention_weights")(
            query
        ).reshape(queries, heads, levels * points)
        weights = jax.nn.softmax(logits, -1).reshape(queries, heads, levels, points)
        # Before the projection too: what stands in padding must not reach the projection's gradient.
        value = nn.Dense(self.dim, name="value_proj")(_masked(value, valid))
        value = _masked(value, valid).reshape(-1, heads, self.dim // heads)
        locations = sampling_locations(reference, offsets, shapes)
        attended = deformable_attention(value, shapes, locations, weights)
        return nn.Dense(self.dim, name="output_proj")(attended)


def sampling_locations(
    reference: Float[Array, "q r *levels d"],
    offsets: Float[Array, "q heads levels p 2"],
    shapes: Sequence[tuple[int, int]],
) -> Float[Array, "q heads levels p 2"]:
    """Return the locations in [0, 1] that offsets from the references stand for (see `DeformableAttention`).

    Raises:
        ValueError: a reference of another shape.
    """
    heads, levels, points = offsets.shape[1:4]
    if reference.shape[1] not in (1, heads):
        raise ValueError(f"reference needs 1 or {heads} points per query, got {reference.shape[1]}")
    if len(shapes) != levels:
        raise ValueError(f"the attention has {levels} levels, the value {len(shapes)}")
    if reference.ndim == 3:
        reference = reference[:, :, None]
    if reference.ndim != 4 or reference.shape[2] not in (1, levels) or reference.shape[3] not in (2, 4):
        raise ValueError(f"reference must be (q, r, 2 or 4) or (q, r, {levels}, 2 or 4), got {reference.shape}")
    if reference.shape[-1] == 2:
        unit = jnp.array([(1.0 / w, 1.0 / h) for h, w in shapes], offsets.dtype)[None, None, :, None]
    else:
        unit = reference[:, :, :, None, 2:] * (0.5 / points)
    return reference[:, :, :, None, :2] + offsets * unit


def _masked(value: Float[Array, "hw c"], valid: Bool[Array, " hw"] | None) -> Float[Array, "hw c"]:
    return value if valid is None else jnp.where(valid[:, None], value, 0.0)

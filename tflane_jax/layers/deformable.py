"""Multi-scale deformable attention (Deformable DETR, Zhu et al. 2021), as BEVFormer, TopoNet and LaneSegNet use it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.sampling import deformable_attention


def compass_offsets(heads: int, levels: int, points: int) -> np.ndarray:
    """Return Deformable DETR's initial offsets (heads, levels, points, 2): a direction per head, a radius per point."""
    angle = np.arange(heads) * (2.0 * math.pi / heads)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    direction = direction / np.abs(direction).max(-1, keepdims=True)
    radius = np.arange(1, points + 1)
    grid = direction[:, None, None, :] * radius[None, None, :, None]
    return np.broadcast_to(grid, (heads, levels, points, 2)).astype(np.float32)


def star_offsets(heads: int, levels: int, points: int) -> np.ndarray:
    """Return LaneSegNet's initial offsets (heads, levels, points, 2): a star of eight directions, alike for every head.

    Point p has direction p // r and radius p % r + 1, with r = points / 8 radii per direction; fewer than eight points
    have one direction each.

    Raises:
        ValueError: the points do not fill the star.
    """
    directions = min(points, 8)
    if points % directions:
        raise ValueError(f"{points} points do not form a star of 8 directions: choose a multiple of 8, or fewer than 8")
    star = compass_offsets(directions, 1, points // directions).reshape(1, 1, points, 2)
    return np.broadcast_to(star, (heads, levels, points, 2))


class DeformableAttention(nn.Module):
    """Deformable attention with its projections.

    Attributes:
        dim: channels in and out.
        heads, points: sampling points per head and level.
        levels: number of value levels.
        initial: initial offsets. "compass": each head samples in its own direction (Deformable DETR); "star": each head
            samples in all directions around its own reference point (LaneSegNet's LaneAttention).
    """

    dim: int
    heads: int = 8
    points: int = 4
    levels: int = 1
    initial: Literal["compass", "star"] = "compass"

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
            query: content plus position; gives sampling offsets and weights.
            value: features to sample, levels concatenated.
            shapes: (h, w) of each level.
            reference: reference points in [0, 1], (Q, R, D) for all levels or (Q, R, levels, D) for each. R = 1 is one
                for all heads, R = heads one for each (LaneSegNet's heads-to-regions). D = 2 is a point (x, y) with
                offsets in cells; D = 4 a box (cx, cy, w, h) with offsets in units of half the box, divided by the
                number of points (Deformable DETR's refined boxes).
            valid: cells that are not padding; padding may hold anything, NaN included.

        Raises:
            ValueError: a reference of another shape.
        """
        offsets, logits = offsets_and_logits(query, self.heads, self.levels, self.points, self.initial)
        weights = jax.nn.softmax(logits, (-2, -1))
        # Before the projection too: padding must not reach the projection's gradient.
        value = nn.Dense(self.dim, name="value_proj")(_masked(value, valid))
        value = _masked(value, valid).reshape(-1, self.heads, self.dim // self.heads)
        locations = sampling_locations(reference, offsets, shapes)
        attended = deformable_attention(value, shapes, locations, weights)
        return nn.Dense(self.dim, name="output_proj")(attended)


def offsets_and_logits(
    query: Float[Array, "q c"],
    heads: int,
    levels: int,
    points: int,
    initial: Literal["compass", "star"] = "compass",
) -> tuple[Float[Array, "q heads levels p 2"], Float[Array, "q heads levels p"]]:
    """Return sampling offsets and logits in float32, with layers that belong to the calling module."""
    bias = (star_offsets if initial == "star" else compass_offsets)(heads, levels, points).reshape(-1)
    offsets = nn.Dense(
        heads * levels * points * 2,
        kernel_init=nn.initializers.zeros,
        bias_init=lambda *_: jnp.asarray(bias, jnp.float32),
        name="sampling_offsets",
    )(query)
    logits = nn.Dense(heads * levels * points, kernel_init=nn.initializers.zeros, name="attention_weights")(query)
    shape = (query.shape[0], heads, levels, points)
    return offsets.reshape(*shape, 2).astype(jnp.float32), logits.reshape(shape).astype(jnp.float32)


def cell_units(shapes: Sequence[tuple[int, int]]) -> Float[Array, "levels 2"]:
    """Return the size (x, y) of a cell of each level, in units of the level."""
    return jnp.array([(1.0 / w, 1.0 / h) for h, w in shapes], jnp.float32)


def sampling_locations(
    reference: Float[Array, "q r *levels d"],
    offsets: Float[Array, "q heads levels p 2"],
    shapes: Sequence[tuple[int, int]],
) -> Float[Array, "q heads levels p 2"]:
    """Return sampling locations in [0, 1] from references and offsets (see `DeformableAttention`).

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
        unit = cell_units(shapes)[None, None, :, None]
    else:
        unit = reference[:, :, :, None, 2:] * (0.5 / points)
    return reference[:, :, :, None, :2] + offsets * unit


def _masked(value: Float[Array, "hw c"], valid: Bool[Array, " hw"] | None) -> Float[Array, "hw c"]:
    return value if valid is None else jnp.where(valid[:, None], value, 0.0)

"""Edge types between the cells of a feature map, applied without their matrices.

Rows of an adjacency A are destination cells, columns are source cells. Edge types are scaled so that the edges into
each valid cell sum to 1: D^-1 A, known in closed form from the validity of the cells. Products of edge types then have
the same property, so meta-paths need no normalisation. A cell without incoming edges of a type keeps a self-loop, as in
FastGTN.

* `self`: the cell itself.
* `up`, `down`, `left`, `right` and the four diagonals: the neighbour on that side, a shift of the map.
* `row`, `column`: all valid cells of the same row or column, itself included; a mean along an axis.

Invalid cells have no edges: their rows and columns of A are 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import lax
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.attention import Drop

Relation = Literal[
    "self", "up", "down", "left", "right", "up_left", "up_right", "down_left", "down_right", "row", "column"
]
Side = tuple[int, int]

# Offset of the neighbour: (cells down, cells to the right).
SIDES: Mapping[str, Side] = {
    "up": (-1, 0),
    "down": (1, 0),
    "left": (0, -1),
    "right": (0, 1),
    "up_left": (-1, -1),
    "up_right": (-1, 1),
    "down_left": (1, -1),
    "down_right": (1, 1),
}
AXES: Mapping[str, int] = {"row": 1, "column": 0}


def mix_relations(
    relations: tuple[Relation, ...],
    type_weights: Float[Array, "e c"],
    x: Float[Array, "h w c"],
    valid: Bool[Array, "h w"],
) -> Float[Array, "h w c"]:
    """Return sum_e weight_e A_e x, Eq. (1) of the GTN lane paper applied to features; 0 for invalid cells.

    The gradient is written out as a mixture of shifts and means; JAX's own would allocate a dozen arrays.

    Args:
        relations: edge types, at least one.
        type_weights: weight of each edge type, by feature.
        x: 0 in invalid cells, set by `jnp.where` so that no gradient flows there either; not cleared again here.
        valid: cells that have edges.
    """
    mixed: Array = _mix(relations, type_weights, x, valid)
    return mixed


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _mix(relations: tuple[Relation, ...], type_weights, x, valid) -> Array:
    messages = _messages(relations, x, valid)
    parts = [weight * message for weight, message in zip(type_weights[:, None, None], messages, strict=True)]
    return jnp.where(valid[..., None], sum(parts[1:], parts[0]), 0.0)


def _mix_backward(relations, residuals, gradient):
    type_weights, x, valid = residuals
    gradient, back = bordered_sides(relations, gradient, valid, sign=-1)
    by_line = {axis: gradient.sum(axis, keepdims=True) for axis in AXES.values()}
    to_weights, own, to_x = [], jnp.zeros((1, 1, 1), x.dtype), jnp.zeros_like(x)
    messages = _messages(relations, x, valid)
    for relation, weight, message in zip(relations, type_weights[:, None, None], messages, strict=True):
        if relation in AXES:
            of_line = by_line[AXES[relation]]
            to_weights.append((of_line * message).sum((0, 1)))
            to_x = to_x + _line_weights(valid, AXES[relation], x.dtype)[..., None] * (weight * of_line)
            continue
        to_weights.append((gradient * message).sum((0, 1)))
        if relation in SIDES:
            # Transpose: gradients come from the opposite neighbour; cells without a neighbour have a self-loop.
            to_x = to_x + weight * back[SIDES[relation]]
            weight = weight * (1.0 - shifted(valid, SIDES[relation]).astype(x.dtype))[..., None]
        own = own + weight
    return jnp.stack(to_weights).astype(type_weights.dtype), (to_x + own * gradient).astype(x.dtype), None


_mix.defvjp(lambda relations, *arrays: (_mix(relations, *arrays), arrays), _mix_backward)


def _messages(relations, x, valid):
    """Return A_e x for each edge type; for rows and columns one value per line, to be broadcast."""
    x, near = bordered_sides(relations, x, valid)

    def one(relation):
        if relation in SIDES:
            side = SIDES[relation]
            return jnp.where(shifted(valid, side)[..., None], near[side], x)
        if relation in AXES:
            axis = AXES[relation]
            count = jnp.maximum(valid.sum(axis, keepdims=True), 1).astype(x.dtype)
            return x.sum(axis, keepdims=True) / count[..., None]
        return x

    return [one(relation) for relation in relations]


def bordered_sides(
    relations: tuple[Relation, ...], x: Float[Array, "h w c"], valid: Bool[Array, "h w"], sign: int = 1
) -> tuple[Float[Array, "h w c"], dict[Side, Float[Array, "h w c"]]]:
    """Return x with invalid cells set to 0, and its shift for each side of the relations (opposite with sign -1).

    All are slices of one array with a border, and x is masked a second time: otherwise XLA recomputes x in every user.
    """
    x = jnp.where(valid[..., None], x, 0.0)
    sides = tuple(SIDES[relation] for relation in relations if relation in SIDES)
    if not sides:
        return x, {}
    here, *near = neighbours(((0, 0), *((sign * down, sign * right) for down, right in sides)), x)
    return jnp.where(valid[..., None], here, 0.0), dict(zip(sides, near, strict=True))


def _line_weights(valid, axis, dtype):
    """Return 1 / (number of valid cells along the axis) for each cell, 0 for invalid cells."""
    return valid / jnp.maximum(valid.sum(axis, keepdims=True), 1).astype(dtype)


def shifted(x: Array, side: Side) -> Array:
    """Return for each cell the value of its neighbour `side` = (down, right) cells away; 0 beyond the border."""
    config = [(-side[0], side[0], 0), (-side[1], side[1], 0), *[(0, 0, 0)] * (x.ndim - 2)]
    return x if 0 in x.shape[:2] else lax.pad(x, jnp.zeros((), x.dtype), config)


def neighbours(sides: tuple[Side, ...], x: Float[Array, "h w *c"]) -> tuple[Float[Array, "h w *c"], ...]:
    """Return `shifted(x, side)` for each side, at most one cell away; several times as fast as separate calls."""
    shifts: tuple[Array, ...] = _neighbours(sides, x)
    return shifts


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _neighbours(sides: tuple[Side, ...], x) -> tuple[Array, ...]:
    height, width = x.shape[:2]
    # The barrier makes XLA pad once; otherwise it tests for the border at every element of every user.
    bordered = lax.optimization_barrier(jnp.pad(x, [(1, 1), (1, 1), *[(0, 0)] * (x.ndim - 2)]))
    return tuple(bordered[1 + down : 1 + down + height, 1 + right : 1 + right + width] for down, right in sides)


def _neighbours_backward(sides, _, gradients):
    # JAX's own gradient of a slice of `bordered` costs more than all else in this function.
    back = [shifted(gradient, (-down, -right)) for gradient, (down, right) in zip(gradients, sides, strict=True)]
    return (sum(back[1:], back[0]),)


_neighbours.defvjp(lambda sides, x: (_neighbours(sides, x), None), _neighbours_backward)


def smooth(x: Float[Array, "h w c"], valid: Bool[Array, "h w"]) -> Float[Array, "h w c"]:
    """Return D^-1/2 (A + I) D^-1/2 x over the 8 neighbours of each cell (Kipf & Welling 2017, Eq. 2)."""
    degree = _box(valid[..., None].astype(x.dtype))
    scale = jnp.where(valid[..., None], lax.rsqrt(jnp.maximum(degree, 1.0)), 0.0)
    return scale * _box(scale * x)


def _box(x):
    """Return the sum over the 3 x 3 cells around each: down, then across."""
    for sides in (((-1, 0), (0, 0), (1, 0)), ((0, -1), (0, 0), (0, 1))):
        before, here, behind = neighbours(sides, x)
        x = before + here + behind
    return x


def attend_near(
    destination: Float[Array, "h w heads"],
    source: Float[Array, "h w heads"],
    value: Float[Array, "h w heads d"],
    valid: Bool[Array, "h w"],
    drop: Drop = None,
) -> tuple[Float[Array, "h w heads d"], Float[Array, "9 h w heads"]]:
    """Attend to the cell and its 8 neighbours; see `attend_along`. Weights: the cell itself first, then `SIDES`."""
    sides = [(0, 0), *SIDES.values()]
    is_source = jnp.stack([shifted(valid, side) for side in sides])[..., None]
    scores = jnp.stack([_score(destination, near) for near in neighbours(tuple(sides), source)])
    weights = _softmax(scores, is_source, 0)
    near = neighbours(tuple(sides), value)
    used = weights if drop is None else drop(weights)
    parts = (w[..., None] * v for w, v in zip(used, near, strict=True))
    return sum(parts, jnp.zeros_like(value)), weights


def attend_along(
    axis: int,
    destination: Float[Array, "h w heads"],
    source: Float[Array, "h w heads"],
    value: Float[Array, "h w heads d"],
    valid: Bool[Array, "h w"],
    drop: Drop = None,
) -> tuple[Float[Array, "h w heads d"], Float[Array, "lines n n heads"]]:
    """Attend to the valid cells of the same row (axis 1) or column (axis 0) by GAT's scores (Wang et al. 2019, Eq. 3).

    Args:
        axis: along which the cells of a neighbourhood lie.
        destination, source: scores of a cell i and of its neighbour j, the two halves of a^T [h_i || h_j].
        value: finite everywhere.
        valid: cells that may be attended to.
        drop: dropout of the weights.

    Returns:
        The attended values, and the weights before dropout by (line, destination cell, source cell, head).
    """
    if axis == 0:
        destination, source, value, valid = (x.swapaxes(0, 1) for x in (destination, source, value, valid))
    weights = _softmax(_score(destination[:, :, None], source[:, None]), valid[:, None, :, None], 2)
    out = jnp.einsum("lijh,ljhd->lihd", weights if drop is None else drop(weights), value)
    return (out.swapaxes(0, 1) if axis == 0 else out), weights


def _score(destination, source):
    return nn.leaky_relu(destination + source, 0.2)


def _softmax(scores, is_source, axis):
    """Return the softmax over the source cells; 0 where there is none."""
    scores = jnp.where(is_source, scores, -jnp.inf)
    top = lax.stop_gradient(scores.max(axis, keepdims=True, initial=jnp.finfo(scores.dtype).min))
    weights = jnp.exp(scores - top)
    total = weights.sum(axis, keepdims=True)
    return weights / jnp.where(total > 0, total, 1.0)

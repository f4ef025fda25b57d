"""Geometry-guided kernel attention of BEV queries to the cameras (GKT, Chen et al. 2022), the default of MapTR.

Each query's pillar is projected into the images, as in BEVFormer. Around every projected point, attention reads a fixed
kernel of feature cells; only its weights are learned.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.camera_queries import CameraQueries

_INIT = nn.initializers.xavier_uniform()


class GeometryKernelAttention(nn.Module):
    """Attention to a kernel of cells around the pillars of the queries, in the cameras that see them.

    Attributes:
        dim: channels in and out.
        heads: as many as a pillar has anchors; head z reads around anchor z.
        kernel: (rows, columns) of the kernel, odd.
        capacity: most queries per camera, see `SpatialCrossAttention`.
    """

    dim: int
    heads: int = 4
    kernel: tuple[int, int] = (3, 5)
    capacity: int | None = None

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "q c"],
        features: Float[Array, "v hw c"],
        shapes: Sequence[tuple[int, int]],
        reference: Float[Array, "v q z 2"],
        visible: Bool[Array, "v q z"],
    ) -> Float[Array, "q c"]:
        """Return the mean of the attended features over the cameras that see a query, without residual.

        Args:
            query: content.
            features: of each camera; finite.
            shapes: (h, w) of the only level.
            reference: (x, y) of a query's Z anchors in each image, in [0, 1].
            visible: anchors inside the image.

        Raises:
            ValueError: several levels, or another number of anchors than heads.
        """
        (cameras, queries, anchors), heads = visible.shape, self.heads
        if len(shapes) != 1 or anchors != heads:
            raise ValueError(f"one level and {heads} anchors are needed, not {len(shapes)} and {anchors}")
        value = nn.Dense(self.dim, kernel_init=_INIT, name="value_proj")(features)
        value = value.reshape(cameras, -1, heads, self.dim // heads).astype(jnp.float32)
        rows, columns = self.kernel
        # The module's own zeros do not last: MapTR's transformer initialises all matrices but those of three deformable
        # attentions.
        logits = nn.Dense(heads * rows * columns, kernel_init=_INIT, name="attention_weights")(query)
        weights = jax.nn.softmax(logits.reshape(queries, heads, rows * columns).astype(jnp.float32), -1)
        by_camera = CameraQueries.of(visible.any(-1), self.capacity)
        by_camera.sow_lost(self)
        # Unseen queries have weight 0, so that their gradients are zero; their reference may be anything.
        around, taken = by_camera.masked(by_camera.take_own(reference)), by_camera.masked(by_camera.take(weights))
        found = kernel_sum(value, shapes[0], around, taken, self.kernel)
        return nn.Dense(self.dim, kernel_init=_INIT, name="output_proj")(by_camera.mean(found))


def kernel_sum(
    value: Float[Array, "v hw heads d"],
    shape: tuple[int, int],
    location: Float[Array, "v q heads 2"],
    weights: Float[Array, "v q heads k"],
    kernel: tuple[int, int],
) -> Float[Array, "v q heads*d"]:
    """Return the weighted sum of the cells around a location, heads concatenated.

    A kernel cell's coordinates are those of the location, in cells, plus its integer offset, rounded to the nearest
    integer (halves to the even one) and clamped to the map. No gradient by the location.

    Args:
        value: features of V maps.
        shape: (h, w) of a map.
        location: (x, y) in [0, 1], finite.
        weights: of the K cells of the kernel, column by column.
        kernel: (rows, columns).
    """
    (height, width), (cameras, cells, heads, depth) = shape, value.shape
    table = value.reshape(-1, depth)
    x, y = location[..., 0] * width, location[..., 1] * height
    first = np.arange(cameras, dtype=np.int32)[:, None, None] * cells
    head = np.arange(heads, dtype=np.int32)[None, None]

    # One term after the other, and gathered again for the gradient: all K samples at once are K times the result.
    @jax.checkpoint
    def add(total: Array, term: tuple[Array, Array]) -> tuple[Array, None]:
        (column, row), weight = term
        at_x = jnp.clip(jnp.round(x + column), 0, width - 1).astype(jnp.int32)
        at_y = jnp.clip(jnp.round(y + row), 0, height - 1).astype(jnp.int32)
        here = (first + at_y * width + at_x) * heads + head
        return total + table.at[here].get(mode="promise_in_bounds") * weight[..., None], None

    terms = jnp.asarray(kernel_offsets(kernel), jnp.float32), jnp.moveaxis(weights, -1, 0)
    total, _ = lax.scan(add, jnp.zeros((*location.shape[:3], depth), value.dtype), terms)
    return total.reshape(*total.shape[:2], heads * depth)


def kernel_offsets(kernel: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the offsets (x, y) of the cells of a kernel (rows, columns), column by column."""
    rows, columns = kernel
    return [(x - columns // 2, y - rows // 2) for x in range(columns) for y in range(rows)]

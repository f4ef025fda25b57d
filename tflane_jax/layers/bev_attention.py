"""BEVFormer's two attentions of bird's-eye-view queries: to the previous frame and to the cameras.

Reference: Li et al. 2022, sections 3.3 and 3.4.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.camera_queries import CameraQueries
from tflane_jax.layers.deformable import cell_units, offsets_and_logits
from tflane_jax.layers.sampling import deformable_attention

_INIT = nn.initializers.xavier_uniform()


class TemporalSelfAttention(nn.Module):
    """Deformable attention of BEV queries to the previous and the present BEV features.

    Attributes:
        dim: channels in and out.
        heads, points: sampling points per head and frame.
        value_projections: how often the value is projected; twice in OpenLane-V2's baseline and SMERF.
    """

    dim: int
    heads: int = 8
    points: int = 4
    value_projections: int = 1

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "q c"],
        history: Float[Array, "q c"],
        current: Float[Array, "q c"],
        shape: tuple[int, int],
        reference: Float[Array, "q 2 2"],
    ) -> Float[Array, "q c"]:
        """Return the attended features, without residual.

        Args:
            query: content plus position.
            history: features of the previous frame; the present ones where there is none.
            current: features of this frame, without position.
            shape: (h, w) of the grid, Q = h w.
            reference: (x, y) in [0, 1] of each query in the previous and in the present grid.
        """
        heads, points = self.heads, self.points
        frames = jnp.stack([history, current])
        project = nn.Dense(self.dim, kernel_init=_INIT, name="value_proj")
        value = frames
        for _ in range(self.value_projections):
            value = project(value)
        # The two frames are two levels of one value, each with its own softmax; the result is their mean.
        offsets, logits = offsets_and_logits(jnp.concatenate([history, query], -1), heads, 2, points)
        weights = 0.5 * jax.nn.softmax(logits, -1)
        shapes = (shape, shape)
        locations = reference[:, None, :, None] + offsets * cell_units(shapes)[None, None, :, None]
        value = value.reshape(-1, heads, self.dim // heads).astype(jnp.float32)
        attended = deformable_attention(value, shapes, locations, weights)
        return nn.Dense(self.dim, kernel_init=_INIT, name="output_proj")(attended)


class SpatialCrossAttention(nn.Module):
    """Deformable attention of BEV queries to the cameras that see their pillars.

    Attributes:
        dim: channels in and out.
        heads, points: sampling points per head and level, divided among the anchors of a pillar.
        capacity: most queries per camera, to skip those that a camera does not see; None evaluates all queries in all
            cameras, with the same result if the capacity suffices. Beyond it, the last queries of the grid do without
            that camera; their number is sown (`CameraQueries.sow_lost`).
    """

    dim: int
    heads: int = 8
    points: int = 8
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
            features: of each camera, levels concatenated; finite.
            shapes: (h, w) of each level.
            reference: (x, y) of a query's Z anchors in each image, in [0, 1].
            visible: anchors inside the image.
        """
        cameras, heads = len(features), self.heads
        value = nn.Dense(self.dim, kernel_init=_INIT, name="value_proj")(features)
        value = value.reshape(cameras, -1, heads, self.dim // heads).astype(jnp.float32)
        offsets, logits = offsets_and_logits(query, heads, len(shapes), self.points)
        weights = jax.nn.softmax(logits, (-2, -1))
        offsets = offsets * cell_units(shapes)[None, None, :, None]
        by_camera = CameraQueries.of(visible.any(-1), self.capacity)
        by_camera.sow_lost(self)
        around = jax.vmap(_around_anchors)(by_camera.take_own(reference), by_camera.take(offsets))
        # Unseen queries have weight 0, so that their gradients are zero.
        found = deformable_attention(value, shapes, around, by_camera.masked(by_camera.take(weights)))
        return nn.Dense(self.dim, kernel_init=_INIT, name="output_proj")(by_camera.mean(found))


def _around_anchors(
    reference: Float[Array, "q z 2"], offsets: Float[Array, "q heads levels p 2"]
) -> Float[Array, "q heads levels p 2"]:
    """Return sampling locations; point p of a head belongs to anchor p modulo Z."""
    *lead, points, _ = offsets.shape
    anchors = reference.shape[1]
    split = offsets.reshape(*lead, points // anchors, anchors, 2)
    return (reference[:, None, None, None] + split).reshape(offsets.shape)

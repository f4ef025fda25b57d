"""The layers of BEVFormer's encoder, and the sizes of the whole (Li et al. 2022).

Where the published code departs from the paper, an option reproduces it. `align="reference"` (TopoNet, LaneSegNet)
rotates the previous features with nearest sampling about `rotation_center`, and shifts the reference points by the
vehicle's motion. `align="bevformer"` (BEVFormer, MapTR, OpenLane-V2's baseline, SMERF) does the same with a shift along
the axes of nuScenes' lidar; on a grid with x forward, such as OpenLane-V2's, that moves the points sideways.
`temporal_value="initial"` gives every layer the queries before the first layer as the present frame;
`value_projections=2` (OpenLane-V2's baseline, SMERF) projects them twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.layers.bev_attention import SpatialCrossAttention, TemporalSelfAttention
from tflane_jax.models.prior import BevHook


@dataclass(frozen=True)
class BevFormerConfig:
    """Sizes of the encoder; the defaults are TopoNet's, `SMALL_BEVFORMER` trains on two CPU cores.

    Attributes:
        grid: cells of the BEV features; one query each.
        dim: channels; even.
        heads: attention heads.
        layers: encoder layers.
        hidden: channels inside the feed-forward part.
        dropout: probability, after each attention and inside and after the feed-forward part.
        temporal_points: sampling points per head and frame.
        spatial_points: sampling points per head and level, a multiple of `anchors`.
        anchors: heights of a pillar.
        levels: feature levels of an image.
        cameras: most cameras; each has its own embedding.
        capacity: queries that one camera can serve, None for all (see `layers.bev_attention`); `check_capacity` tells
            whether it suffices.
        align: how the previous features come into the present frame, see the top of this file.
        rotation_center: (column, row) of the rotation where `align` is not "warp", in cells from the grid's corner;
            None is the vehicle. TopoNet's published (50, 100) on 200 x 100 cells is not the vehicle.
        temporal_value: the present frame's value in temporal attention, see the top of this file.
        value_projections: how often temporal attention projects its value.
        remat: recompute each layer's activations for the gradient instead of keeping them.
        precision: of the projections; parameters, sampling locations and results are float32.
    """

    grid: BevGrid = BevGrid()
    dim: int = 256
    heads: int = 8
    layers: int = 3
    hidden: int = 512
    dropout: float = 0.1
    temporal_points: int = 4
    spatial_points: int = 8
    anchors: int = 4
    levels: int = 4
    cameras: int = 7
    capacity: int | None = None
    align: Literal["warp", "reference", "bevformer"] = "warp"
    rotation_center: tuple[float, float] | None = None
    temporal_value: Literal["running", "initial"] = "running"
    value_projections: int = 1
    remat: bool = False
    precision: Literal["float32", "bfloat16"] = "float32"

    @property
    def dtype(self) -> Any:
        """Of the projections, None for that of the parameters."""
        return jnp.bfloat16 if self.precision == "bfloat16" else None


SMALL_BEVFORMER = BevFormerConfig(
    BevGrid(rows=25, columns=50), dim=64, layers=1, hidden=128, dropout=0.0, spatial_points=4, levels=2
)


@struct.dataclass
class BevMemory:
    """What one frame hands to the next.

    Attributes:
        features: (h, w, c) BEV features of the previous frame, in that frame's ego frame.
        valid: () false at the start of a sequence; then `features` is never looked at.
    """

    features: Float[Array, "h w c"]
    valid: Bool[Array, ""]

    @classmethod
    def empty(cls, config: BevFormerConfig) -> BevMemory:
        """Return the memory at the start of a sequence."""
        shape = (config.grid.rows, config.grid.columns, config.dim)
        return cls(jnp.zeros(shape, jnp.float32), jnp.zeros((), bool))


class BevEncoder(nn.Module):
    """The layers."""

    config: BevFormerConfig

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        position: Float[Array, "q c"],
        tokens: Float[Array, "v hw c"],
        shapes: tuple[tuple[int, int], ...],
        reference: Float[Array, "v q z 2"],
        visible: Bool[Array, "v q z"],
        history: BevMemory,
        shift: Float[Array, "2"],
        deterministic: bool,
        fuse: BevHook | None = None,
    ) -> Float[Array, "q c"]:
        """Return the encoded queries; see `BevFormer.encode` and the attentions for the arguments."""
        config, initial = self.config, queries
        here = jnp.asarray(cell_points(config.grid))
        before = here + jnp.where(history.valid, shift, 0.0)[None]
        cells = jnp.stack([before, here], 1)
        past = history.features.reshape(queries.shape)
        # Static arguments: the module itself counts as the first.
        layer = nn.remat(BevEncoderLayer, static_argnums=(8, 9, 10)) if config.remat else BevEncoderLayer
        for i in range(config.layers):
            # Without a memory the queries look at themselves twice.
            previous = jnp.where(history.valid, past, queries)
            looked_at = queries
            if config.temporal_value == "initial":
                looked_at = jnp.where(history.valid, initial, queries)
            queries = layer(config, name=f"layer_{i}")(
                queries,
                position,
                (previous, looked_at),
                cells,
                tokens,
                reference,
                visible,
                shapes,
                deterministic,
                None if fuse is None else partial(fuse, i, cell_points(config.grid)),
            )
        return queries


class BevEncoderLayer(nn.Module):
    """Temporal self-attention, spatial cross-attention, feed-forward part; a norm behind each."""

    config: BevFormerConfig

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        position: Float[Array, "q c"],
        frames: tuple[Float[Array, "q c"], Float[Array, "q c"]],
        cells: Float[Array, "q 2 2"],
        tokens: Float[Array, "v hw c"],
        reference: Float[Array, "v q z 2"],
        visible: Bool[Array, "v q z"],
        shapes: tuple[tuple[int, int], ...],
        deterministic: bool,
        fuse: Callable[[Float[Array, "q c"], Float[Array, "q c"]], Float[Array, "q c"]] | None = None,
    ) -> Float[Array, "q c"]:
        """Return the queries after the layer; `frames` are what temporal attention looks at, previous and present."""
        config, grid = self.config, self.config.grid
        init = nn.initializers.xavier_uniform()

        def add(x, change, name):
            change = nn.Dropout(config.dropout, name=f"{name}_dropout")(change, deterministic=deterministic)
            return nn.LayerNorm(epsilon=1e-5, name=f"{name}_norm")(x + change.astype(jnp.float32))

        temporal = TemporalSelfAttention(
            config.dim,
            config.heads,
            config.temporal_points,
            config.value_projections,
            config.dtype,
            name="temporal_attention",
        )
        queries = add(queries, temporal(queries + position, *frames, (grid.rows, grid.columns), cells), "temporal")
        spatial = SpatialCrossAttention(
            config.dim, config.heads, config.spatial_points, config.capacity, config.dtype, name="spatial_attention"
        )
        queries = add(queries, spatial(queries, tokens, shapes, reference, visible), "spatial")
        # Barriers, so that a prior that is absent leaves what a layer without priors computes, to the bit.
        queries = lax.optimization_barrier(queries)
        if fuse is not None:
            queries = lax.optimization_barrier(fuse(queries, position))
        x = nn.relu(nn.Dense(config.hidden, kernel_init=init, dtype=config.dtype, name="expand")(queries))
        x = nn.Dropout(config.dropout, name="hidden_dropout")(x, deterministic=deterministic)
        x = nn.Dense(config.dim, kernel_init=init, dtype=config.dtype, name="contract")(x)
        return add(queries, x, "feed_forward")

"""BEVFormer's encoder layers and its configuration (Li et al. 2022; docs/reference/bevformer.md).

By default, previous features are warped into the present frame ("warp"). Options reproduce published code that departs
from the paper:

- `align="reference"` (TopoNet, LaneSegNet) rotates the previous features with nearest sampling about `rotation_center`,
  and shifts the reference points by the vehicle's motion.
- `align="bevformer"` (BEVFormer, MapTR, OpenLane-V2's baseline, SMERF) does the same with a shift along the axes of
  nuScenes' lidar; on a grid with x forward, such as OpenLane-V2's, this moves the points sideways.
- `temporal_value="initial"`: in every layer, the value of the present frame is the queries before the first layer.
- `image_size="array"` (BEVFormer, MapTR): cameras also see points over the padding of their images; "first" (TopoNet,
  LaneSegNet): pixels of all cameras are divided by the size of the first image, though features cover padded arrays.
- `value_projections=2` (OpenLane-V2's baseline, SMERF): temporal attention projects its value twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry import BevGrid
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.layers.bev_attention import SpatialCrossAttention, TemporalSelfAttention
from tflane_jax.layers.geometry_kernel import GeometryKernelAttention
from tflane_jax.layers.precision import computing
from tflane_jax.layers.transformer import add_and_norm
from tflane_jax.limits import Count, FractionBelowOne, Rules, splits
from tflane_jax.models.prior import BevHook, fuse_priors


@dataclass(frozen=True)
class BevFormerConfig:
    """Sizes of the encoder. The defaults are TopoNet's; `SMALL_BEVFORMER` is small enough to train on two CPU cores.

    Attributes:
        grid: cells of the BEV features; one query per cell.
        dim: channels; even.
        heads: attention heads.
        layers: encoder layers.
        hidden: channels inside the feed-forward block.
        dropout: probability, after each attention and inside and after the feed-forward block.
        temporal_points: sampling points per head and frame.
        spatial_points: sampling points per head and level, a multiple of `anchors`.
        anchors: points per pillar, at different heights.
        attention: attention of the queries to the cameras. "deformable": BEVFormer's; "kernel": the geometry-guided
            kernel of MapTR, with a head for each anchor and one feature level. It does not use `spatial_points`.
        kernel: rows and columns of the kernel.
        levels: feature levels of an image.
        cameras: largest number of cameras; each has its own embedding.
        capacity: largest number of queries that one camera serves, None for all (see `layers.bev_attention`);
            `bevformer.check_capacity` checks it against a frame.
        memory: "previous": temporal attention reads the BEV features of the previous frame; "off": every frame stands
            alone, as in a host that was trained on single frames. The parameters are the same.
        motion: motion of the vehicle that is embedded in the queries. "moved": the motion since the previous frame, 0
            without one. "can_bus": heading, acceleration, rates and velocity, as for published weights
            (`VehicleState.can_bus`), and no motion since the previous frame.
        align: how previous features are brought into the present frame, see the module docstring.
        rotation_center: center of the rotation as (column, row), in cells from the grid's corner, unless `align` is
            "warp"; None: the vehicle. TopoNet's published (50, 100) on 200 x 100 cells is not the vehicle.
        temporal_value: the present frame's value in temporal attention, see the module docstring.
        value_projections: how many times temporal attention projects its value.
        image_size: by which the pixels of a point are divided; a camera sees what lies within it. "own": that of each
            image; "array" and "first": as in published code, see the module docstring.
        remat: recompute each layer's activations for the gradient instead of keeping them.
        precision: dtype of the projections; parameters, sampling locations and results are float32.
        initial: values of the queries and of the tables of their positions at the start of training. "mixed": normal of
            variance 1, and uniform in [0, 1]; "xavier": both Xavier-uniform, as in TopoNet and LaneSegNet, which makes
            the 20,000 queries small (within 0.017); "normal": both normal of variance 1, as in MapTR.
    """

    grid: BevGrid = BevGrid()
    dim: Count = 256
    heads: Count = 8
    layers: Count = 3
    hidden: Count = 512
    dropout: FractionBelowOne = 0.1
    temporal_points: Count = 4
    spatial_points: Count = 8
    anchors: Count = 4
    levels: Count = 4
    cameras: Count = 7
    capacity: Count | None = None
    align: Literal["warp", "reference", "bevformer"] = "warp"
    rotation_center: tuple[float, float] | None = None
    temporal_value: Literal["running", "initial"] = "running"
    value_projections: Count = 1
    remat: bool = False
    precision: Literal["float32", "bfloat16"] = "float32"
    attention: Literal["deformable", "kernel"] = "deformable"
    kernel: tuple[Count, Count] = (3, 5)
    memory: Literal["previous", "off"] = "previous"
    motion: Literal["moved", "can_bus"] = "moved"
    initial: Literal["mixed", "xavier", "normal"] = "mixed"
    image_size: Literal["own", "array", "first"] = "own"

    def limits(self) -> Rules:
        """Channels split over heads, sampling points over anchors."""
        yield "dim", self.dim % 2 == 0, "even: half of the position encoding is for rows, half for columns"
        yield splits("heads", self.heads, "dim", self.dim)
        if self.attention == "kernel":
            yield splits("anchors", self.anchors, "dim", self.dim)
            yield "levels", self.levels == 1, "1 with the geometry-guided kernel (attention)"
            yield "kernel", all(size % 2 for size in self.kernel), "of odd numbers: a cell is in its middle"
        else:
            multiple = self.spatial_points % self.anchors == 0
            yield "spatial_points", multiple, f"a multiple of anchors ({self.anchors})"


SMALL_BEVFORMER = BevFormerConfig(
    BevGrid(rows=25, columns=50), dim=64, layers=1, hidden=128, dropout=0.0, spatial_points=4, levels=2
)


@struct.dataclass
class BevMemory:
    """BEV features that one frame passes to the next.

    Attributes:
        features: (h, w, c) BEV features of the previous frame, in that frame's ego frame.
        valid: () False at the start of a sequence; `features` is then ignored.
    """

    features: Float[Array, "h w c"]
    valid: Bool[Array, ""]

    @classmethod
    def empty(cls, config: BevFormerConfig) -> BevMemory:
        """Return the memory at the start of a sequence."""
        shape = (config.grid.rows, config.grid.columns, config.dim)
        return cls(jnp.zeros(shape, jnp.float32), jnp.zeros((), bool))


class BevEncoder(nn.Module):
    """The stack of encoder layers."""

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
        """Return the encoded queries (Q, C).

        Args:
            queries: (Q, C) BEV queries, row-major.
            position: (Q, C) their position encoding.
            tokens: (V, HW, C) image features of V cameras, all levels concatenated.
            shapes: (height, width) of every level.
            reference: (V, Q, Z, 2) pillar points in each image, as fractions of its size.
            visible: (V, Q, Z) which of them the camera sees.
            history: aligned memory of the previous frame.
            shift: (2,) offset of the previous frame's sampling points, as fractions of the grid.
            deterministic: no dropout.
            fuse: how priors change the queries of each layer, after spatial attention.
        """
        config, first_queries = self.config, queries
        here = jnp.asarray(cell_points(config.grid))
        before = here + jnp.where(history.valid, shift, 0.0)[None]
        places = jnp.stack([before, here], 1)
        past = history.features.reshape(queries.shape)
        # Static are `shapes`, `deterministic` and `fuse`: the module itself is argument 0.
        layer = nn.remat(BevEncoderLayer, static_argnums=(8, 9, 10)) if config.remat else BevEncoderLayer
        for i in range(config.layers):
            # Without a memory, both frames are the queries themselves.
            previous = jnp.where(history.valid, past, queries)
            present = queries
            if config.temporal_value == "initial":
                present = jnp.where(history.valid, first_queries, queries)
            queries = layer(config, name=f"layer_{i}")(
                queries,
                position,
                (previous, present),
                places,
                tokens,
                reference,
                visible,
                shapes,
                deterministic,
                partial(fuse_priors, fuse, i),
            )
        return queries


class BevEncoderLayer(nn.Module):
    """Temporal self-attention, spatial cross-attention, feed-forward block; each followed by a norm."""

    config: BevFormerConfig

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        position: Float[Array, "q c"],
        frames: tuple[Float[Array, "q c"], Float[Array, "q c"]],
        places: Float[Array, "q 2 2"],
        tokens: Float[Array, "v hw c"],
        reference: Float[Array, "v q z 2"],
        visible: Bool[Array, "v q z"],
        shapes: tuple[tuple[int, int], ...],
        deterministic: bool,
        fuse: Callable[[Float[Array, "y x c"], Callable[[], Float[Array, "q c"]]], Float[Array, "y x c"]],
    ) -> Float[Array, "q c"]:
        """Return the queries after the layer.

        `frames` are the previous and present values of temporal attention, and `places` (Q, 2, 2) the center (x, y) of
        each cell in the previous and in the present frame, in [0, 1]. `fuse` is `fuse_priors` of this layer.
        """
        config, grid = self.config, self.config.grid
        init = nn.initializers.xavier_uniform()

        add = partial(add_and_norm, dropout=config.dropout, deterministic=deterministic)

        temporal = TemporalSelfAttention(
            config.dim,
            config.heads,
            config.temporal_points,
            config.value_projections,
            name="temporal_attention",
        )
        with computing(config.precision):
            attended = temporal(queries + position, *frames, (grid.rows, grid.columns), places)
        queries = add("temporal", queries, attended)
        if config.attention == "kernel":
            spatial = GeometryKernelAttention(
                config.dim, config.anchors, config.kernel, config.capacity, name="spatial_attention"
            )
        else:
            spatial = SpatialCrossAttention(
                config.dim, config.heads, config.spatial_points, config.capacity, name="spatial_attention"
            )
        with computing(config.precision):
            attended = spatial(queries, tokens, shapes, reference, visible)
        queries = add("spatial", queries, attended)
        queries = fuse(queries.reshape(grid.rows, grid.columns, -1), lambda: position).reshape(queries.shape)
        with computing(config.precision):
            x = nn.relu(nn.Dense(config.hidden, kernel_init=init, name="expand")(queries))
            x = nn.Dropout(config.dropout, name="hidden_dropout")(x, deterministic=deterministic)
            x = nn.Dense(config.dim, kernel_init=init, name="contract")(x)
        return add("feed_forward", queries, x)

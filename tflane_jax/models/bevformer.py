"""BEVFormer: feature maps of several cameras, and the previous frame's BEV features, to BEV features.

Source: Li et al. 2022, and TopoNet's "BEV constructer" (docs/reference/bevformer.md). The module encodes one frame; the
memory is an explicit carry.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry.namespace import product
from tflane_jax.geometry.pillars import pillar_points, project_pillars
from tflane_jax.geometry.poses import pose_yaw
from tflane_jax.layers.bev_alignment import ego_shift, rotate_nearest, vehicle_center, warp
from tflane_jax.layers.positions import LearnedImageEncoding
from tflane_jax.models.bev_encoder import BevEncoder, BevFormerConfig, BevMemory
from tflane_jax.models.prior import BevHook
from tflane_jax.scene import CameraViews

# Length of the published code's vector of vehicle motion ("CAN bus").
MOTION = 18
_NORMAL, _XAVIER = nn.initializers.normal(1.0), nn.initializers.xavier_uniform()
# Of queries and position tables, by `BevFormerConfig.initial`.
_INITIAL = {
    "mixed": (_NORMAL, nn.initializers.uniform(1.0)),
    "xavier": (_XAVIER, _XAVIER),
    "normal": (_NORMAL, _NORMAL),
}


class BevFormer(nn.Module):
    """BEV encoder of one frame."""

    config: BevFormerConfig

    def __call__(
        self,
        features: Sequence[Float[Array, "v _h _w c"]],
        cameras: CameraViews,
        memory: BevMemory | None,
        previous_from_ego: Float[Array, "4 4"],
        *,
        deterministic: bool = True,
        fuse: BevHook | None = None,
    ) -> Float[Array, "y x c"]:
        """Return the BEV features (rows, columns, C).

        Args:
            features: levels (V, h, w, C) of the image encoder, finest first.
            cameras: calibration and validity of the V cameras; of the images, only the shape is used.
            memory: of the previous frame; None is equivalent to an invalid memory.
            previous_from_ego: (4, 4) pose of this ego frame in the previous one; ignored for an invalid memory.
            deterministic: no dropout. False needs the random key `dropout`.
            fuse: how priors change the queries of each layer, after spatial attention.

        Raises:
            UserError: more cameras, or another number of levels, than configured.
        """
        config = self.config
        if memory is None:
            memory, previous_from_ego = _no_memory(config)
        # An invalid memory's pose may be anything.
        pose = jnp.where(memory.valid, previous_from_ego, jnp.eye(4, dtype=previous_from_ego.dtype))
        history = BevMemory(jnp.where(memory.valid, memory.features, 0.0), memory.valid)
        history, shift = align(config, history, pose)
        motion = motion_vector(pose, memory.valid) if config.motion == "moved" else can_bus_vector(cameras)
        return self.encode(features, cameras, history, shift, motion, deterministic=deterministic, fuse=fuse)

    @nn.compact
    def encode(
        self,
        features: Sequence[Float[Array, "v _h _w c"]],
        cameras: CameraViews,
        history: BevMemory,
        shift: Float[Array, "2"],
        motion: Float[Array, " m"],
        *,
        deterministic: bool = True,
        fuse: BevHook | None = None,
    ) -> Float[Array, "y x c"]:
        """Return the BEV features from an aligned memory (`align`) and the vehicle's motion (`motion_vector`)."""
        config, grid = self.config, self.config.grid
        if len(features) != config.levels or len(cameras.valid) > config.cameras:
            raise UserError(
                f"the BEV encoder is configured for {config.levels} levels of at most {config.cameras} cameras and got "
                f"{len(features)} levels of {len(cameras.valid)}: change `levels` and `cameras` of BevFormerConfig"
            )
        of_queries, of_positions = _INITIAL[config.initial]
        queries = self.param("queries", of_queries, (grid.rows * grid.columns, config.dim), jnp.float32)
        queries = queries + MotionEmbedding(config.dim, name="motion")(motion)[None]
        learned = LearnedImageEncoding(grid.rows, grid.columns, config.dim // 2, of_positions, name="position")
        position = learned(grid.rows, grid.columns).reshape(-1, config.dim)

        by_camera = self.param("cameras", _NORMAL, (config.cameras, config.dim), jnp.float32)[
            : len(cameras.valid), None
        ]
        by_level = self.param("levels", _NORMAL, (config.levels, config.dim), jnp.float32)
        tokens = [
            level.reshape(len(level), -1, config.dim) + by_camera + by_level[None, i : i + 1]
            for i, level in enumerate(features)
        ]
        # Padding of invalid cameras may hold anything, NaN included.
        tokens = jnp.where(cameras.valid[:, None, None], jnp.concatenate(tokens, 1), 0.0)
        shapes = tuple((level.shape[1], level.shape[2]) for level in features)
        reference, visible = see_pillars(config, cameras)
        encoder = BevEncoder(config, name="encoder")
        encoded = encoder(queries, position, tokens, shapes, reference, visible, history, shift, deterministic, fuse)
        return encoded.reshape(grid.rows, grid.columns, config.dim)


def _no_memory(config: BevFormerConfig) -> tuple[BevMemory, Float[Array, "4 4"]]:
    # The barrier keeps XLA from simplifying the constants away, so that rounding is the same as with an invalid memory.
    return lax.optimization_barrier((BevMemory.empty(config), jnp.eye(4)))


class MotionEmbedding(nn.Module):
    """Embedding of the vehicle's motion, added to all queries."""

    dim: int

    @nn.compact
    def __call__(self, motion: Float[Array, " m"]) -> Float[Array, " c"]:
        """Return the embedding of the motion vector."""
        x = nn.relu(nn.Dense(self.dim // 2, kernel_init=_XAVIER, name="hidden")(motion))
        x = nn.relu(nn.Dense(self.dim, kernel_init=_XAVIER, name="out")(x))
        return nn.LayerNorm(epsilon=1e-5, name="norm")(x)


def see_pillars(config: BevFormerConfig, cameras: CameraViews) -> tuple[Float[Array, "v q z 2"], Bool[Array, "v q z"]]:
    """Return where each camera sees the pillar points of all queries, and which of them it sees.

    Positions are fractions of the padded image array, because the features cover that array with its padding; but see
    `BevFormerConfig.image_size`.
    """
    points = config.grid.range.denormalise(pillar_points(config.grid, config.anchors))
    height, width = cameras.image.shape[1:3]
    array, own = jnp.array([[width, height]]), jnp.asarray(cameras.size)
    size = jnp.broadcast_to({"own": own, "array": array, "first": own[:1]}[config.image_size], own.shape)
    fraction, inside = project_pillars(jnp.asarray(points), cameras.intrinsics, cameras.camera_from_ego, size)
    if config.image_size != "first":
        used = size.astype(fraction.dtype) / array.astype(fraction.dtype)
        fraction = fraction * used[:, None, None]
    return fraction, inside & cameras.valid[:, None, None]


def seen_queries(config: BevFormerConfig, cameras: CameraViews) -> Int[Array, " v"]:
    """Return the number of queries that each camera sees, (V,)."""
    return see_pillars(config, cameras)[1].any(-1).sum(-1)


def check_capacity(config: BevFormerConfig, cameras: CameraViews) -> None:
    """Raise UserError if a camera of this frame sees more queries than `capacity` (runs on the host, not traced)."""
    most = int(np.max(seen_queries(config, cameras)))
    if config.capacity is not None and most > config.capacity:
        raise UserError(
            f"a camera sees {most} cells of the BEV grid, but `capacity` of BevFormerConfig is {config.capacity}: "
            f"raise it to {most}, or leave it None"
        )


def align(
    config: BevFormerConfig, memory: BevMemory, previous_from_ego: Float[Array, "4 4"]
) -> tuple[BevMemory, Float[Array, "2"]]:
    """Return the memory in the present ego frame, and the remaining shift of temporal attention's sampling points."""
    if config.align == "warp":
        moved = warp(memory.features, config.grid, previous_from_ego)
        return BevMemory(moved, memory.valid), jnp.zeros(2, moved.dtype)
    center = config.rotation_center or vehicle_center(config.grid)
    turned = rotate_nearest(memory.features, pose_yaw(previous_from_ego), center)
    axes = "lidar" if config.align == "bevformer" else "ego"
    return BevMemory(turned, memory.valid), ego_shift(config.grid, previous_from_ego, axes)


def motion_vector(previous_from_ego: Float[Array, "4 4"], valid: Bool[Array, ""]) -> Float[Array, " m"]:
    """Return the vehicle's motion since the previous frame, in the layout of BEVFormer's CAN-bus vector; 0 without one.

    Entries 0 to 2: translation in metres along the present axes; 16 and 17: yaw in radians and degrees. All others are
    0: BEVFormer's absolute heading and bus signals do not determine lanes.
    """
    moved = product(previous_from_ego[:3, :3].T, previous_from_ego[:3, 3])
    yaw = pose_yaw(previous_from_ego)
    turned = jnp.stack([yaw, jnp.rad2deg(yaw)])
    motion = jnp.concatenate([moved, jnp.zeros(MOTION - 5, moved.dtype), turned])
    return jnp.where(valid, motion, 0.0)


def can_bus_vector(cameras: CameraViews) -> Float[Array, " m"]:
    """Return the CAN-bus vector as published code has it for a frame without a previous one: no position, no turn.

    Raises UserError if the data have no CAN bus.
    """
    vehicle = cameras.vehicle
    if vehicle is None or vehicle.can_bus is None:
        raise UserError(
            "the BEV encoder reads the vehicle's CAN bus (motion), and these data have none: set data.can_bus "
            "(nuScenes, OpenLane-V2), or task.model.encoder.bev.motion to moved"
        )
    return jnp.asarray(vehicle.can_bus).at[:3].set(0.0).at[-1].set(0.0)

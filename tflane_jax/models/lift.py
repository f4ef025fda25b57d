"""BEV features by lifting image features along their depth (LSS, Philion and Fidler 2020; BEVDepth), as MapTRv2 has it.

Every cell of a feature map is a ray of points, one for each depth bin. Each point gives its cell of the BEV grid the
context of its image cell times the probability of its bin. The sum over all points is taken bin by bin: the 153,000
points x 256 channels of the published size are never stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange, invert_pose
from tflane_jax.geometry.namespace import product
from tflane_jax.geometry.pillars import cell_points
from tflane_jax.layers.batch_norm import BatchNorm
from tflane_jax.layers.depth_net import DepthNet
from tflane_jax.layers.positions import sine_encoding
from tflane_jax.layers.precision import Precision, run_layer, run_part
from tflane_jax.limits import Count, FractionBelowOne, Positive, Rules
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.prior import BevHook, fuse_priors
from tflane_jax.scene import CameraViews


@dataclass(frozen=True)
class LiftConfig:
    """Sizes of the lift. The defaults are MapTRv2's on nuScenes.

    Attributes:
        grid: cells of the BEV features.
        fine: points are collected in cells `fine` (1 or 2) times as fine as those of the grid, along each axis.
        dim: channels of the image features and of the BEV features.
        cameras: largest number of cameras.
        depth: first, last (excluded) and size of the depth bins, metres.
        pyramid: channels of each branch of the dilated convolutions in the depth network.
        dropout: probability in the depth network.
        image_scale: of the images, relative to the camera's own. Inputs of the depth network are the cameras'
            native intrinsics and this scale.
        supervised: whether the network learns the depth of image cells, for which the training data must have it.
        precision: dtype of convolutions, see `layers.precision`; parameters, depth and BEV features are float32.
        remat: recompute the activations of depth network and convolutions for the gradient instead of keeping them.
        border: "exact": points outside the range are left out. "published": those up to a cell below its lower ends
            count for the first cells, as the published code's rounding towards zero has it.
    """

    grid: BevGrid = BevGrid(PerceptionRange((-30.0, 30.0), (-15.0, 15.0), (-10.0, 10.0)), 100, 200)
    fine: Literal[1, 2] = 2
    dim: Count = 256
    cameras: Count = 6
    depth: tuple[Positive, Positive, Positive] = (1.0, 35.0, 0.5)
    pyramid: Count = 96
    dropout: FractionBelowOne = 0.5
    image_scale: Positive = 0.5
    supervised: bool = False
    border: Literal["exact", "published"] = "exact"
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Whole depth bins follow each other from the first depth to the last; channels encode positions."""
        yield "dim", self.dim % 4 == 0, "a multiple of 4, for sine and cosine of x and y"
        first, last, size = self.depth
        count = (last - first) / size
        fits = first + size <= last and abs(count - round(count)) < 1e-6
        whole = f"(first, last, size of a bin), with whole bins from first to last, not {count:g} of them"
        yield "depth", fits, whole

    @property
    def bins(self) -> int:
        """Number of depth bins."""
        low, high, step = self.depth
        return round((high - low) / step)


class LiftEncoder(nn.Module):
    """From image features to BEV features."""

    config: LiftConfig

    @nn.compact
    def encode(
        self,
        features: Float[Array, "v h w c"],
        cameras: Float[Array, "v p"],
        points: Float[Array, "v d h w 3"],
        valid: Bool[Array, " v"] | None = None,
        *,
        train: bool,
        fuse: BevHook | None = None,
    ) -> tuple[Float[Array, "y x c"], Float[Array, "v h w d"]]:
        """Return BEV features, row 0 at the smallest y, column 0 at the smallest x; and depth logits.

        Args:
            features: of V cameras; finite.
            cameras: parameters of the cameras, see `camera_vector`.
            points: of the rays, metres, ego frame (`ray_points`); NaN for those of a camera that does not exist.
            valid: which cameras count in the batch statistics; None for all.
            train: norms use batch statistics, and dropout is on.
            fuse: how priors change the BEV features, once; positions are a sine encoding of (x, y).
        """
        config, grid = self.config, self.config.grid
        network = partial(DepthNet, config.dim, config.bins, config.pyramid, config.dropout, name="depth_net")
        logits, context = run_layer(self, network, config, features, cameras, valid, train=train)
        rows, columns = grid.rows * config.fine, grid.columns * config.fine
        cells = cell_numbers(points, BevGrid(grid.range, rows, columns), config.border)
        x = collect(context, jax.nn.softmax(logits, -1), cells, rows * columns).reshape(rows, columns, config.dim)
        bev = run_part(self, partial(_convolved, train), config, x)
        position = partial(sine_encoding, jnp.asarray(cell_points(grid)), config.dim // 4, lowest=0.125)
        return fuse_priors(fuse, 0, bev, position), logits

    def __call__(
        self,
        levels: Sequence[Float[Array, "v _h _w c"]],
        cameras: CameraViews,
        *,
        train: bool,
        fuse: BevHook | None = None,
    ) -> Float[Array, "y x c"]:
        """Return BEV features, from feature maps that cover the image arrays of calibrated cameras.

        Sows the depth logits as auxiliary output `depth`, if the depth is supervised.

        Args:
            levels: one level of feature maps.
            cameras: calibration and validity; of the images, only the shape is used.
            train, fuse: see `encode`.

        Raises:
            UserError: several levels, or more cameras than configured.
        """
        config = self.config
        if len(levels) != 1 or len(cameras.valid) > config.cameras:
            raise UserError(
                f"the lift takes one level of feature maps of at most {config.cameras} cameras and got {len(levels)} "
                f"levels of {len(cameras.valid)}: change `images` of the encoder, or `cameras` of LiftConfig"
            )
        bev, logits = self.lift(levels[0], cameras, train=train, fuse=fuse)
        if config.supervised and self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "depth", logits)
        return bev

    def lift(
        self, features: Float[Array, "v h w c"], cameras: CameraViews, *, train: bool, fuse: BevHook | None = None
    ) -> tuple[Float[Array, "y x c"], Float[Array, "v h w d"]]:
        """Return BEV features and depth logits, from feature maps and the calibration of their cameras.

        Args:
            features: of V cameras; those of an invalid camera may be anything.
            cameras: calibration and validity; of the images, only the shape is used.
            train, fuse: see `encode`.
        """
        size, shape = cameras.image.shape[1:3], (features.shape[1], features.shape[2])
        there = jnp.asarray(cameras.valid)
        valid = there[:, None, None]
        # A missing camera's calibration may be anything; it must reach neither the points nor the norms.
        eye = jnp.eye(4, dtype=jnp.float32)[None]
        pose = jnp.where(valid, cameras.camera_from_ego, eye)
        intrinsics = jnp.where(valid, cameras.intrinsics, eye[:, :3, :3])
        points = ray_points(intrinsics, pose, size, shape, self.config.depth)
        points = jnp.where(valid[..., None, None], points, jnp.nan)
        features = jnp.where(valid[..., None], features, 0.0)
        if cameras.vehicle is not None:
            # The depth network gets the cameras' poses in the vehicle's own frame.
            own = product(pose, invert_pose(jnp.asarray(cameras.vehicle.vehicle_from_ego))[None])
            pose = jnp.where(valid, own, eye)
        scale = self.config.image_scale
        affine = jnp.broadcast_to(jnp.array([[[scale, 0.0, 0.0], [0.0, scale, 0.0]]]), (len(intrinsics), 2, 3))
        vector = camera_vector(intrinsics[:, :2] / scale, affine, pose)
        return self.encode(features, vector, points, there, train=train, fuse=fuse)


def _convolved(train: bool, encoder: LiftEncoder, x: Float[Array, "fine_y fine_x c"]) -> Float[Array, "y x c"]:
    """Return the BEV features after the three convolutions, which are a part of the encoder."""
    for i, stride in enumerate((1, encoder.config.fine, 1)):
        conv = nn.Conv(
            encoder.config.dim,
            (3, 3),
            (stride, stride),
            [(1, 1), (1, 1)],
            use_bias=False,
            kernel_init=nn.initializers.xavier_uniform(),
            name=f"conv_{i}",
        )
        x = nn.relu(BatchNorm(name=f"norm_{i}")(conv(x), train=train))
    return x


def ray_points(
    intrinsics: Float[Array, "v 3 3"],
    camera_from_ego: Float[Array, "v 4 4"],
    size: tuple[int, int],
    shape: tuple[int, int],
    depth: tuple[float, float, float],
) -> Float[Array, "v d h w 3"]:
    """Return the points of the rays of all image cells, metres, ego frame.

    As in the published code, the first and last cells' rays pass through the corner pixels of the image array, and a
    bin's point lies at the bin's near end.

    Args:
        intrinsics, camera_from_ego: of the images as they are.
        size: (rows, columns) of the image array, pixels.
        shape: (h, w) of the feature maps.
        depth: first, last (excluded) and size of the bins, metres.
    """
    low, high, step = depth
    d = low + step * jnp.arange(round((high - low) / step), dtype=jnp.float32)
    v, u = (jnp.linspace(0.0, pixels - 1.0, cells) for pixels, cells in zip(size, shape, strict=True))
    d, v, u = jnp.meshgrid(d, v, u, indexing="ij")
    pixels = jnp.stack([u * d, v * d, d], -1).reshape(-1, 3)

    def one(intrinsics, camera_from_ego):
        local = product(pixels, jnp.linalg.inv(intrinsics).T)
        return product(local - camera_from_ego[None, :3, 3], camera_from_ego[:3, :3])

    return jax.vmap(one)(intrinsics, camera_from_ego).reshape(len(intrinsics), *d.shape, 3)


def camera_vector(
    native: Float[Array, "v 2 3"], affine: Float[Array, "v 2 3"], camera_from_ego: Float[Array, "v 4 4"]
) -> Float[Array, "v 22"]:
    """Return the parameters of each camera that are inputs of the depth network.

    Focal lengths and center of the native image, the rows of the affine map, and the camera's pose in the ego frame
    (3 x 4).

    Args:
        native: the first two rows of the intrinsics of the native images, pixels.
        affine: maps pixels of the native images to those of the images.
        camera_from_ego: extrinsics, metres; from the vehicle's own frame where that is known.
    """
    count = len(native)
    lens = jnp.stack([native[:, 0, 0], native[:, 1, 1], native[:, 0, 2], native[:, 1, 2]], -1)
    rotation = camera_from_ego[:, :3, :3].swapaxes(1, 2)
    place = -jnp.einsum("vij,vj->vi", rotation, camera_from_ego[:, :3, 3], precision="highest")
    pose = jnp.concatenate([rotation, place[..., None]], -1).reshape(count, 12)
    return jnp.concatenate([lens, affine.reshape(count, 6), pose], -1)


def cell_numbers(
    points: Float[Array, "*b 3"], grid: BevGrid, border: Literal["exact", "published"]
) -> Int[Array, "*b"]:
    """Return the number of the cell of each point, row by row; the number of cells for one outside the range or NaN."""
    count = jnp.array([grid.columns, grid.rows, 1], jnp.float32).reshape((1,) * (points.ndim - 1) + (3,))
    place = grid.range.normalise(points) * count
    above = place > -1.0 if border == "published" else place >= 0.0
    inside = (above & (place < count)).all(-1)
    column, row = (jnp.where(inside, place[..., axis], 0.0).astype(jnp.int32) for axis in (0, 1))
    return jnp.where(inside, row * grid.columns + column, grid.rows * grid.columns)


def collect(
    context: Float[Array, "v h w c"],
    depth: Float[Array, "v h w d"],
    cells: Int[Array, "v d h w"],
    count: int,
) -> Float[Array, "n c"]:
    """Return for each of N = `count` cells the sum over its points of context times depth probability.

    Args:
        context: features of the image cells.
        depth: probabilities of the bins.
        cells: of the points; numbers from `count` on are left out.
        count: N.
    """
    flat = context.reshape(-1, context.shape[-1])
    parts = (
        jnp.moveaxis(depth, -1, 0).reshape(depth.shape[-1], -1),
        jnp.moveaxis(cells, 1, 0).reshape(depth.shape[-1], -1),
    )

    def add(total, part):
        probability, cell = part
        return total.at[cell].add(probability[:, None] * flat, mode="drop"), None

    return lax.scan(add, jnp.zeros((count, flat.shape[1]), flat.dtype), parts)[0]

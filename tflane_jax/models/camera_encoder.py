"""Camera encoder: images of one frame to BEV features and front-view features.

Images -> image encoder -> feature maps of all cameras -> BEVFormer, or lift by depth -> BEV features. The feature maps
of the front camera also go to the traffic-element decoder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import Rules
from tflane_jax.models.auxiliary import AUXILIARY, AuxiliaryName, LaneCellHead, LineMaskHead
from tflane_jax.models.bev_encoder import SMALL_BEVFORMER, BevFormerConfig, BevMemory
from tflane_jax.models.bevformer import BevFormer
from tflane_jax.models.image_encoder import PAPER_IMAGE_ENCODER, ImageEncoder, ImageEncoderConfig
from tflane_jax.models.lift import LiftConfig, LiftEncoder
from tflane_jax.models.prior import BevHook
from tflane_jax.scene import Example


@dataclass(frozen=True)
class CameraEncoderConfig:
    """The camera encoder. The defaults train on two CPU cores; `PAPER_CAMERA_ENCODER` has TopoNet's sizes.

    Attributes:
        images: from images to feature maps.
        bev: from feature maps to BEV features: BEVFormer, or the lift of MapTRv2, which has no memory and takes one
            level. Levels and channels must match those of `images`.
        cells: predict for every BEV cell whether a lane passes through it, its offset and direction, for the auxiliary
            loss `losses.lane_cells`. Not in the papers; it speeds up training of small models.
        line_masks: predict for every cell of the finest feature maps whether a map line passes through it, for
            MapTRv2's loss.
    """

    images: ImageEncoderConfig = ImageEncoderConfig()
    bev: BevFormerConfig | LiftConfig = SMALL_BEVFORMER
    cells: bool = False
    line_masks: bool = False

    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""

    def build(self) -> nn.Module:
        """Return the module, which is called as `CameraEncoder` is and returns an `EncoderOutput`."""
        return CameraEncoder(self)

    def limits(self) -> Rules:
        """BEV features are made of the pyramid's levels and channels."""
        pyramid = self.images.pyramid
        levels = self.bev.levels if isinstance(self.bev, BevFormerConfig) else 1
        yield "bev.dim", self.bev.dim == pyramid.dim, f"that of the image features (images.pyramid.dim, {pyramid.dim})"
        yield "images.pyramid.levels", pyramid.levels == levels, f"{levels}, the levels that bev takes"

    @property
    def learned(self) -> dict[AuxiliaryName, str]:
        """Auxiliary outputs for which a host needs a loss, and the setting that asks for each."""
        asked: dict[AuxiliaryName, tuple[str, bool]] = {
            "view_line_masks": ("line_masks", self.line_masks),
            "depth": ("bev.supervised", isinstance(self.bev, LiftConfig) and self.bev.supervised),
        }
        return {name: setting for name, (setting, wanted) in asked.items() if wanted}

    @property
    def bev_range(self) -> PerceptionRange:
        """The box that the BEV features cover, metres."""
        return self.bev.grid.range


PAPER_CAMERA_ENCODER = CameraEncoderConfig(PAPER_IMAGE_ENCODER, BevFormerConfig(initial="xavier"))


class FrontView(NamedTuple):
    """Features of the front camera, the input of the traffic-element decoder.

    Attributes:
        features: levels (h, w, C), finest first.
        size: width and height of the image, pixels; zeros where the camera delivered none.
        padded: (rows, columns) of the padded image array.
    """

    features: Sequence[Float[Array, "_h _w c"]]
    size: Int[Array, " 2"]
    padded: tuple[int, int]


class EncoderOutput(NamedTuple):
    """Outputs of an encoder for one example.

    Attributes:
        bev: (h, w, C) BEV features, row 0 at the smallest y, column 0 at the smallest x.
        front: features of the front camera; None without cameras.
        memory: BEV memory for the next frame; None without cameras, or with memory off.
    """

    bev: Float[Array, "y x c"]
    front: FrontView | None = None
    memory: BevMemory | None = None


class CameraEncoder(nn.Module):
    """From the images of one frame and the memory of the previous frame to BEV features."""

    config: CameraEncoderConfig

    @nn.compact
    def __call__(
        self, example: Example, memory: BevMemory | None, *, train: bool, fuse: BevHook | None = None
    ) -> EncoderOutput:
        """Return BEV features, front view and memory; raises UserError if the example has no images."""
        cameras = example.cameras
        if cameras is None:
            raise UserError("the model reads camera images, and these data have none: choose data with cameras")
        levels = ImageEncoder(self.config.images, name="images")(cameras, train=train)
        if self.config.line_masks and self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "view_line_masks", LineMaskHead(name="view_mask_head")(levels[0]))
        if isinstance(self.config.bev, LiftConfig):
            bev, following = LiftEncoder(self.config.bev, name="bev")(levels, cameras, train=train, fuse=fuse), None
        else:
            remembers = self.config.bev.memory == "previous"
            bev = self._bevformer(self.config.bev, levels, example, memory if remembers else None, train, fuse)
            following = BevMemory(bev, jnp.ones((), bool)) if remembers else None
        if self.config.cells:
            LaneCellHead(name="cells")(bev)
        size = jnp.where(cameras.valid[0], cameras.size[0], 0)
        padded = cameras.image.shape[1], cameras.image.shape[2]
        front = FrontView([level[0] for level in levels], size, padded)
        return EncoderOutput(bev, front, following)

    def _bevformer(self, config, levels, example, memory, train, fuse) -> Float[Array, "y x c"]:
        if memory is not None:
            # No gradient through time, as in the published code; a new scene starts without memory.
            memory = BevMemory(lax.stop_gradient(memory.features), memory.valid & example.has_previous)
        return BevFormer(config, name="bev")(
            levels, example.cameras, memory, jnp.asarray(example.previous_from_ego), deterministic=not train, fuse=fuse
        )

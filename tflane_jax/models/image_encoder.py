"""From camera images to feature maps: ResNet and feature pyramid on a stack of views (docs/reference/bevformer.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from tflane_jax.layers.fpn import FeaturePyramid, FeaturePyramidConfig
from tflane_jax.layers.precision import computing, full
from tflane_jax.layers.resnet import RESNET_50, ResNet, ResNetConfig
from tflane_jax.limits import INCREASING, NOT_EMPTY, CountOrZero, Rules
from tflane_jax.scene import CameraViews

# ImageNet statistics, RGB, of values in [0, 255].
MEAN_RGB = (123.675, 116.28, 103.53)
STD_RGB = (58.395, 57.12, 57.375)


@dataclass(frozen=True)
class ImageEncoderConfig:
    """Sizes of the encoder. The defaults train on two CPU cores; `PAPER_IMAGE_ENCODER` has the papers' sizes.

    Attributes:
        backbone: sizes of the ResNet.
        stages: backbone stages whose features enter the pyramid, from 0; 1, 2, 3 are C3 to C5.
        pyramid: sizes of the feature pyramid.
        frozen_stages: frozen parts of the backbone: 1, the stem; 2, the first stage as well. Their gradient is zero,
            and weight decay skips them.
        remat: recompute each stage's activations for the gradient instead of keeping them.
        precision: dtype of the computation; parameters and results are float32.
    """

    backbone: ResNetConfig = ResNetConfig((1, 1, 1, 1), (16, 32, 64, 128))
    stages: Annotated[tuple[CountOrZero, ...], INCREASING, NOT_EMPTY] = (2, 3)
    pyramid: FeaturePyramidConfig = FeaturePyramidConfig(64, 2)
    frozen_stages: CountOrZero = 0
    remat: bool = False
    precision: Literal["float32", "bfloat16"] = "float32"

    def limits(self) -> Rules:
        """Stages exist, and the pyramid has a level for each that it takes."""
        stages = len(self.backbone.blocks)
        yield "stages", max(self.stages) < stages, f"stages of the backbone, from 0 to {stages - 1}"
        taken = len(self.stages)
        yield "pyramid.levels", self.pyramid.levels >= taken, f"at least {taken}, one for each of stages"
        yield "frozen_stages", self.frozen_stages <= stages + 1, f"at most {stages + 1}: the stem and {stages} stages"


# TopoNet, LaneSegNet and OpenLane-V2's baseline: ResNet-50 from ImageNet with frozen norms, C3 to C5, four levels.
PAPER_IMAGE_ENCODER = ImageEncoderConfig(
    replace(RESNET_50, frozen_norms=True), (1, 2, 3), FeaturePyramidConfig(256, 4), frozen_stages=2
)


class ImageEncoder(nn.Module):
    """From views to feature maps of several resolutions."""

    config: ImageEncoderConfig

    @nn.compact
    def __call__(self, cameras: CameraViews, *, train: bool = False) -> list[Float[Array, "v _h _w c"]]:
        """Return the levels (V, h, w, C), finest first.

        With `train`, norms use the statistics of the batch's valid views, unless they are frozen.
        """
        config = self.config
        dtype = jnp.bfloat16 if config.precision == "bfloat16" else None
        shown = image_valid(cameras)
        images = normalise(cameras.image, shown).astype(dtype or jnp.float32)
        backbone = ResNet(config.backbone, config.frozen_stages, config.remat, dtype, name="backbone")
        features = backbone(images, train=train, valid=cameras.valid)
        with computing(config.precision):
            levels = FeaturePyramid(config.pyramid, name="pyramid")([features[i] for i in config.stages])
        return full(levels)


def image_valid(cameras: CameraViews) -> Bool[Array, "v h w"]:
    """Return which pixels lie inside the image of a valid camera; the others are padding."""
    height, width = cameras.image.shape[1:3]
    rows = jnp.arange(height)[None, :, None] < cameras.size[:, 1, None, None]
    columns = jnp.arange(width)[None, None] < cameras.size[:, 0, None, None]
    return rows & columns & cameras.valid[:, None, None]


def normalise(image: UInt8[Array, "v h w 3"], valid: Bool[Array, "v h w"]) -> Float[Array, "v h w 3"]:
    """Return RGB images with zero mean and unit variance over ImageNet; padding is 0, the mean colour."""
    mean, std = (jnp.asarray(values, jnp.float32)[None, None, None] for values in (MEAN_RGB, STD_RGB))
    return jnp.where(valid[..., None], (image.astype(jnp.float32) - mean) / std, 0.0)

"""Weights of the reference's image encoder and BEVFormer encoder as parameters of ours.

Names and layouts: shared specs/modules.md sections 1, 3, 4 and 11.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tflane_jax.convert.lstr import RESNET
from tflane_jax.convert.renaming import Converted, Rule, below, convert, renamed_params
from tflane_jax.geometry.namespace import AnyArray

FEATURE_PYRAMID: tuple[Rule, ...] = (
    (r"lateral_convs\.(\d+)\.conv\.weight", r"lateral_\1/kernel", "conv"),
    (r"lateral_convs\.(\d+)\.conv\.bias", r"lateral_\1/bias", "vector"),
    (r"fpn_convs\.(\d+)\.conv\.weight", r"output_\1/kernel", "conv"),
    (r"fpn_convs\.(\d+)\.conv\.bias", r"output_\1/bias", "vector"),
)
IMAGE_ENCODER: tuple[Rule, ...] = (
    *below(r"img_backbone\.", "backbone", RESNET),
    *below(r"img_neck\.", "pyramid", FEATURE_PYRAMID),
)
_PROJECTIONS = "(sampling_offsets|attention_weights|value_proj|output_proj)"
TEMPORAL_ATTENTION: tuple[Rule, ...] = ((rf"{_PROJECTIONS}\.(weight|bias)", r"\1/\2", "linear"),)
SPATIAL_ATTENTION: tuple[Rule, ...] = (
    (rf"deformable_attention\.{_PROJECTIONS}\.(weight|bias)", r"\1/\2", "linear"),
    (r"output_proj\.(weight|bias)", r"output_proj/\1", "linear"),
)
ENCODER: tuple[Rule, ...] = (
    *below(r"layers\.(\d+)\.attentions\.0\.", r"layer_\1/temporal_attention", TEMPORAL_ATTENTION),
    *below(r"layers\.(\d+)\.attentions\.1\.", r"layer_\1/spatial_attention", SPATIAL_ATTENTION),
    (r"layers\.(\d+)\.ffns\.0\.layers\.0\.0\.(weight|bias)", r"layer_\1/expand/\2", "linear"),
    (r"layers\.(\d+)\.ffns\.0\.layers\.1\.(weight|bias)", r"layer_\1/contract/\2", "linear"),
    (r"layers\.(\d+)\.norms\.0\.(weight|bias)", r"layer_\1/temporal_norm/\2", "norm"),
    (r"layers\.(\d+)\.norms\.1\.(weight|bias)", r"layer_\1/spatial_norm/\2", "norm"),
    (r"layers\.(\d+)\.norms\.2\.(weight|bias)", r"layer_\1/feed_forward_norm/\2", "norm"),
)
BEV_CONSTRUCTER: tuple[Rule, ...] = (
    *below(r"encoder\.", "encoder", ENCODER),
    (r"bev_embedding\.weight", "queries", "vector"),
    (r"positional_encoding\.row_embed\.weight", "position/row", "vector"),
    (r"positional_encoding\.col_embed\.weight", "position/column", "vector"),
    (r"level_embeds", "levels", "vector"),
    (r"cams_embeds", "cameras", "vector"),
    (r"can_bus_mlp\.0\.(weight|bias)", r"motion/hidden/\1", "linear"),
    (r"can_bus_mlp\.2\.(weight|bias)", r"motion/out/\1", "linear"),
    (r"can_bus_mlp\.norm\.(weight|bias)", r"motion/norm/\1", "norm"),
)


def convert_bevformer(state: Mapping[str, AnyArray]) -> Converted:
    """Return the variables of `models.bevformer.BevFormer` from a BEV constructer's, and an account of every tensor.

    Raises:
        UserError: a tensor that the constructer does not have.
    """
    return convert(state, BEV_CONSTRUCTER, "BEVFormer")


def convert_image_encoder(state: Mapping[str, AnyArray]) -> Converted:
    """Return the variables of `models.image_encoder.ImageEncoder` with frozen norms, and an account of every tensor.

    Args:
        state: `img_backbone.` and `img_neck.` of a detector.

    Raises:
        UserError: a tensor that the image encoder does not have.
    """
    return convert(state, IMAGE_ENCODER, "the image encoder", frozen=r"backbone/(.*/)?(\w*bn\d?)/.*")


def params_of(state: Mapping[str, AnyArray], rules: tuple[Rule, ...]) -> dict[str, Any]:
    """Return the parameters of one of the parts above; raises UserError where a tensor is none of its."""
    return renamed_params(state, rules)

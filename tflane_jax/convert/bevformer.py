"""Weights of the published image encoder and BEVFormer encoder (TopoNet's copy) as parameters of ours.

The backbone has torchvision's names, the pyramid MMDetection's, and the encoder those of mmcv's transformer layers.
"""

from __future__ import annotations

from tflane_jax.convert.lstr import RESNET
from tflane_jax.convert.renaming import Rule, below

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
    # `attention` is MapTR's geometry-guided kernel.
    (rf"(?:deformable_)?attention\.{_PROJECTIONS}\.(weight|bias)", r"\1/\2", "linear"),
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

"""Weights of the heads of the published MapTR and MapTRv2 (github.com/hustvl/MapTR) as our parameters.

The reference's head holds everything behind the image encoder: the BEV encoder, its queries and the decoder.
"""

from __future__ import annotations

from tflane_jax.convert.bevformer import BEV_CONSTRUCTER
from tflane_jax.convert.lanesegnet import branch
from tflane_jax.convert.renaming import Rule, below
from tflane_jax.convert.toponet import ATTENTION, DEFORMABLE, FEED_FORWARD, LAYER, PLAIN_DECODER, REFERENCE

# Checkpoints hold embeddings of four levels; the only level has the first.
_ENCODER: tuple[Rule, ...] = (("level_embeds", "levels", "first_row"), *BEV_CONSTRUCTER)
_QUERIES_AND_HEADS: tuple[Rule, ...] = (
    (r"instance_embedding\.weight", "queries/instances", "vector"),
    (r"pts_embedding\.weight", "queries/points", "vector"),
    *branch("cls_branches", "class", norm=True),
    *branch("reg_branches", "points"),
)
MAPTR_HEAD: tuple[Rule, ...] = (
    *_QUERIES_AND_HEADS,
    *PLAIN_DECODER,
    *below(r"(?:transformer\.)?", "encoder/bev", _ENCODER),
)


def area_head(class_layers: int) -> tuple[Rule, ...]:
    """Return the rules of the areas of LaneSegNet's map-element-bucket variant: MapTR's head without BEV encoder.

    Args:
        class_layers: see `LineDecoderConfig`.
    """
    return (
        (r"instance_embedding\.weight", "queries/instances", "vector"),
        (r"pts_embedding\.weight", "queries/points", "vector"),
        *branch("cls_branches", "class", norm=True, layers=class_layers + 1),
        *branch("reg_branches", "points"),
        *PLAIN_DECODER,
    )


_NORMS = ("line_attention", "point_attention", "bev_attention", "feed_forward")
_MASK: tuple[Rule, ...] = (
    (r"0\.weight", "hidden/kernel", "conv"),
    (r"2\.weight", "out/kernel", "conv"),
    (r"2\.bias", "out/bias", "vector"),
)


def _gate(name: str, ours: str) -> tuple[Rule, ...]:
    """Return the rules of one gate of the depth network."""
    return (
        (rf"{name}_mlp\.fc1\.(weight|bias)", rf"{ours}_mlp/linear_0/\1", "linear"),
        (rf"{name}_mlp\.fc2\.(weight|bias)", rf"{ours}_mlp/linear_1/\1", "linear"),
        (rf"{name}_se\.conv_(reduce|expand)\.weight", rf"{ours}_gate/\1/kernel", "pointwise"),
        (rf"{name}_se\.conv_(reduce|expand)\.bias", rf"{ours}_gate/\1/bias", "vector"),
    )


_PYRAMID: tuple[Rule, ...] = (
    *(
        rule
        for i in range(4)
        for rule in (
            (rf"aspp{i + 1}\.atrous_conv\.weight", f"conv_{i}/kernel", "conv"),
            (rf"aspp{i + 1}\.bn\.(\w+)", rf"norm_{i}/\1", "norm"),
        )
    ),
    (r"global_avg_pool\.1\.weight", "mean/kernel", "pointwise"),
    (r"global_avg_pool\.2\.(\w+)", r"mean_norm/\1", "norm"),
    (r"conv1\.weight", "out/kernel", "conv"),
    (r"bn1\.(\w+)", r"out_norm/\1", "norm"),
)
_DEPTH_NET: tuple[Rule, ...] = (
    (r"bn\.(\w+)", r"camera_norm/\1", "norm"),
    (r"reduce_conv\.0\.weight", "reduce/kernel", "conv"),
    (r"reduce_conv\.0\.bias", "reduce/bias", "vector"),
    (r"reduce_conv\.1\.(\w+)", r"reduce_norm/\1", "norm"),
    (r"context_conv\.weight", "context/kernel", "conv"),
    (r"context_conv\.bias", "context/bias", "vector"),
    *_gate("context", "context"),
    *_gate("depth", "depth"),
    *below(r"depth_conv\.3\.", "pyramid", _PYRAMID),
    (r"depth_conv\.4\.weight", "depth/kernel", "conv"),
    (r"depth_conv\.4\.bias", "depth/bias", "vector"),
    (r"depth_conv\.(\d)\.(conv\d)\.weight", r"block_\1/\2/kernel", "conv"),
    (r"depth_conv\.(\d)\.(bn\d)\.(\w+)", r"block_\1/\2/\3", "norm"),
)
LIFT: tuple[Rule, ...] = (
    *below(r"depth_net\.", "depth_net", _DEPTH_NET),
    *((rf"downsample\.{3 * i}\.weight", f"conv_{i}/kernel", "conv") for i in range(3)),
    *((rf"downsample\.{3 * i + 1}\.(\w+)", rf"norm_{i}/\1", "norm") for i in range(3)),
    # The grid, which is a setting here.
    (r"(?:dx|bx|nx)", "", "unused"),
)
MAPTRV2_HEAD: tuple[Rule, ...] = (
    *_QUERIES_AND_HEADS,
    REFERENCE,
    *below(LAYER + r"attentions\.0\.", r"layer_\1/line_attention/attention", ATTENTION),
    *below(LAYER + r"attentions\.1\.", r"layer_\1/point_attention/attention", ATTENTION),
    *below(LAYER + r"attentions\.2\.", r"layer_\1/bev_attention", DEFORMABLE),
    *below(LAYER + r"ffns\.0\.", r"layer_\1/feed_forward", FEED_FORWARD),
    *((LAYER + rf"norms\.{i}\.(weight|bias)", rf"layer_\1/{name}_norm/\2", "norm") for i, name in enumerate(_NORMS)),
    *below(r"transformer\.encoder\.", "encoder/bev", LIFT),
    *below(r"seg_head\.", "mask_head", _MASK),
    *below(r"pv_seg_head\.", "encoder/view_mask_head", _MASK),
    # Of BEVFormer's encoder, which MapTRv2 replaces, and of the losses.
    (r"(?:positional_encoding\..*|transformer\.(?:level_embeds|cams_embeds|can_bus_mlp\..*))", "", "unused"),
    (r"loss_(pv_)?seg\.loss_fn\.pos_weight", "", "unused"),
)

"""Weights of the reference SMERF: its map encoder, and a BEV encoder that looks at the map in every layer.

Names and layouts: shared specs/modules.md sections 1, 4 and 9.
"""

from __future__ import annotations

from collections.abc import Mapping

from tflane_jax.convert.bevformer import BEV_CONSTRUCTER
from tflane_jax.convert.renaming import Converted, Rule, below, convert
from tflane_jax.geometry.namespace import AnyArray

CROSS_ATTENTION: tuple[Rule, ...] = (
    (r"multihead_attn\.in_proj_(weight|bias)", r"attention/\1", "packed"),
    (r"multihead_attn\.out_proj\.(weight|bias)", r"attention/output/\1", "linear"),
)
_LAYER = r"transformer_encoder\.layers\.(\d+)\."
SD_MAP_ENCODER: tuple[Rule, ...] = (
    (r"map_embedding\.(weight|bias)", r"lines/embed/\1", "linear"),
    (_LAYER + r"self_attn\.in_proj_(weight|bias)", r"lines/layer_\1/self_attention/\2", "packed"),
    (_LAYER + r"self_attn\.out_proj\.(weight|bias)", r"lines/layer_\1/self_attention/output/\2", "linear"),
    (_LAYER + r"linear1\.(weight|bias)", r"lines/layer_\1/feed_forward/expand/\2", "linear"),
    (_LAYER + r"linear2\.(weight|bias)", r"lines/layer_\1/feed_forward/contract/\2", "linear"),
    (_LAYER + r"norm1\.(weight|bias)", r"lines/layer_\1/attended/norm/\2", "norm"),
    (_LAYER + r"norm2\.(weight|bias)", r"lines/layer_\1/fed/norm/\2", "norm"),
)
# Before BEVFormer's rules: the norm of the map stands between the cameras' and the last.
SMERF_CONSTRUCTER: tuple[Rule, ...] = (
    *below(r"encoder\.layers\.(\d+)\.attentions\.2\.", r"encoder/layer_\1/sd_map_\1", CROSS_ATTENTION),
    (r"encoder\.layers\.(\d+)\.norms\.2\.(weight|bias)", r"encoder/layer_\1/sd_map_\1/norm/\2", "norm"),
    (r"encoder\.layers\.(\d+)\.norms\.3\.(weight|bias)", r"encoder/layer_\1/feed_forward_norm/\2", "norm"),
    *BEV_CONSTRUCTER,
)


def convert_sd_map_encoder(state: Mapping[str, AnyArray]) -> Converted:
    """Return the variables of `models.sd_map_encoder.SdMapEncoder` from those of the reference's MapGraphTransformer,
    and an account of every tensor.

    Raises:
        UserError: a tensor that the encoder does not have.
    """
    return convert(state, SD_MAP_ENCODER, "SMERF's map encoder")


def convert_smerf_bevformer(state: Mapping[str, AnyArray]) -> Converted:
    """Return the variables of `models.bevformer.BevFormer` whose layers fuse `SdMapFusion` under the name
    `sd_map_<layer>`, from SMERF's BEV constructer, and an account of every tensor.

    Raises:
        UserError: a tensor that the constructer does not have.
    """
    return convert(state, SMERF_CONSTRUCTER, "SMERF's BEVFormer")

"""Weights of the published SMERF: its map encoder, and the BEV encoder that attends to the map in every layer.

Names are those of the published state dicts (github.com/NVlabs/SMERF). In a whole detector they stand below
`map_encoder` and `bev_constructor` (`convert.hosts`).
"""

from __future__ import annotations

from tflane_jax.convert.bevformer import BEV_CONSTRUCTER
from tflane_jax.convert.renaming import Rule, below

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
# Before BEVFormer's rules, since the map's norm comes before the last one and so shifts its number.
SMERF_CONSTRUCTER: tuple[Rule, ...] = (
    *below(r"encoder\.layers\.(\d+)\.attentions\.2\.", r"encoder/layer_\1/sd_map_\1", CROSS_ATTENTION),
    (r"encoder\.layers\.(\d+)\.norms\.2\.(weight|bias)", r"encoder/layer_\1/sd_map_\1/norm/\2", "norm"),
    (r"encoder\.layers\.(\d+)\.norms\.3\.(weight|bias)", r"encoder/layer_\1/feed_forward_norm/\2", "norm"),
    *BEV_CONSTRUCTER,
)

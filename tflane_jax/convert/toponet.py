"""Weights of the heads of the published TopoNet and of BEVFormer-DETR (OpenLane-V2's baseline) as our parameters.

Names are those of the published state dicts (github.com/OpenDriveLab/TopoNet and OpenLane-V2). Decoders are built from
mmcv's layers: attentions and norms are numbered in the order in which a layer runs them.
"""

from __future__ import annotations

from tflane_jax.convert.renaming import Rule, below

DEFORMABLE: tuple[Rule, ...] = ((r"(\w+)\.(weight|bias)", r"\1/\2", "linear"),)
ATTENTION: tuple[Rule, ...] = (
    (r"attn\.in_proj_(weight|bias)", r"\1", "packed"),
    (r"attn\.out_proj\.(weight|bias)", r"output/\1", "linear"),
)
FEED_FORWARD: tuple[Rule, ...] = (
    (r"layers\.0\.0\.(weight|bias)", r"expand/\1", "linear"),
    (r"layers\.1\.(weight|bias)", r"contract/\1", "linear"),
)
SCENE_GRAPH: tuple[Rule, ...] = (
    (r"layers\.0\.0\.(weight|bias)", r"expand/\1", "linear"),
    (r"layers\.1\.0\.(weight|bias)", r"contract/\1", "linear"),
    # The graph layers hold their matrices as (in, out), as we do.
    (r"lclc_gnn_layer\.weight", "lane_lane/own/kernel", "vector"),
    (r"lclc_gnn_layer\.weight_(forward|backward)", r"lane_lane/\1/kernel", "vector"),
    (r"lcte_gnn_layer\.weight", "lane_element/kernel", "vector"),
    (r"downsample\.(weight|bias)", r"downsample/\1", "linear"),
)
RELATIONSHIP: tuple[Rule, ...] = (
    (r"MLP_o1\.layers\.(\d+)\.(weight|bias)", r"mlp_first/linear_\1/\2", "linear"),
    (r"MLP_o2\.layers\.(\d+)\.(weight|bias)", r"mlp_second/linear_\1/\2", "linear"),
    (r"classifier\.layers\.0\.(weight|bias)", r"pair/\1", "pair"),
    (r"classifier\.layers\.1\.(weight|bias)", r"pair_hidden/\1", "linear"),
    (r"classifier\.layers\.2\.(weight|bias)", r"pair_out/\1", "linear"),
)
_QUERIES = (r"query_embedding\.weight", r"queries/embedding", "vector")
REFERENCE = (r"transformer\.reference_points\.(weight|bias)", r"queries/reference/\1", "linear")
_LANE_LAYER: tuple[Rule, ...] = (
    *below(r"attentions\.0\.", "self_attention", ATTENTION),
    *below(r"attentions\.1\.", "bev_attention", DEFORMABLE),
    (r"norms\.0\.(weight|bias)", r"self_attention_norm/\1", "norm"),
    (r"norms\.1\.(weight|bias)", r"bev_attention_norm/\1", "norm"),
)
_LANE_HEADS: tuple[Rule, ...] = (
    (r"cls_branches\.(\d+)\.0\.(weight|bias)", r"heads_\1/class_0/\2", "linear"),
    (r"cls_branches\.(\d+)\.1\.(weight|bias)", r"heads_\1/class_norm_0/\2", "norm"),
    (r"cls_branches\.(\d+)\.3\.(weight|bias)", r"heads_\1/class_1/\2", "linear"),
    (r"cls_branches\.(\d+)\.4\.(weight|bias)", r"heads_\1/class_norm_1/\2", "norm"),
    (r"cls_branches\.(\d+)\.6\.(weight|bias)", r"heads_\1/class_out/\2", "linear"),
    (r"reg_branches\.(\d+)\.0\.(weight|bias)", r"heads_\1/points/linear_0/\2", "linear"),
    (r"reg_branches\.(\d+)\.2\.(weight|bias)", r"heads_\1/points/linear_1/\2", "linear"),
    (r"reg_branches\.(\d+)\.4\.(weight|bias)", r"heads_\1/points/linear_2/\2", "linear"),
)
LAYER = r"transformer\.decoder\.layers\.(\d+)\."
TOPONET_LANES: tuple[Rule, ...] = (
    _QUERIES,
    REFERENCE,
    *below(LAYER, r"layer_\1", _LANE_LAYER),
    *below(LAYER + r"ffns\.0\.", r"layer_\1/scene_graph", SCENE_GRAPH),
    (LAYER + r"norms\.2\.(weight|bias)", r"layer_\1/scene_graph_norm/\2", "norm"),
    *_LANE_HEADS,
    *below(r"lclc_branches\.(\d+)\.", r"heads_\1/successor", RELATIONSHIP),
    *below(r"lcte_branches\.(\d+)\.", r"heads_\1/element_lane", RELATIONSHIP),
    (r"te_embed_branches\.(\d+)\.0\.0\.(weight|bias)", r"element_embedding_\1/expand/\2", "linear"),
    (r"te_embed_branches\.(\d+)\.1\.(weight|bias)", r"element_embedding_\1/contract/\2", "linear"),
)
# Queries and decoder layers without scene graph: of the baseline, and of LaneSegNet.
PLAIN_DECODER: tuple[Rule, ...] = (
    _QUERIES,
    REFERENCE,
    *below(LAYER, r"layer_\1", _LANE_LAYER),
    *below(LAYER + r"ffns\.0\.", r"layer_\1/feed_forward", FEED_FORWARD),
    (LAYER + r"norms\.2\.(weight|bias)", r"layer_\1/feed_forward_norm/\2", "norm"),
)
BASELINE_LANES: tuple[Rule, ...] = (*PLAIN_DECODER, *_LANE_HEADS)
_ENCODER = r"transformer\.encoder\.layers\.(\d+)\."
ELEMENTS: tuple[Rule, ...] = (
    (r"transformer\.level_embeds", "level", "vector"),
    (r"query_embedding\.weight", "queries", "vector"),
    (r"transformer\.reference_points\.(weight|bias)", r"reference/\1", "linear"),
    *below(_ENCODER + r"attentions\.0\.", r"encoder_\1/attention", DEFORMABLE),
    *below(_ENCODER + r"ffns\.0\.", r"encoder_\1/feed_forward", FEED_FORWARD),
    (_ENCODER + r"norms\.0\.(weight|bias)", r"encoder_\1/attended/norm/\2", "norm"),
    (_ENCODER + r"norms\.1\.(weight|bias)", r"encoder_\1/fed/norm/\2", "norm"),
    *below(LAYER + r"attentions\.0\.", r"decoder_\1/self_attention", ATTENTION),
    *below(LAYER + r"attentions\.1\.", r"decoder_\1/attention", DEFORMABLE),
    *below(LAYER + r"ffns\.0\.", r"decoder_\1/feed_forward", FEED_FORWARD),
    (LAYER + r"norms\.0\.(weight|bias)", r"decoder_\1/attended/norm/\2", "norm"),
    (LAYER + r"norms\.1\.(weight|bias)", r"decoder_\1/crossed/norm/\2", "norm"),
    (LAYER + r"norms\.2\.(weight|bias)", r"decoder_\1/fed/norm/\2", "norm"),
    (r"cls_branches\.(\d+)\.(weight|bias)", r"class_\1/\2", "linear"),
    (r"reg_branches\.(\d+)\.0\.(weight|bias)", r"box_\1/hidden/linear_0/\2", "linear"),
    (r"reg_branches\.(\d+)\.2\.(weight|bias)", r"box_\1/hidden/linear_1/\2", "linear"),
    (r"reg_branches\.(\d+)\.4\.(weight|bias)", r"box_\1/out/\2", "linear"),
)

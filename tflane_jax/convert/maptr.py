"""Weights of the head of the published MapTR (github.com/hustvl/MapTR) as our parameters.

The reference's head holds everything behind the image encoder: the BEV encoder, its queries and the decoder.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tflane_jax.convert.bevformer import BEV_CONSTRUCTER
from tflane_jax.convert.lanesegnet import branch
from tflane_jax.convert.renaming import Rule, below, convert
from tflane_jax.convert.toponet import PLAIN_DECODER
from tflane_jax.geometry.namespace import AnyArray

# Checkpoints hold embeddings of four levels; the only level has the first.
_ENCODER: tuple[Rule, ...] = (("level_embeds", "levels", "first_row"), *BEV_CONSTRUCTER)
MAPTR_HEAD: tuple[Rule, ...] = (
    (r"instance_embedding\.weight", "queries/instances", "vector"),
    (r"pts_embedding\.weight", "queries/points", "vector"),
    *PLAIN_DECODER,
    *branch("cls_branches", "class", norm=True),
    *branch("reg_branches", "points"),
    *below(r"(?:transformer\.)?", "encoder/bev", _ENCODER),
)


def map_head_params(state: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Return the parameters of `MapTr` without those of the image encoder, from those of MapTRHead."""
    return convert(state, MAPTR_HEAD, "MapTR's head").variables["params"]

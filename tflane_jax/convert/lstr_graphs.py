"""LSTR's encoder as a graph encoder: a warm start from the published weights.

- **GTN**: with as many heads as LSTR, a layer whose last hop selects similarity and whose other hops select `self` is
  LSTR's layer (`models.graph_encoders`), so that every tensor has its place. The selection is new.
- **GCN and HAN** have no queries and keys, and no output projection. Their value projection becomes the product of
  LSTR's output and value projections, which is what LSTR's layer does to the mean of its attended cells. Norms and
  feed-forward networks carry over; a HAN's scores and semantic attention start afresh.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.convert.renaming import Rule, checked, size_text
from tflane_jax.errors import UserError
from tflane_jax.geometry.namespace import AnyArray
from tflane_jax.models.graph_encoders import (
    GcnEncoderConfig,
    GtnEncoderConfig,
    HanEncoderConfig,
)
from tflane_jax.models.lstr import LaneShapeEncoderConfig, LstrConfig, TransformerEncoderConfig

HEADS = 2
"""Of LSTR's attention; its weights do not tell."""

_GTN: tuple[Rule, ...] = (
    (r"self_attn\.in_proj_(weight|bias)", r"graph/\1", "packed"),
    (r"self_attn\.out_proj\.(weight|bias)", r"graph/output/\1", "linear"),
)
_ONE_PROJECTION: tuple[Rule, ...] = (
    (r"self_attn\.value_and_output\.(weight|bias)", r"graph/value/\1", "linear"),
    (r"self_attn\.(in_proj_|out_proj\.)(weight|bias)", "", "unused"),
)
GRAPH_LAYER: Mapping[type, tuple[Rule, ...]] = {
    GtnEncoderConfig: _GTN,
    GcnEncoderConfig: _ONE_PROJECTION,
    HanEncoderConfig: _ONE_PROJECTION,
}
"""Rules of what replaces self-attention in a layer, by its configuration."""
UNMAPPED: Mapping[type, str] = {HanEncoderConfig: r"params/encoder/layer_\d+/graph/(scores|semantic|question)/.*"}
"""Patterns of parameters that LSTR's weights have nothing for."""

# From here on a softmax gives the chosen type exactly 1 in float32.
_ALL = 30.0
_ATTENTION = re.compile(r"(?P<layer>.*transformer\.encoder\.layers\.\d+\.self_attn\.)in_proj_weight")


def check_encoder(model: LstrConfig, edge_weight: float) -> None:
    """Raise UserError where LSTR's weights have no place in an encoder, or `edge_weight` is no weight."""
    encoder = model.encoder
    if not 0.0 < edge_weight <= 1.0:
        raise UserError(f"the weight of the selected edge types is {edge_weight:g}: it must be above 0 and at most 1")
    if not isinstance(encoder, GtnEncoderConfig):
        if edge_weight != 1.0:
            raise UserError(f"a {type(encoder).__name__} selects no edge types, so that it takes no edge weight")
        return
    wrong = None
    if encoder.heads != HEADS or encoder.heads * encoder.head_dim != model.dim:
        sizes = f"heads {encoder.heads} of {encoder.head_dim} channels"
        wrong = f"{sizes}: LSTR has {HEADS} of {model.dim // HEADS} (task.model.encoder.heads)"
    elif encoder.similarity is None:
        wrong = "no similarity, which LSTR's attention becomes (task.model.encoder.similarity)"
    elif "self" not in encoder.relations and encoder.hops > 1:
        wrong = "no edge type self, which the hops before the last one select (task.model.encoder.relations)"
    if wrong is not None:
        raise UserError(f"LSTR's weights do not fit a GTN encoder with {wrong}")


def selections(encoder: GtnEncoderConfig, edge_weight: float) -> Float[np.ndarray, "hops channels types"]:
    """Return scores W of Eq. (1) by which the last hop selects similarity and the hops before it `self`.

    The softmax gives the selected type `edge_weight` and the others equal parts of the rest. With 1 the encoder is
    LSTR's, but the scores have no gradient; 0.98 has one.
    """
    types = len(encoder.relations) + 1
    scores = np.zeros((encoder.hops, encoder.channels, types), np.float32)
    for hop in range(encoder.hops):
        last = hop == encoder.hops - 1
        others = types - 1 - (not encoder.offers_similarity(hop))
        chosen = types - 1 if last else encoder.relations.index("self")
        sure = edge_weight == 1.0 or not others
        scores[hop, :, chosen] = _ALL if sure else math.log(edge_weight * others / (1.0 - edge_weight))
    return scores


def as_graph_state(
    state: Mapping[str, AnyArray], encoder: LaneShapeEncoderConfig
) -> tuple[Mapping[str, AnyArray], dict[str, str]]:
    """Return tensors for the rules of `GRAPH_LAYER`, and what the account says about those that a product replaces."""
    if isinstance(encoder, (GtnEncoderConfig, TransformerEncoderConfig)):
        return state, {}
    products: dict[str, Any] = {}
    remarks = {}
    for name in state:
        if not (found := _ATTENTION.fullmatch(name)):
            continue
        layer = found["layer"]
        names = [layer + part for part in ("in_proj_weight", "in_proj_bias", "out_proj.weight", "out_proj.bias")]
        if lost := [part for part in names if part not in state]:
            raise UserError(f"{lost[0]} is missing")
        product = _product(*(checked(part, np.asarray(state[part])) for part in names), where=layer)
        products |= {f"{layer}value_and_output.{key}": value for key, value in product.items()}
        remarks |= {
            f"{layer}{part}": "; its product with the output projection is the graph's value projection"
            for part in ("in_proj_weight", "in_proj_bias")
        }
    return {**state, **products}, remarks


def _product(packed: Any, packed_bias: Any, output: Any, output_bias: Any, *, where: str) -> dict[str, np.ndarray]:
    """Return one linear layer for the value projection followed by the output projection."""
    size = output.shape[0] if output.ndim else 0
    found = [size_text(tensor.shape) for tensor in (packed, packed_bias, output, output_bias)]
    if found != [size_text(shape) for shape in ((3 * size, size), (3 * size,), (size, size), (size,))]:
        raise UserError(f"{where}in_proj and out_proj have shapes {', '.join(found)}, which are none of one attention")
    weight, bias = packed[2 * size :], packed_bias[2 * size :]
    return {"weight": output @ weight, "bias": output @ bias + output_bias}

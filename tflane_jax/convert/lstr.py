"""The published LSTR weights as parameters of `models.lstr.Lstr`, every tensor accounted for.

Names are those of the published state dict (github.com/liuruijin17/LSTR); `convert.renaming` has the layouts. Networks
with a graph encoder take them too (`convert.lstr_graphs`).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp

from tflane_jax.convert.fitting import Expected, Missing, expected_variables, fitted
from tflane_jax.convert.lstr_graphs import GRAPH_LAYER, UNMAPPED, as_graph_state, check_encoder, selections
from tflane_jax.convert.renaming import Converted, Rule, below, check_types, convert, naming, put, size_text
from tflane_jax.convert.torch_file import read_checkpoint
from tflane_jax.convert.weights_files import check_digest, find_weights, is_published
from tflane_jax.errors import UserError
from tflane_jax.geometry.namespace import AnyArray
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.models.graph_encoders import GtnEncoderConfig
from tflane_jax.models.lstr import LaneShapeEncoderConfig, LstrConfig, TransformerEncoderConfig
from tflane_jax.models.parameters import Params

RESNET = (
    (r"(conv\d)\.weight", r"\1/kernel", "conv"),
    (r"bn1\.(weight|bias|running_mean|running_var)", r"bn1/\1", "norm"),
    (r"layer(\d+)\.(\d+)\.(conv\d)\.weight", r"layer\1_\2/\3/kernel", "conv"),
    (r"layer(\d+)\.(\d+)\.(bn\d)\.(\w+)", r"layer\1_\2/\3/\4", "norm"),
    (r"layer(\d+)\.(\d+)\.downsample\.0\.weight", r"layer\1_\2/downsample_conv/kernel", "conv"),
    (r"layer(\d+)\.(\d+)\.downsample\.1\.(\w+)", r"layer\1_\2/downsample_bn/\3", "norm"),
)
_ATTENTION = (
    (r"self_attn\.in_proj_(weight|bias)", r"self_attention/\1", "packed"),
    (r"self_attn\.out_proj\.(weight|bias)", r"self_attention/output/\1", "linear"),
    (r"multihead_attn\.in_proj_(weight|bias)", r"cross_attention/\1", "packed"),
    (r"multihead_attn\.out_proj\.(weight|bias)", r"cross_attention/output/\1", "linear"),
)
_FEED_FORWARD = (
    (r"linear1\.(weight|bias)", r"feed_forward/expand/\1", "linear"),
    (r"linear2\.(weight|bias)", r"feed_forward/contract/\1", "linear"),
    (r"norm1\.(weight|bias)", r"attended/norm/\1", "norm"),
)
ENCODER_LAYER = (*_ATTENTION, *_FEED_FORWARD, (r"norm2\.(weight|bias)", r"fed/norm/\1", "norm"))
_FED: tuple[Rule, ...] = (
    (r"linear1\.(weight|bias)", r"expand/\1", "linear"),
    (r"linear2\.(weight|bias)", r"contract/\1", "linear"),
    (r"norm1\.(weight|bias)", r"graph_norm/\1", "norm"),
    (r"norm2\.(weight|bias)", r"fed_norm/\1", "norm"),
)
DECODER_LAYER = (
    *_ATTENTION,
    *_FEED_FORWARD,
    (r"norm2\.(weight|bias)", r"crossed/norm/\1", "norm"),
    (r"norm3\.(weight|bias)", r"fed/norm/\1", "norm"),
)

_AROUND_THE_ENCODER: tuple[Rule, ...] = (
    *below("", "backbone", RESNET),
    (r"input_proj\.weight", "input_projection/kernel", "pointwise"),
    (r"input_proj\.bias", "input_projection/bias", "vector"),
    (r"query_embed\.weight", "queries", "vector"),
    *below(r"transformer\.decoder\.layers\.(\d+)\.", r"decoder_\1", DECODER_LAYER),
    (r"transformer\.decoder\.norm\.(weight|bias)", r"decoder_norm/\1", "norm"),
    (r"class_embed\.(weight|bias)", r"heads/class/\1", "linear"),
    (r"specific_embed\.layers\.(\d+)\.(weight|bias)", r"heads/specific/linear_\1/\2", "linear"),
    (r"shared_embed\.layers\.(\d+)\.(weight|bias)", r"heads/shared/linear_\1/\2", "linear"),
)
_ENCODER = r"transformer\.encoder\.layers\.(\d+)\."
_PUBLISHED = (*_AROUND_THE_ENCODER, *below(_ENCODER, r"encoder/layer_\1", ENCODER_LAYER))


def convert_lstr(
    state: Mapping[str, AnyArray], encoder: LaneShapeEncoderConfig | None = None, edge_weight: float = 1.0
) -> Converted:
    """Return the variables of `Lstr` (with `frozen_stem_norm`) and an account of every tensor.

    Args:
        state: tensors by PyTorch's names, with or without the prefix `module.`.
        encoder: that takes the encoder's weights; default the transformer.
        edge_weight: of the edge types that a GTN encoder selects, see `lstr_graphs.selections`.

    Raises:
        UserError: a tensor that LSTR does not have.
    """
    if encoder is None or isinstance(encoder, TransformerEncoderConfig):
        return convert(state, _PUBLISHED, "LSTR", frozen=r"backbone/bn1/.*")
    rules = below(_ENCODER, r"encoder/layer_\1", (*GRAPH_LAYER[type(encoder)], *_FED))
    state, remarks = as_graph_state(state, encoder)
    converted = convert(state, (*_AROUND_THE_ENCODER, *rules), "LSTR", frozen=r"backbone/bn1/.*")
    table = [row | {"becomes": row["becomes"] + remarks.get(row["tensor"], "")} for row in converted.table]
    if isinstance(encoder, GtnEncoderConfig):
        weights = selections(encoder, edge_weight)
        for i in range(encoder.layers):
            put(converted.variables["params"], f"encoder/layer_{i}/graph/selection", weights)
            becomes = f"encoder/layer_{i}/graph/selection: self, in the last hop similarity, weight {edge_weight:g}"
            table.append({"tensor": "-", "shape": size_text(weights.shape), "becomes": becomes})
    return Converted(converted.variables, table)


def load_lstr(
    path: Path,
    model: LstrConfig,
    missing: Missing = "left out",
    edge_weight: float = 1.0,
    entry: str | None = None,
) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters from a published checkpoint (.pth, .pkl, .npz), and the account of its tensors.

    Args:
        path: the checkpoint, or "lstr" for the published one, see `weights_files`.
        model: with any encoder.
        missing: what becomes of parameters that the checkpoint does not have: auxiliary heads, the scores of a HAN.
        edge_weight: of the edge types that a GTN encoder selects, above 0 and at most 1.
        entry: path of the weights in the file, see `torch_file.read_checkpoint`.

    Raises:
        UserError: the file cannot be read, its tensors are not exactly those of the model, the encoder has other sizes
            than LSTR's, or the network reads tensors of these sizes in another way.
    """
    path, published = find_weights(path)
    with naming(path):
        _check_meaning(model)
        check_encoder(model, edge_weight)
    unmapped = UNMAPPED.get(type(model.encoder), "(?!)")
    if missing != "fresh" and unmapped != "(?!)":
        raise UserError(
            f"{path} is of a transformer, and this encoder has parameters that it lacks: write a run by tflane convert"
        )
    with naming(path):
        checkpoint = read_checkpoint(path, entry)
        check_types(checkpoint.others, _PUBLISHED)
        check_digest(checkpoint.tensors, path, published)
        converted = convert_lstr(checkpoint.tensors, model.encoder, edge_weight)
        if is_published(checkpoint.tensors):
            _check_layers(model)
    params, table = fitted(converted, _expected(model), path, missing, unmapped)
    return params, table + checkpoint.passed_over()


def _check_meaning(model: LstrConfig) -> None:
    """Raise UserError for a network of ours in which LSTR's tensors, although they fit, mean something else."""
    _check_equal("task.model", model, LstrConfig(), ("anchors", "located"))


def _check_layers(model: LstrConfig) -> None:
    """Raise UserError for layers in which the published tensors, although they fit, mean something else.

    Heads, pre-norm and activation are options of LSTR's program: of other files they are not known.
    """
    layers = {"decoder": model.decoder}
    if isinstance(model.encoder, TransformerEncoderConfig):
        layers["encoder.layer"] = model.encoder.layer
    for name, layer in layers.items():
        _check_equal(f"task.model.{name}", layer, TransformerConfig(), ("heads", "norm_first", "activation"))


def _check_equal(part: str, found: object, needed: object, names: Iterable[str]) -> None:
    for name in names:
        value, wanted = getattr(found, name), getattr(needed, name)
        if value != wanted:
            text = f"LSTR's weights mean something else where {part}.{name} is {value!r}: they need {wanted!r}"
            raise UserError(text)


@functools.lru_cache(maxsize=4)
def _expected(model: LstrConfig) -> Expected:
    side = 64 * model.shrink  # parameters do not depend on the size of the image
    image, valid = jax.ShapeDtypeStruct((side, side, 3), jnp.float32), jax.ShapeDtypeStruct((side, side), jnp.bool_)
    return expected_variables(model.build(), (image, valid))

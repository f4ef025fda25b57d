"""The published LSTR weights as parameters of `models.lstr.Lstr`, every tensor accounted for.

Names and layouts: shared specs/modules.md sections 1 and 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from tflane_jax.convert.renaming import Converted, below, check_fits, convert, renamed_params
from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.geometry.namespace import AnyArray
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.models.lstr import LstrConfig
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
_ENCODER_LAYER = (*_ATTENTION, *_FEED_FORWARD, (r"norm2\.(weight|bias)", r"fed/norm/\1", "norm"))
_DECODER_LAYER = (
    *_ATTENTION,
    *_FEED_FORWARD,
    (r"norm2\.(weight|bias)", r"crossed/norm/\1", "norm"),
    (r"norm3\.(weight|bias)", r"fed/norm/\1", "norm"),
)

_LSTR = (
    *below("", "backbone", RESNET),
    (r"input_proj\.weight", "input_projection/kernel", "pointwise"),
    (r"input_proj\.bias", "input_projection/bias", "vector"),
    (r"query_embed\.weight", "queries", "vector"),
    *below(r"transformer\.encoder\.layers\.(\d+)\.", r"encoder/layer_\1", _ENCODER_LAYER),
    *below(r"transformer\.decoder\.layers\.(\d+)\.", r"decoder_\1", _DECODER_LAYER),
    (r"transformer\.decoder\.norm\.(weight|bias)", r"decoder_norm/\1", "norm"),
    (r"class_embed\.(weight|bias)", r"heads/class/\1", "linear"),
    (r"specific_embed\.layers\.(\d+)\.(weight|bias)", r"heads/specific/linear_\1/\2", "linear"),
    (r"shared_embed\.layers\.(\d+)\.(weight|bias)", r"heads/shared/linear_\1/\2", "linear"),
)


def convert_lstr(state: Mapping[str, AnyArray]) -> Converted:
    """Return the variables of `Lstr` (with `frozen_stem_norm`) and an account of every tensor.

    Args:
        state: tensors by PyTorch's names, with or without the prefix `module.`.

    Raises:
        UserError: a tensor that LSTR does not have.
    """
    return convert(state, _LSTR, "LSTR", frozen=r"backbone/bn1/.*")


def load_lstr(path: Path, model: LstrConfig) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters from a published checkpoint (.pth, .pkl, .npz), and the account of its tensors.

    Raises:
        UserError: the file cannot be read, or its tensors are not exactly those of the model.
    """
    state = read_state_dict(path)
    converted = convert_lstr(state)
    image = jax.ShapeDtypeStruct((360, 640, 3), jnp.float32), jax.ShapeDtypeStruct((360, 640), jnp.bool_)
    expected = dict(jax.eval_shape(model.build().init, jax.random.key(0), *image))
    check_fits(converted.variables, expected, path)
    variables = converted.variables
    return variables["params"] | {STATISTICS: variables["batch_stats"]}, converted.table


def backbone_variables(state: Mapping[str, AnyArray], *, frozen_stem_norm: bool = False) -> dict[str, Any]:
    """Return the variables of a `ResNet` from a torchvision state dict (basic or bottleneck blocks)."""
    return convert(state, RESNET, "ResNet", frozen=r"bn1/.*" if frozen_stem_norm else "(?!)").variables


def encoder_layer_params(state: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Return the parameters of `EncoderLayer` from those of `torch.nn.TransformerEncoderLayer`."""
    return renamed_params(state, _ENCODER_LAYER)


def decoder_layer_params(state: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Return the parameters of `DecoderLayer` from those of `torch.nn.TransformerDecoderLayer`."""
    return renamed_params(state, _DECODER_LAYER)

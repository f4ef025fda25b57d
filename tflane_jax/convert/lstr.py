"""The published LSTR weights as parameters of `models.lstr.Lstr`, every tensor accounted for.

Names and layouts: shared specs/modules.md sections 1 and 2. The functions are differentiable, so that gradients by our
names can be compared with gradients by PyTorch's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.errors import UserError
from tflane_jax.geometry.namespace import AnyArray
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.training.task import STATISTICS, Params

_BACKBONE = (
    (r"(conv\d)\.weight", r"\1/kernel", "conv"),
    (r"bn1\.(weight|bias|running_mean|running_var)", r"bn1/\1", "norm"),
    (r"layer(\d)\.(\d)\.(conv\d)\.weight", r"layer\1_\2/\3/kernel", "conv"),
    (r"layer(\d)\.(\d)\.(bn\d)\.(\w+)", r"layer\1_\2/\3/\4", "norm"),
    (r"layer(\d)\.(\d)\.downsample\.0\.weight", r"layer\1_\2/downsample_conv/kernel", "conv"),
    (r"layer(\d)\.(\d)\.downsample\.1\.(\w+)", r"layer\1_\2/downsample_bn/\3", "norm"),
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
# What the checkpoint counts beside its weights.
_COUNTERS = re.compile(r"(.+\.)?(num_batches_tracked|total_ops|total_params)")
_SPLIT = ("query", "key", "value")


def _below(prefix: str, name: str, rules: tuple[tuple[str, str, str], ...]) -> tuple[tuple[str, str, str], ...]:
    """Return the rules of a part that stands below a name; groups of the prefix come first."""
    shift = re.compile(prefix).groups
    moved = [(p, re.sub(r"\\(\d)", lambda m: f"\\{int(m[1]) + shift}", ours), kind) for p, ours, kind in rules]
    return tuple((prefix + pattern, f"{name}/{ours}", kind) for pattern, ours, kind in moved)


_LSTR = (
    *_below("", "backbone", _BACKBONE),
    (r"input_proj\.weight", "input_projection/kernel", "pointwise"),
    (r"input_proj\.bias", "input_projection/bias", "vector"),
    (r"query_embed\.weight", "queries", "vector"),
    *_below(r"transformer\.encoder\.layers\.(\d+)\.", r"encoder/layer_\1", _ENCODER_LAYER),
    *_below(r"transformer\.decoder\.layers\.(\d+)\.", r"decoder_\1", _DECODER_LAYER),
    (r"transformer\.decoder\.norm\.(weight|bias)", r"decoder_norm/\1", "norm"),
    (r"class_embed\.(weight|bias)", r"heads/class/\1", "linear"),
    (r"specific_embed\.layers\.(\d+)\.(weight|bias)", r"heads/specific/linear_\1/\2", "linear"),
    (r"shared_embed\.layers\.(\d+)\.(weight|bias)", r"heads/shared/linear_\1/\2", "linear"),
)


@dataclass(frozen=True)
class Converted:
    """Variables made of a state dict.

    Attributes:
        variables: `params` and `batch_stats`.
        table: one row per tensor of the file: its name and shape, and what became of it.
    """

    variables: dict[str, Any]
    table: list[dict[str, str]]


def convert_lstr(state: Mapping[str, AnyArray]) -> Converted:
    """Return the variables of `Lstr` (with `frozen_stem_norm`) and an account of every tensor.

    Args:
        state: tensors by PyTorch's names, with or without the prefix `module.`.

    Raises:
        UserError: a tensor that LSTR does not have.
    """
    table: list[dict[str, str]] = []
    variables: dict[str, Any] = {"params": {}, "batch_stats": {}}
    frozen = re.compile(r"backbone/bn1/.*")
    for name, tensor in state.items():
        plain = name.removeprefix("module.")
        if _COUNTERS.fullmatch(plain):
            table.append({"tensor": name, "shape": _size(tensor.shape), "becomes": "a counter, not needed"})
            continue
        leaves = _renamed(plain, tensor, _LSTR)
        if leaves is None:
            raise UserError(f"{name} is no tensor of LSTR: is this the checkpoint of another network?")
        for path, value in leaves.items():
            is_statistic = path.endswith(("/mean", "/var")) or frozen.fullmatch(path) is not None
            _put(variables["batch_stats" if is_statistic else "params"], path, value)
        table.append({"tensor": name, "shape": _size(tensor.shape), "becomes": ", ".join(leaves)})
    return Converted(variables, table)


def load_lstr(path: Path, model: LstrConfig) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters from a published checkpoint (.pth, .pkl, .npz), and the account of its tensors.

    Raises:
        UserError: the file cannot be read, or its tensors are not exactly those of the model.
    """
    state = read_state_dict(path)
    converted = convert_lstr(state)
    image = jax.ShapeDtypeStruct((360, 640, 3), jnp.float32), jax.ShapeDtypeStruct((360, 640), jnp.bool_)
    expected = _shapes(dict(jax.eval_shape(model.build().init, jax.random.key(0), *image)))
    found = _shapes(converted.variables)
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            raise UserError(
                f"{path} does not fit the model: {name} is {_size(found.get(name))} in the file and "
                f"{_size(expected.get(name))} in the model. Change task.model to the sizes of the file"
            )
    variables = converted.variables
    return variables["params"] | {STATISTICS: variables["batch_stats"]}, converted.table


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf.shape
            for path, leaf in jax.tree.leaves_with_path(tree)}  # fmt: skip


def _size(shape: tuple[int, ...] | None) -> str:
    return "absent" if shape is None else "x".join(map(str, shape)) or "scalar"


def backbone_variables(state: Mapping[str, AnyArray], *, frozen_stem_norm: bool = False) -> dict[str, Any]:
    """Return the variables of a `ResNet` from a torchvision state dict (basic or bottleneck blocks)."""
    variables: dict[str, Any] = {"params": {}, "batch_stats": {}}
    for name, tensor in state.items():
        for path, value in _all_renamed(name, tensor, _BACKBONE).items():
            is_statistic = path.endswith(("/mean", "/var")) or (frozen_stem_norm and path.startswith("bn1/"))
            _put(variables["batch_stats" if is_statistic else "params"], path, value)
    return variables


def encoder_layer_params(state: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Return the parameters of `EncoderLayer` from those of `torch.nn.TransformerEncoderLayer`."""
    return _params(state, _ENCODER_LAYER)


def decoder_layer_params(state: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Return the parameters of `DecoderLayer` from those of `torch.nn.TransformerDecoderLayer`."""
    return _params(state, _DECODER_LAYER)


def _params(state: Mapping[str, AnyArray], rules: tuple[tuple[str, str, str], ...]) -> dict[str, Any]:
    params: dict[str, Any] = {}
    for name, tensor in state.items():
        for path, value in _all_renamed(name, tensor, rules).items():
            _put(params, path, value)
    return params


def _all_renamed(name: str, tensor: AnyArray, rules: tuple[tuple[str, str, str], ...]) -> dict[str, Any]:
    leaves = _renamed(name, tensor, rules)
    if leaves is None:
        raise UserError(f"{name} is no tensor of this module")
    return leaves


def _renamed(name: str, tensor: AnyArray, rules: tuple[tuple[str, str, str], ...]) -> dict[str, Any] | None:
    """Return our leaves, by path, that a tensor becomes; None where no rule knows its name."""
    for pattern, ours, kind in rules:
        if found := re.fullmatch(pattern, name):
            return _leaves(found.expand(ours), tensor, kind)
    return None


def _leaves(path: str, tensor: AnyArray, kind: str) -> dict[str, Any]:
    """Return a tensor in our layout: kernels have their outputs last."""
    parent, _, last = path.rpartition("/")
    if kind == "conv":  # (O, I, h, w) -> (h, w, I, O)
        return {path: tensor.transpose(2, 3, 1, 0)}
    if kind == "pointwise":
        return {path: tensor[:, :, 0, 0].T}
    if kind == "linear":
        return {f"{parent}/kernel": tensor.T} if last == "weight" else {path: tensor}
    if kind == "norm":
        names = {"weight": "scale", "running_mean": "mean", "running_var": "var"}
        return {f"{parent}/{names.get(last, last)}": tensor}
    if kind == "packed":  # rows are query, key, value
        size = tensor.shape[0] // 3
        parts = {part: tensor[i * size : (i + 1) * size] for i, part in enumerate(_SPLIT)}
        if last == "weight":
            return {f"{parent}/{part}/kernel": value.T for part, value in parts.items()}
        return {f"{parent}/{part}/bias": value for part, value in parts.items()}
    return {path: tensor}


def _put(tree: dict[str, Any], path: str, value: Any) -> None:
    *parents, name = path.split("/")
    for parent in parents:
        tree = tree.setdefault(parent, {})
    tree[name] = value

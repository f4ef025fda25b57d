"""State dicts renamed by rules, with an account of every tensor.

A rule is (pattern of PyTorch's name, our path, kind of layer); the kind says how the layout changes. The functions are
differentiable, so that gradients by our names can be compared with gradients by PyTorch's.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.geometry.namespace import AnyArray

Rule = tuple[str, str, str]
Rules = Sequence[Rule]
_SPLIT = ("query", "key", "value")


@dataclass(frozen=True)
class Converted:
    """Variables made of a state dict.

    Attributes:
        variables: `params` and `batch_stats`.
        table: one row per tensor of the file: its name and shape, and what became of it.
    """

    variables: dict[str, Any]
    table: list[dict[str, str]]


def convert(state: Mapping[str, AnyArray], rules: Rules, network: str, frozen: str = "(?!)") -> Converted:
    """Return variables by our names, and an account of every tensor.

    Args:
        state: tensors by PyTorch's names, with or without the prefixes `module.`, `model.` and `_orig_mod.`.
        rules: the first that fits a name decides.
        network: whose tensors these should be, for the message.
        frozen: our paths of norms that never learn, whose scales and biases are statistics too.

    Raises:
        UserError: a tensor that no rule knows, that has other axes or types than weights, that holds numbers that no
            training leaves behind, or that two tensors of the file claim to be.
    """
    table: list[dict[str, str]] = []
    variables: dict[str, Any] = {"params": {}, "batch_stats": {}}
    origin: dict[str, str] = {}
    for name, tensor in state.items():
        plain, row = without_wrappers(name), {"tensor": name, "shape": size_text(tensor.shape)}
        if why := left_out(plain):
            table.append(row | {"becomes": why})
            continue
        leaves = renamed(plain, tensor, rules)
        if leaves is None:
            raise UserError(
                f"{ascii(name)[1:-1]:.200} is no tensor of {network}: is this the checkpoint of another network?"
            )
        for path, value in leaves.items():
            if path in origin:
                raise UserError(f"{name} and {origin[path]} are the same tensor of {network}: keep one of them")
            origin[path] = name
            is_statistic = path.endswith(("/mean", "/var")) or re.fullmatch(frozen, path) is not None
            put(variables["batch_stats" if is_statistic else "params"], path, value)
        unused = math.prod(tensor.shape) - sum(math.prod(value.shape) for value in leaves.values())
        becomes = ", ".join(leaves) + (f" ({unused} unused numbers left out)" if unused else "")
        table.append(row | {"becomes": becomes if leaves else "unused by the network, not needed"})
    return Converted(variables, table)


def without_wrappers(name: str) -> str:
    """Return a tensor's name without what DataParallel, or a class around the network, puts before it."""
    return _WRAPPERS.sub("", name)


def check_types(others: Mapping[str, str], rules: Rules) -> None:
    """Raise UserError if an entry that is no tensor has the name of one; `others` says what they hold, by name."""
    for name, held in others.items():
        plain = without_wrappers(name)
        sort = next((sort for pattern, _, sort in rules if re.fullmatch(pattern, plain)), "unused")
        if sort != "unused" and left_out(plain) is None:
            raise UserError(f"{name} holds {held}, expected floating-point numbers")


def left_out(name: str) -> str | None:
    """Return why a tensor that checkpoints hold beside their weights is not needed."""
    last = name.rpartition(".")[-1]
    if last in ("num_batches_tracked", "total_ops", "total_params", "n_averaged"):
        return "a counter, not needed"
    if name == last and name.startswith("ema_"):  # MMCV's hook saves the averages under the plain names
        return "the weights beside their average (MMCV's EMAHook), not taken"
    # Weights of the coordinates in the loss of MMDetection's heads, all one.
    return "a constant of the loss, not needed" if last == "code_weights" else None


@contextlib.contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Put the name of a file before the messages of the block that do not name it."""
    try:
        yield
    except UserError as error:
        raise error if str(path) in str(error) else UserError(f"{path}: {error}") from None


def check_fits(found: Any, expected: Any, path: Path | str) -> None:
    """Raise UserError naming the first leaf that only one of two trees has, or that has another shape."""
    here, there = shapes(found), shapes(expected)
    for name in sorted(here.keys() | there.keys()):
        if here.get(name) != there.get(name):
            raise UserError(
                f"{path} does not fit the model: {name} is {size_text(here.get(name))} in the file and "
                f"{size_text(there.get(name))} in the model. Change task.model to the sizes of the file"
            )


def without(tree: Any, names: Sequence[str]) -> Any:
    """Return a nested dictionary without the leaves of these paths, and without dictionaries that they leave empty."""

    def cut(branch: Any, above: str) -> Any:
        if not isinstance(branch, dict) or not branch:
            return branch
        kept = {key: cut(value, f"{above}{key}/") for key, value in branch.items() if f"{above}{key}" not in names}
        emptied = [key for key, value in kept.items() if isinstance(value, dict) and not value and branch[key]]
        return {key: value for key, value in kept.items() if key not in emptied}

    return cut(tree, "")


def shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of each leaf of nested dictionaries, by its path with slashes."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf.shape
        for path, leaf in jax.tree.leaves_with_path(tree)
    }


def size_text(shape: tuple[int, ...] | None) -> str:
    """Return a shape as "3x4"; None is absent."""
    return "absent" if shape is None else "x".join(map(str, shape)) or "scalar"


def below(prefix: str, name: str, rules: Rules) -> tuple[Rule, ...]:
    """Return the rules of a part that stands below a name, "" for none; groups of the prefix come first."""
    shift = re.compile(prefix).groups
    moved = [(p, re.sub(r"\\(\d)", lambda m: f"\\{int(m[1]) + shift}", ours), kind) for p, ours, kind in rules]
    above = f"{name}/" if name else ""
    return tuple((prefix + pattern, above + ours, kind) for pattern, ours, kind in moved)


def renamed(name: str, tensor: AnyArray, rules: Rules) -> dict[str, Any] | None:
    """Return our leaves, by path, that a tensor becomes; None where no rule knows its name."""
    for pattern, ours, kind in rules:
        if found := re.fullmatch(pattern, name):
            if kind == "unused":
                return {}
            _check_axes(name, tensor.shape, kind)
            return _leaves(found.expand(ours), checked(name, tensor), kind)
    return None


# Beyond any weight or statistic of a trained network.
_LARGEST = 1e10
_WRAPPERS = re.compile(r"(?:(?:module|model|_orig_mod)\.)*")
# Axes of a weight by the kind of layer; biases have one. Embeddings ("vector", "first_row") may have any.
_AXES = {"conv": 4, "pointwise": 4, "linear": 2, "packed": 2, "pair": 2, "norm": 1}


def _check_axes(name: str, shape: tuple[int, ...], kind: str) -> None:
    """Raise UserError if a tensor has other axes than a layer of this kind."""
    axes = _AXES.get(kind)
    if axes is None:
        return
    last = name.rpartition(".")[-1]
    axes = 1 if last.endswith("bias") else axes
    if len(shape) != axes:
        raise UserError(f"{name} has shape {size_text(shape)}, expected {axes} ax{'es' if axes > 1 else 'is'}")
    if kind == "pointwise" and axes == 4 and shape[2:] != (1, 1):
        raise UserError(f"{name} has shape {size_text(shape)}, expected a kernel of 1 x 1 pixels")
    if kind == "packed" and shape[0] % 3:
        raise UserError(f"{name} has shape {size_text(shape)}, expected rows of query, key and value: a multiple of 3")
    if kind == "pair" and axes == 2 and shape[1] % 2:
        raise UserError(f"{name} has shape {size_text(shape)}, expected two halves of equal width")


def checked(name: str, tensor: AnyArray) -> AnyArray:
    """Return a tensor as float32; raises UserError for numbers that cannot be weights. Traced values stay."""
    if not isinstance(tensor, np.ndarray):
        return tensor
    if tensor.dtype.kind != "f":
        raise UserError(
            f"{name} holds {tensor.dtype}, expected floating-point numbers: weights that are quantised or of another "
            "type are not read"
        )
    with np.errstate(over="ignore"):
        tensor = tensor.astype(np.float32, copy=False)
    if (wrong := ~np.isfinite(tensor)).any():
        index = [int(i) for i in np.argwhere(wrong)[0]]
        raise UserError(
            f"{name} holds {tensor[tuple(index)]} at {index}, {int(wrong.sum())} of {tensor.size} numbers are not "
            "finite: the training that wrote it had diverged, or the file is damaged"
        )
    if name.endswith("running_var") and (negative := tensor < 0.0).any():
        i = int(negative.argmax())
        raise UserError(f"{name} holds {tensor.flat[i]:g} at [{i}]: a variance is not negative; the file is damaged")
    if name.endswith("running_var") and tensor.size and not tensor.any():
        raise UserError(f"{name} is 0 throughout: statistics of a norm that saw no image, or the file is damaged")
    if tensor.ndim == 4 and tensor.size and not tensor.any():
        raise UserError(f"{name} is 0 throughout: no training leaves such a kernel, the file is damaged")
    if tensor.size and (largest := float(np.abs(tensor).max())) > _LARGEST:
        raise UserError(f"{name} holds a number of size {largest:.3g}: no training leaves that, the file is damaged")
    return tensor


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
    if kind == "first_row":
        return {path: tensor[:1]}
    if kind == "pair":  # a linear layer on [a | b] as one layer for each, the bias with the first
        half = tensor.shape[-1] // 2
        if last == "bias":
            return {f"{parent}_first/bias": tensor}
        return {f"{parent}_first/kernel": tensor[:, :half].T, f"{parent}_second/kernel": tensor[:, half:].T}
    return {path: tensor}


def put(tree: dict[str, Any], path: str, value: Any) -> None:
    """Set the leaf of a nested dictionary at a path with slashes."""
    *parents, name = path.split("/")
    for parent in parents:
        tree = tree.setdefault(parent, {})
    tree[name] = value

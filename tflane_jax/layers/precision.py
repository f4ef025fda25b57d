"""Precision and memory of a part of a model: bfloat16 projections, activations computed again for the gradient.

In bfloat16, linear layers and convolutions take bfloat16 inputs and kernels, and attention multiplies what they give.
Parameters, biases and their gradients, residual sums, layer norms, softmax, sampling locations, logits of edges and the
outputs of a part are float32. The backbone and the depth network keep bfloat16 between their layers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

import flax.linen as nn
import jax
import jax.numpy as jnp

T = TypeVar("T")
Precision = Literal["float32", "bfloat16"]


@runtime_checkable
class Computation(Protocol):
    """Settings of a part.

    `precision` is the dtype of linear layers and convolutions; `remat`: compute the activations of each layer again for
    the gradient instead of keeping them.
    """

    @property
    def precision(self) -> Precision: ...
    @property
    def remat(self) -> bool: ...


@dataclass(frozen=True)
class Plain:
    """The settings of a part that has none of its own: nothing changes."""

    precision: Precision = "float32"
    remat: bool = False


PLAIN = Plain()


def computing(precision: Precision) -> contextlib.AbstractContextManager[Any]:
    """Return a context in which linear layers and convolutions that name no dtype of their own compute in this one."""
    return contextlib.nullcontext() if precision == "float32" else nn.intercept_methods(_in_half)


def run_part(parent: nn.Module, run: Callable[..., T], config: Computation, *arrays: Any) -> T:
    """Return `run(parent, *arrays)` in the precision of a part; recomputed for the gradient if it says so.

    Args:
        parent: compact module that is being called.
        run: makes and calls submodules of `parent`.
        config: of the part; float32 without `remat` changes nothing.
        arrays: what `run` takes beside the module.
    """
    with computing(config.precision):
        found = nn.remat(run)(parent, *arrays) if config.remat else run(parent, *arrays)
    return full(found)


def run_layer(parent: nn.Module, layer: Callable[[], Any], config: Computation, *arrays: Any, **static: Any) -> Any:
    """Return `layer()(*arrays, **static)` by `run_part`; `layer` makes a named submodule of `parent`."""
    return run_part(parent, lambda parent, *arrays: layer()(*arrays, **static), config, *arrays)


def full(tree: T) -> T:
    """Return a tree with its bfloat16 arrays in float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.bfloat16 else leaf, tree)


def _in_half(call: Any, arguments: Any, settings: Any, context: Any) -> Any:
    module = context.module
    if context.method_name != "__call__" or not isinstance(module, nn.Dense | nn.Conv):
        return call(*arguments, **settings)
    if module.dtype is None:
        # A module is frozen, but lives for one trace only.
        object.__setattr__(module, "dtype", jnp.bfloat16)
        object.__setattr__(module, "promote_dtype", _all_but_bias)
    elif module.promote_dtype is not _all_but_bias:  # it is, when a module is called once more
        return call(*arguments, **settings)
    return call(*arguments, **settings).astype(jnp.bfloat16)


def _all_but_bias(inputs: jax.Array, kernel: jax.Array, bias: jax.Array | None, *, dtype: Any) -> Any:
    """Return what a layer computes with; its bias stays float32, for the gradient of a bias is a sum over all cells.

    In bfloat16, such a sum stops growing where the next term is less than 1/256 of it.
    """
    return inputs.astype(dtype), kernel.astype(dtype), bias

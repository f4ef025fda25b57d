"""Parameters of a model as one tree: learned parameters and running statistics."""

from __future__ import annotations

from typing import Any

import jax

from tflane_jax.layers.batch_norm import STATISTICS

Params = dict[str, Any]
"""Variables of a model. The optional entry `STATISTICS` holds the running statistics of batch norms, which have no
gradient and are not passed to the optimizer."""


def split_statistics(params: Params) -> tuple[Params, Params]:
    """Return the learned parameters, and the statistics as a tree with the entry `STATISTICS` or no entry."""
    learned = {name: value for name, value in params.items() if name != STATISTICS}
    return learned, {name: value for name, value in params.items() if name == STATISTICS}


def first_misfit(params: Params, expected: Params) -> str | None:
    """Return how the first parameter that differs from the expected shapes does so; None where all fit."""
    found, wanted = (
        {"/".join(str(key.key) for key in path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in (params, expected)
    )
    for name in sorted(found.keys() | wanted.keys()):
        here, there = (_shape(tree.get(name)) for tree in (found, wanted))
        if here != there:
            return f"{name} is {here} in the checkpoint and {there} in the model of its configuration"
    return None


def _shape(leaf: Any) -> str:
    return "missing" if leaf is None else f"{leaf.dtype}{list(leaf.shape)}"


def with_equal_heads(variables: Any, layers: int) -> Any:
    """Return initial variables in which the heads of all decoder layers, `heads_{i}`, are those of the first layer."""
    params = dict(variables["params"])
    copies = {f"heads_{i}": params["heads_0"] for i in range(layers) if "heads_0" in params}
    return {**variables, "params": params | copies}


def joined_statistics(variables: Any) -> Params:
    """Return the variables from `Module.init` as one tree of parameters."""
    return dict(variables["params"]) | {name: variables[name] for name in (STATISTICS,) if name in variables}

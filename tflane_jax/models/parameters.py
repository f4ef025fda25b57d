"""Parameters of a model as one tree: learned parameters and running statistics."""

from __future__ import annotations

from typing import Any

from tflane_jax.layers.batch_norm import STATISTICS

Params = dict[str, Any]
"""Variables of a model. The optional entry `STATISTICS` holds the running statistics of batch norms, which have no
gradient and are not passed to the optimizer."""


def split_statistics(params: Params) -> tuple[Params, Params]:
    """Return the learned parameters, and the statistics as a tree with the entry `STATISTICS` or no entry."""
    learned = {name: value for name, value in params.items() if name != STATISTICS}
    return learned, {name: value for name, value in params.items() if name == STATISTICS}


def with_equal_heads(variables: Any, layers: int) -> Any:
    """Return initial variables in which the heads of all decoder layers, `heads_{i}`, are those of the first layer."""
    params = dict(variables["params"])
    copies = {f"heads_{i}": params["heads_0"] for i in range(layers) if "heads_0" in params}
    return {**variables, "params": params | copies}


def joined_statistics(variables: Any) -> Params:
    """Return the variables from `Module.init` as one tree of parameters."""
    return dict(variables["params"]) | {name: variables[name] for name in (STATISTICS,) if name in variables}

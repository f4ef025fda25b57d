"""Parameters of a model as one tree, running statistics beside what is learned."""

from __future__ import annotations

from typing import Any

from tflane_jax.layers.batch_norm import STATISTICS

Params = dict[str, Any]
"""What a model predicts with. Its entry `STATISTICS`, where there is one, holds running statistics of batch norms: no
gradient reaches them, and the optimizer does not see them."""


def split_statistics(params: Params) -> tuple[Params, Params]:
    """Return what is learned, and the statistics as a tree with the one entry `STATISTICS` or none."""
    learned = {name: value for name, value in params.items() if name != STATISTICS}
    return learned, {name: value for name, value in params.items() if name == STATISTICS}


def joined_statistics(variables: Any) -> Params:
    """Return the variables that `Module.init` gave as one tree of parameters."""
    return dict(variables["params"]) | {name: variables[name] for name in (STATISTICS,) if name in variables}

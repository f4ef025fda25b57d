"""What the training program asks of a model: fresh parameters, a loss on a batch, an answer for one example."""

from __future__ import annotations

from typing import Any, Protocol

import jax
from jaxtyping import Array, Float

Params = dict[str, Any]
"""What a task predicts with. Its entry `STATISTICS`, where there is one, holds running statistics (those of batch
norms), which no gradient reaches and no optimiser sees."""

STATISTICS = "batch_stats"


class Task(Protocol):
    """A model with its loss. Implementations are frozen dataclasses: jit takes them as static arguments."""

    def init(self, key: jax.Array, example: Any) -> Params:
        """Return fresh parameters for examples shaped like `example`."""
        ...

    def loss(self, params: Params, batch: Any, key: jax.Array) -> tuple[Float[Array, ""], dict[str, Any]]:
        """Return the loss of a batch (leading axis on every leaf) and named terms to report; `key` is for dropout.

        A task with running statistics puts their new values among the terms, as the entry `STATISTICS`.
        """
        ...

    def predict(self, params: Params, example: Any) -> Any:
        """Return the answer for one example: no batch axis, no dropout, no host callback."""
        ...


def split_statistics(params: Params) -> tuple[Params, Params]:
    """Return what is learned, and the statistics as a tree with the one entry `STATISTICS` or none."""
    learned = {name: value for name, value in params.items() if name != STATISTICS}
    return learned, {name: value for name, value in params.items() if name == STATISTICS}

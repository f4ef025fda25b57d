"""What the training program asks of a model: fresh parameters, a loss on a batch, an answer for one example."""

from __future__ import annotations

from typing import Any, Protocol

import jax
from jaxtyping import Array, Float

Params = dict[str, Any]


class Task(Protocol):
    """A model with its loss. Implementations are frozen dataclasses: jit takes them as static arguments."""

    def init(self, key: jax.Array, example: Any) -> Params:
        """Return fresh parameters for examples shaped like `example`."""
        ...

    def loss(
        self, params: Params, batch: Any, key: jax.Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Return the loss of a batch (leading axis on every leaf) and named terms to report; `key` is for dropout."""
        ...

    def predict(self, params: Params, example: Any) -> Any:
        """Return the answer for one example: no batch axis, no dropout, no host callback."""
        ...

"""The protocol that the training program requires of a model: initial parameters, and the loss of a batch."""

from __future__ import annotations

from typing import Any, Protocol

import jax
from jaxtyping import Array, Float

from tflane_jax.models.parameters import Params


class Trainable(Protocol):
    """A model with its loss. Implementations are frozen dataclasses: jit takes them as static arguments.

    An attribute `loops` that is True says that the loss passes through the model in a loop (`tasks.base.Task.loops`).
    An attribute `notices` has sentences by the name of a term: training prints one where its term is above 0, once.
    """

    def init(self, key: jax.Array, example: Any) -> Params:
        """Return initial parameters for examples shaped like `example`."""
        ...

    def loss(self, params: Params, batch: Any, key: jax.Array) -> tuple[Float[Array, ""], dict[str, Any]]:
        """Return the loss of a batch (leading axis on every leaf) and named terms to record; `key` is for dropout.

        A model with running statistics returns their new values in the entry `STATISTICS` of the terms.
        """
        ...

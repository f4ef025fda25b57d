"""Which array library a function's arguments belong to."""

from __future__ import annotations

from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

AnyArray = np.ndarray | jax.Array
# For functions that answer in kind.
ArrayT = TypeVar("ArrayT", np.ndarray, jax.Array)


def namespace(*arrays: Any) -> ModuleType:
    """Return `jax.numpy` if any argument is a jax array or tracer, else `numpy`."""
    return jnp if any(isinstance(a, jax.Array) for a in arrays) else np

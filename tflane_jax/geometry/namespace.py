"""The array library of a function's arguments, numpy or jax."""

from __future__ import annotations

from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

AnyArray = np.ndarray | jax.Array
# For functions that return the type of their arguments.
ArrayT = TypeVar("ArrayT", np.ndarray, jax.Array)


def namespace(*arrays: Any) -> ModuleType:
    """Return `jax.numpy` if any argument is a jax array or tracer, else `numpy`."""
    return jnp if any(isinstance(a, jax.Array) for a in arrays) else np


def product(a: Any, b: Any) -> Any:
    """Return the matrix product `a @ b` at full precision.

    By default accelerators may round the factors to ten bits or seven, which moves points metres away by centimetres.
    """
    return jnp.matmul(a, b, precision="highest") if namespace(a, b) is jnp else a @ b


def constants(values: Any, like: Any) -> Any:
    """Return constants as an array of the library of `like`, of its dtype or, if that is no floating one, float32."""
    dtype = like.dtype if jnp.issubdtype(like.dtype, jnp.floating) else np.float32
    return namespace(like).asarray(values, dtype)

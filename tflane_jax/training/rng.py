"""Random streams by name and step, so that random numbers do not depend on the order of calls."""

from __future__ import annotations

import zlib

import jax
from jaxtyping import Array, Int


def stream(key: jax.Array, name: str, step: int | Int[Array, ""] = 0) -> jax.Array:
    """Return the key of stream `name` at `step`, derived from the run's root key.

    The name enters through CRC-32, which is the same in every process (Python's `hash` of a string is not).
    """
    return jax.random.fold_in(jax.random.fold_in(key, zlib.crc32(name.encode())), step)

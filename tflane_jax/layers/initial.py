"""Initialisers that Linen lacks: PyTorch's default for dense and convolution layers."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp


def uniform_by_fan_in(fan_in: int) -> nn.initializers.Initializer:
    """Return PyTorch's default of kernels and biases: uniform within 1 / sqrt(fan in)."""
    limit = fan_in**-0.5
    return lambda key, shape, dtype=jnp.float32: jax.random.uniform(key, shape, dtype, -limit, limit)

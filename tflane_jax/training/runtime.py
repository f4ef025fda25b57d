"""Process-wide settings of JAX, made in one place and once, by whoever owns the process (the command line, a test)."""

from __future__ import annotations

import jax


def configure_jax() -> None:
    """Let arrays of different rank never broadcast silently."""
    jax.config.update("jax_numpy_rank_promotion", "raise")

"""Settings of every test session, made before JAX starts."""

import os

# Tests compile many small programs and run each a few times: unoptimised code halves the session.
_FAST_COMPILE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
os.environ["XLA_FLAGS"] = f"{_FAST_COMPILE} {os.environ.get('XLA_FLAGS', '')}".strip()

from tflane_jax.training.runtime import configure_jax  # noqa: E402

configure_jax()

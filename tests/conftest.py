"""Settings of every test session, made before JAX starts."""

import gc
import os

# Tests compile many programs and run each a few times: unoptimised code halves the session, and XLA's older code
# generator for fusions halves what is left, as it hands LLVM far less to do.
_FAST_COMPILE = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
os.environ["XLA_FLAGS"] = f"{_FAST_COMPILE} {os.environ.get('XLA_FLAGS', '')}".strip()

from tflane_jax.training.runtime import configure_jax  # noqa: E402

configure_jax()
# Tracing makes millions of objects, hardly any of them garbage: looking for it as often as by default costs a tenth.
gc.set_threshold(100_000, 50, 100)

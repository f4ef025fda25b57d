"""Unoptimised programs for the tests, and the environment of those that need optimised ones."""

import importlib.metadata
import os
import threading

# Tests compile many programs and run each a few times: unoptimised code halves the session, and XLA's older code
# generator for fusions halves what is left, because it gives LLVM less to do.
FAST_COMPILE = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_parallel_codegen_split_count=1"
)
# XLA ends a process that sets a flag which it does not have; from jaxlib 0.11 on there is one code generator.
if importlib.metadata.version("jaxlib").startswith("0.10."):
    FAST_COMPILE += " --xla_cpu_use_fusion_emitters=false"


def compile_fast() -> None:
    """Choose unoptimised programs in this process and those that it starts; to be called before JAX is imported."""
    flags = os.environ.get("XLA_FLAGS", "")
    if FAST_COMPILE not in flags:  # a worker inherits them
        os.environ["XLA_FLAGS"] = f"{FAST_COMPILE} {flags}".strip()


def share_contexts() -> None:
    """Lower 100 programs in one MLIR context; JAX makes a new one for each, a fifth of the time of a small program.

    A context keeps the constants of its programs: after 100 it is replaced. A version of JAX that has no
    `make_ir_context` is left as it is.
    """
    from jax._src.interpreters import mlir

    make = getattr(mlir, "make_ir_context", None)
    if make is None:
        return
    of_thread = threading.local()

    def shared_context():
        used = getattr(of_thread, "used", 0)
        if used % 100 == 0:
            of_thread.context = make()
        of_thread.used = used + 1
        return of_thread.context

    mlir.make_ir_context = shared_context


def optimised() -> dict[str, str]:
    """Return the environment for a process that runs its programs often, such as a training."""
    return os.environ | {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "").replace(FAST_COMPILE, "")}

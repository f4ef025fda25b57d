"""Which GPUs a process may use: chosen by environment variables and flags, before JAX looks for its devices.

JAX takes every GPU that it sees, and reserves three quarters of its memory. Under Slurm and Open MPI it takes one for
each process, however many the job gave it.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import re
from collections.abc import Mapping
from pathlib import Path

_VISIBLE = "CUDA_VISIBLE_DEVICES"
_FRACTIONS = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")  # its name, and the one it had
_SHARED_FRACTION = 0.9
_NO_GPU = ("-1", "NoDevFiles")  # CUDA sees no GPU from such a name on
_PLUGINS = ("jax_cuda13_plugin", "jax_cuda12_plugin")
_TRITON = "--xla_gpu_enable_triton_gemm"


def devices_of_task(environment: Mapping[str, str]) -> list[int] | None:
    """Return the GPUs, by their place among the visible ones, that are this process's own in a cluster's job.

    All of them where the process is alone on its host, or where the cluster shows each process its own (`srun
    --gpus-per-task`). Several processes that see the same GPUs get equal parts, in order.

    Args:
        environment: variables of the process.

    Returns:
        None if the variables do not determine them; JAX then takes one GPU for each process.
    """
    if (visible := environment.get(_VISIBLE)) is None:
        return None
    seen = len([name for name in visible.split(",") if name.strip()])
    tasks, place = tasks_on_host(environment)
    bound = any(name in environment for name in ("SLURM_GPUS_PER_TASK", "SLURM_NTASKS_PER_GPU"))
    bound = bound or "gpu" in environment.get("SLURM_TRES_PER_TASK", "")
    if tasks == 1 or bound or seen < tasks:
        return list(range(seen)) or None
    if seen % tasks:
        return None
    each = seen // tasks
    return list(range(place * each, (place + 1) * each))


def tasks_on_host(environment: Mapping[str, str]) -> tuple[int, int]:
    """Return how many processes of the job are on this host, and the number of this one among them."""
    # Slurm's variables in processes of mpirun are those of the batch script. JAX tells them in the same way.
    by_mpirun = "OMPI_MCA_orte_hnp_uri" in environment and "OMPI_COMM_WORLD_LOCAL_RANK" in environment
    if "SLURM_LOCALID" in environment and not by_mpirun:
        counts: list[int] = []
        written = environment.get("SLURM_STEP_TASKS_PER_NODE", environment.get("SLURM_TASKS_PER_NODE", "1"))
        for count, repeats in re.findall(r"(\d+)(?:\(x(\d+)\))?", written):  # "2(x3),1": 2, 2, 2 and 1
            counts += [int(count)] * int(repeats or 1)
        host = int(environment.get("SLURM_NODEID", 0))
        return counts[host] if host < len(counts) else 1, int(environment["SLURM_LOCALID"])
    if "OMPI_COMM_WORLD_LOCAL_RANK" in environment:
        return int(environment.get("OMPI_COMM_WORLD_LOCAL_SIZE", 1)), int(environment["OMPI_COMM_WORLD_LOCAL_RANK"])
    return 1, 0


def gpus() -> list[str]:
    """Return the names of the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` takes them; [] for none.

    JAX is not asked, because it would reserve their memory.
    """
    if (visible := os.environ.get(_VISIBLE)) is not None:
        names = [name.strip() for name in visible.split(",") if name.strip()]
        return list(itertools.takewhile(lambda name: name not in _NO_GPU, names))
    devices = Path("/dev")
    # The Windows subsystem for Linux has one file, dxg, in place of one for each GPU.
    count = len(list(devices.glob("nvidia[0-9]*"))) or int((devices / "dxg").exists())
    return [str(place) for place in range(count)]


def of_worker(slot: int, parallel: int) -> dict[str, str]:
    """Return environment variables that give one GPU to one of `parallel` processes that train side by side.

    Processes that share a GPU divide its memory. Without GPUs there are no variables. The process sets them before JAX
    looks for its devices.
    """
    if not (names := gpus()):
        return {}
    found = {_VISIBLE: names[slot % len(names)]}
    if (sharing := -(-parallel // len(names))) == 1:
        return found
    # JAX computes on the CPU, with no more than a logged error, where both names are set.
    if not any(name in os.environ for name in _FRACTIONS):
        found[_FRACTIONS[0]] = f"{_SHARED_FRACTION / sharing:.3f}"
    return found


def leave_to_workers() -> None:
    """Let this process, and those that it starts to train, reserve no memory of GPUs in advance."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def disable_triton_gemm() -> None:
    """Disable XLA's Triton kernels for matrix products, so that cuBLAS computes them, unless XLA_FLAGS sets them.

    They end the process while it compiles, with a failed check in triton_tiling_propagation.cc (openxla/xla issue
    47381; seen with jaxlib 0.11.2 on the update of the lane shape models). To be called before JAX looks for its
    devices. Without a GPU nothing changes.
    """
    if os.environ.get("JAX_PLATFORMS") == "cpu" or not gpus():
        return
    flags = os.environ.get("XLA_FLAGS", "")
    if _TRITON not in flags and any(importlib.util.find_spec(name) for name in _PLUGINS):
        os.environ["XLA_FLAGS"] = f"{flags} {_TRITON}=false".strip()

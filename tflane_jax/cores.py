"""How many CPU cores a process may use."""

from __future__ import annotations

import os
from collections.abc import Mapping

from tflane_jax.accelerators import tasks_on_host


def usable_cores() -> int:
    """Return the number of cores that the system lets this process use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def own_cores(environment: Mapping[str, str]) -> int:
    """Return how many of the usable cores are this process's part, at least 1.

    Processes of a cluster's job that may all use the same cores share them equally. One that is bound to fewer than its
    job has on this host has those for itself. Processes that were started by hand do not know of each other.

    Args:
        environment: variables of the process.
    """
    usable, (tasks, _) = usable_cores(), tasks_on_host(environment)
    given = environment.get("SLURM_CPUS_ON_NODE", "")
    of_job = int(given) if given.isdecimal() else os.cpu_count() or 1
    return usable if usable < of_job else max(usable // tasks, 1)

"""How many CPU cores a process may use."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

from tflane_jax.accelerators import tasks_on_host


def usable_cores() -> int:
    """Return the number of cores that the system lets this process use, which XLA starts as many threads for."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def working_cores() -> int:
    """Return how many workers are kept busy: the usable cores, or fewer where a container's share of them is limited.

    Such a limit (`docker run --cpus`, Kubernetes' `limits.cpu`) slows down all threads of the container instead of
    taking cores away from it. Part of a core counts as one.
    """
    quota = cpu_quota()
    return usable_cores() if quota is None else min(usable_cores(), max(math.ceil(quota), 1))


def own_cores(environment: Mapping[str, str]) -> int:
    """Return how many of the cores are this process's part, at least 1.

    Processes of a cluster's job that may all use the same cores share them equally. One that is bound to fewer than its
    job has on this host has those for itself. Processes that were started by hand do not know of each other.

    Args:
        environment: variables of the process.
    """
    usable, (tasks, _) = usable_cores(), tasks_on_host(environment)
    given = environment.get("SLURM_CPUS_ON_NODE", "")
    of_job = int(given) if given.isdecimal() else os.cpu_count() or 1
    return min(usable if usable < of_job else max(usable // tasks, 1), working_cores())


def cpu_quota(system: Path = Path("/")) -> float | None:
    """Return how many cores' time the control groups of this process get, the least of all; None without a limit.

    Args:
        system: folder that holds `proc` and `sys`.
    """
    limits: list[float] = []
    for line in _read(system / "proc/self/cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        # Version 2 names no controllers. Limits of the groups above hold, too; in a container the tree begins at its
        # own group, whatever its path.
        root = system / "sys/fs/cgroup" / ("cpu" if controllers else "")
        inside = Path(group.lstrip("/"))
        limits += [limit for folder in (inside, *inside.parents) for limit in _limit(root / folder)]
    return min(limits, default=None)


def _limit(folder: Path) -> list[float]:
    """Return the cores of one group, by version 2 or 1; empty without a limit, which is "max" or -1."""
    quota, _, period = _read(folder / "cpu.max").partition(" ")
    if not quota:
        quota, period = _read(folder / "cpu.cfs_quota_us"), _read(folder / "cpu.cfs_period_us")
    return [int(quota) / int(period)] if quota.strip().isdecimal() and period.strip().isdecimal() else []


def _read(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:  # not Linux, another version, or a group outside of the container
        return ""

"""Where a run's numbers come from: code, versions, machine, command.

Results are bit-identical only for the same code, the same versions and the same number of cores: XLA divides a sum
between its threads, and the division decides how it is rounded.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

import tflane_jax
from tflane_jax.cores import usable_cores
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.files.wording import counted

_PACKAGES = ("tflane_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "scipy")

# What decides how many threads XLA and the libraries below it use, beside the cores that a process may run on, and with
# which random numbers and in which precision JAX computes.
_VARIABLES = (
    "XLA_FLAGS",
    "OMP_NUM_THREADS",
    "NPROC",
    "PJRT_NPROC",
    "JAX_DEFAULT_PRNG_IMPL",
    "JAX_THREEFRY_PARTITIONABLE",
    "JAX_DEFAULT_MATMUL_PRECISION",
    "JAX_ENABLE_X64",
    "NVIDIA_TF32_OVERRIDE",
)
_CPU = "cpu:"


def thread_setting(cores: int | None = None, devices: int | None = None) -> dict[str, Any]:
    """Return what decides how numbers are rounded: cores, environment variables that are set, an accelerator if any.

    Args:
        cores, devices: numbers to report instead, for a process that is going to be started on as many.
    """
    if cores is None:
        cores = usable_cores()
    setting: dict[str, Any] = {"cores": cores} | {name: os.environ[name] for name in _VARIABLES if name in os.environ}
    device = _device(devices)
    if not device.startswith(_CPU):
        return setting | {"device": device}
    if "--xla_gpu_" in (flags := setting.get("XLA_FLAGS", "")):
        setting["XLA_FLAGS"] = " ".join(flag for flag in flags.split() if not flag.startswith("--xla_gpu_"))
        if not setting["XLA_FLAGS"]:
            del setting["XLA_FLAGS"]
    return setting


def threads_of(start: dict[str, Any]) -> dict[str, Any] | None:
    """Return the thread setting of a recorded start; None where it was not recorded.

    Earlier versions recorded an accelerator only beside the setting, not in it.
    """
    threads, device = start.get("threads"), start.get("device")
    if threads is None or not isinstance(device, str) or device.startswith(_CPU):
        return threads
    return {**threads, "device": device}


def provenance() -> dict[str, Any]:
    """Return code version, package versions, machine, cores and command of this process, as plain JSON."""
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "git": _git(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": _device(),
        "threads": thread_setting(),
        "pinned_to": sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
    }


def add_provenance(folder: Path, **more: Any) -> list[str]:
    """Append this start to the run folder's provenance.json, with further entries of plain JSON.

    A damaged file is kept as provenance.damaged.json.

    Returns:
        A line for the user where the file was damaged, one where an earlier start of the run had another thread
        setting, and one where the latest had other code or packages.
    """
    (earlier, damage), new, path = _starts(folder), provenance() | more, folder / "provenance.json"
    notices = []
    if damage:
        kept = _keep_damaged(path)
        notices.append(f"{path} is damaged: {damage}; it is kept as {kept.name}, the new one has what can be read")
    write_json(path, [*earlier, new])
    others = [threads for start in earlier if (threads := threads_of(start)) is not None and threads != new["threads"]]
    if others:
        before, now = listed_setting(others[-1]), listed_setting(new["threads"])
        notices.append(
            f"{folder} was trained with {before} before, now with {now}: the results are not bit-identical to those of "
            "an uninterrupted run"
        )
    if earlier and (changed := _changes(earlier[-1], new)):
        notices.append(
            f"{folder} was trained by other code before ({', '.join(changed)}): the results may differ from those of "
            "an uninterrupted run"
        )
    return notices


def commit_of(git: Mapping[str, Any]) -> str:
    """Return the commit that a run began with, and whether its code was another one."""
    return git["commit"][:9] + (" with uncommitted changes" if git.get("uncommitted_changes") else "")


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return which code and packages of two starts differ, as "before -> now"."""
    pairs = {}
    if before.get("git") and now.get("git"):
        pairs["commit"] = commit_of(before["git"]), commit_of(now["git"])
    old = before.get("packages") or {}
    pairs |= {name: (old[name], version) for name, version in now["packages"].items() if name in old}
    if "own_modules" in before and "own_modules" in now:
        pairs["own modules"] = before["own_modules"][:9] or "none", now["own_modules"][:9] or "none"
    return [f"{name} {old} -> {new}" for name, (old, new) in pairs.items() if old != new]


def read_provenance(folder: Path) -> list[dict[str, Any]]:
    """Return the record of every start of a run, the first one first; those that are damaged are left out."""
    return _starts(folder)[0]


def _starts(folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return the records that can be read, and what is wrong with the others or the file, "" for nothing."""
    try:
        content = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return [], ""
    except OSError as error:
        return [], f"it cannot be read ({error.strerror or error})"
    except (ValueError, RecursionError):
        return [], "it is no JSON"
    if not isinstance(content, list):
        return [], "it holds no list of starts"
    starts = [one for one in content if isinstance(one, dict) and isinstance(one.get("threads", {}), dict)]
    lost = len(content) - len(starts)
    return starts, f"{counted(lost, 'start')} of {len(content)} cannot be read" if lost else ""


def _keep_damaged(path: Path) -> Path:
    """Rename a damaged file, in the place of an earlier one, and return where it is."""
    kept = path.with_name("provenance.damaged.json")
    try:
        os.replace(path, kept)
    except OSError as error:
        raise UserError(f"cannot rename {path}, which is damaged: {error.strerror or error}; move it away") from error
    return kept


def _device(count: int | None = None) -> str:
    """Return platform, kind and number of the devices, or another number."""
    device = jax.devices()[0]
    return f"{device.platform}: {device.device_kind} x {count or jax.device_count()}"


def listed_setting(setting: Mapping[str, Any]) -> str:
    """Return a thread setting for people."""
    return ", ".join(f"{name} {value}" for name, value in setting.items())


def _git() -> dict[str, Any] | None:
    """Return commit and uncommitted changes of the checkout that runs; None for an installed package."""
    root = Path(tflane_jax.__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # A package that is installed inside the checkout of another project is not that project's code.
        if not git("ls-files", "--", str(root / "__init__.py")):
            return None
        return {"commit": git("rev-parse", "HEAD"), "uncommitted_changes": bool(git("status", "--porcelain", "-uno"))}
    except (OSError, subprocess.SubprocessError):
        return None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None

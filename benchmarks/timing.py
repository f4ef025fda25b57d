"""Comparisons of compiled programs that stay valid on a busy machine.

Arrays are arguments, because XLA folds the constants of a closure into the program. Compilation is timed apart. In
every round the programs of a comparison run one after the other; the result is the median over rounds of the ratio of
two times of one round, so that the load of the machine affects both.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from tflane_jax.files.atomic import write_json, write_text
from tflane_jax.startup import in_another_thread
from tflane_jax.training.provenance import provenance, thread_setting

Program = Callable[[], Any]
_OUT = Path("runs/bench")


class Compiled(NamedTuple):
    """A program ready to run on its arguments, and the seconds that its compilation took."""

    program: Program
    seconds: float


def compile_jax(function: Callable[..., Any], *arguments: Any) -> Compiled:
    """Compile `function` for `arguments`; the program runs it on them and waits for the result."""
    start = time.perf_counter()
    compiled = in_another_thread(jax.jit(function).lower(*arguments).compile)  # as the library does
    return Compiled(lambda: jax.block_until_ready(compiled(*arguments)), time.perf_counter() - start)


def interleave(programs: Mapping[str, Program], seconds: float, least_rounds: int = 3) -> dict[str, np.ndarray]:
    """Run all programs once a round, in random order, until `seconds` are over; return seconds by round.

    In a fixed or rotating order each program has the same neighbour before it, and pays for what that leaves running:
    behind PyTorch, whose threads spin on for a while, the same program took 1.3 times as long.
    A round repeats a fast program until it has taken about a millisecond, and counts the mean. The first run of each,
    which touches fresh memory, is not counted.
    """
    repeats = {name: max(1, min(100, int(1e-3 / _seconds(program, 1)))) for name, program in programs.items()}
    times: dict[str, list[float]] = {name: [] for name in programs}
    names, rng = list(programs), np.random.default_rng(0)
    start, rounds = time.perf_counter(), 0
    while rounds < least_rounds or time.perf_counter() - start < seconds:
        for i in rng.permutation(len(names)):
            times[names[i]].append(_seconds(programs[names[i]], repeats[names[i]]))
        rounds += 1
    return {name: np.array(values) for name, values in times.items()}


def _seconds(program: Program, repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        program()
    return (time.perf_counter() - start) / repeats


def summarise(times: Mapping[str, np.ndarray], reference: str) -> dict[str, dict[str, float]]:
    """Return for each program its median and least milliseconds and how many times as long as `reference` it takes."""
    return {
        name: {
            "median_ms": float(np.median(values) * 1e3),
            "least_ms": float(values.min() * 1e3),
            "ratio": float(np.median(values / times[reference])),
            "ratio_of_least": float(values.min() / times[reference].min()),
            "rounds": len(values),
        }
        for name, values in times.items()
    }


def measure(compiled: Mapping[str, Compiled], seconds: float) -> dict[str, dict[str, float]]:
    """Return `summarise` of compiled programs that run in turn, the first as reference, with `compile_s`."""
    times = interleave({name: entry.program for name, entry in compiled.items()}, seconds)
    rows = summarise(times, next(iter(compiled)))
    return {name: row | {"compile_s": compiled[name].seconds} for name, row in rows.items()}


def machine() -> dict[str, Any]:
    """Return provenance, processor and threads."""
    return provenance() | {"processor": _processor(), "cores": cores(), "load": list(os.getloadavg())}


def cores() -> int:
    """Return the cores that this process may use, which may be pinned to fewer than the machine has."""
    return thread_setting()["cores"]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an aligned table: the first column to the left, the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        aligned = [cell.rjust(width) for cell, width in zip(cells, widths, strict=True)]
        return f"| {' | '.join([cells[0].ljust(widths[0]), *aligned[1:]])} |"

    rule = f"|{'|'.join('-' * (w + 2) if i == 0 else '-' * (w + 1) + ':' for i, w in enumerate(widths))}|"
    return "\n".join([line(header), rule, *map(line, rows)])


def command_line(
    text: str | None,
    *,
    out: Path | None = _OUT,
    seconds: float | None = None,
    rounds: int | None = None,
    scenes: int | None = None,
) -> argparse.ArgumentParser:
    """Return the parser of a benchmark, with the options that several have; each adds its own.

    Args:
        text: help, the docstring of its file.
        out: default folder of JSON and table; None for a benchmark that prints its result and writes nothing.
        seconds, rounds, scenes: defaults of these options; None for a benchmark without.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    if out is not None:
        parser.add_argument(
            "--out", metavar="DIR", type=Path, default=out, help=f"folder of the results (default {out})"
        )
    counts = (("--seconds", float, seconds, "least time of a comparison"), ("--rounds", int, rounds, "repetitions"))
    for name, kind, default, what in (*counts, ("--scenes", int, scenes, "number of scenes")):
        if default is not None:
            parser.add_argument(name, metavar="N", type=kind, default=default, help=f"{what} (default {default:g})")
    return parser


def save(out: Path, name: str, record: dict[str, Any], table: str) -> None:
    """Write `name`.json and `name`.md into the folder `out`; say so where other programs disturbed the times."""
    write_json(out / f"{name}.json", record)
    write_text(out / f"{name}.md", table + "\n")
    if notice := load_notice(record):
        print(f"\n{notice}")


def load_notice(record: Mapping[str, Any]) -> str:
    """Return a warning if other programs ran (the load of `machine` is above its cores), else ""."""
    of = record.get("machine", record)
    load, count = of.get("load", [0.0])[0], of.get("cores", 0)
    if load <= count + 0.5:  # the benchmark itself counts
        return ""
    return (
        f"Other programs ran (load {load:.1f} on {count} cores): times are too high, and so are those beside "
        "quoted ones. Ratios of programs that ran in turn stay meaningful."
    )

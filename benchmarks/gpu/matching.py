"""Matching on the device against scipy in a host callback, for the problems of a training step.

    python -m benchmarks.gpu.matching --out runs/bench
    python -m benchmarks.gpu.matching --out runs/bench --tiny       # small problems: shows that it starts

Costs are random numbers; the number of valid targets is given, because the device's loop makes one pass for each. The
callback includes moving costs to the host and assignments back.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.timing import command_line, compile_jax, machine, markdown_table, measure, save
from tflane_jax.matching import match


class Problems(NamedTuple):
    """The matching problems of a step.

    Attributes:
        batch, layers: examples and decoder layers.
        queries, targets: of a problem; targets are padded slots.
        valid: targets that exist.
    """

    batch: int
    layers: int
    queries: int
    targets: int
    valid: int


PAPER = {
    "TopoNet, 1 frame": Problems(1, 6, 200, 64, 24),
    "TopoNet, 8 frames": Problems(8, 6, 200, 64, 24),
    "MapTRv2, 4 frames": Problems(4, 6, 350, 100, 40),
}
TINY = {"tiny": Problems(2, 2, 6, 4, 3)}


def arrays(problems: Problems, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return random costs (batch, layers, queries, targets) and which targets are valid (batch, 1, targets)."""
    rng = np.random.default_rng(seed)
    cost = rng.random((problems.batch, problems.layers, problems.queries, problems.targets), np.float32)
    valid = np.broadcast_to(np.arange(problems.targets) < problems.valid, (problems.batch, 1, problems.targets))
    return cost, np.array(valid)


def run(out: Path, *, tiny: bool = False, seconds: float = 5.0) -> dict[str, Any]:
    """Compare both backends, print the table, and write `gpu_matching.json` and `.md` into `out`."""
    rows: dict[str, Any] = {}
    for name, problems in (TINY if tiny else PAPER).items():
        given = jax.device_put(arrays(problems))
        programs = {kind: compile_jax(partial(match, backend=kind), *given) for kind in ("scipy", "jax")}
        same = jax.tree.map(np.array_equal, *(jax.device_get(entry.program()) for entry in programs.values()))
        rows[name] = measure(programs, seconds) | {"same": all(jax.tree.leaves(same))}
    record = machine() | {"device": jax.devices()[0].device_kind, "problems": rows}
    lines = [
        [name, *(f"{found[kind]['median_ms']:.2f}" for kind in ("scipy", "jax")), f"{found['jax']['ratio']:.2f}"]
        for name, found in rows.items()
    ]
    text = markdown_table(["problems of a step", "callback ms", "device ms", "device / callback"], lines)
    print(text)
    save(out, "gpu_matching", record, text)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=5.0)
    parser.add_argument("--tiny", action="store_true", help="small problems, for a CPU")
    options = parser.parse_args()
    run(options.out, tiny=options.tiny, seconds=options.seconds)


if __name__ == "__main__":
    main()

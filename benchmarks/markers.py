"""Time of markers and their memory in a host that streams: one frame, with the memory of the frames before it.

    python -m benchmarks.markers --out runs/bench

The models are those of `configs/markers/`. Without memory the prior tokens come from the frame's own markers. With
memory the bank is moved, decayed and read in every frame, with or without markers in sight.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.timing import command_line, compile_jax, machine, markdown_table, measure, save
from tflane_jax.config import load_config
from tflane_jax.datasets.loading import TRAINING_PARTS, load_arrays
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.tasks.lane_graph import LaneGraphTask

CONFIG = Path(__file__).parent.parent / "configs" / "markers" / "toponet_markers.py"
MODELS = {"markers, no memory": ":no_memory", "markers, memory": "", "host": ":toponet"}


def run(out: Path, seconds: float = 20.0) -> dict[str, Any]:
    """Run everything, print the table, write `markers.json` and `markers.md` into `out`, and return the record."""
    config = load_config(str(CONFIG))
    source = config.data.source("val")
    assert isinstance(source, ProceduralConfig)
    one_scene = ProceduralConfig("val", scenes=1, world=source.world, example=source.example)
    frames = load_arrays(ProceduralDataset(one_scene), parts=TRAINING_PARTS, progress=False)
    frame = jax.tree.map(lambda leaf: jnp.asarray(leaf[1]), frames)
    compiled = {}
    for name, ablation in MODELS.items():
        task = load_config(f"{CONFIG}{ablation}").task
        assert isinstance(task, LaneGraphTask)
        params = jax.jit(task.init)(jax.random.key(0), jax.tree.map(lambda leaf: jnp.asarray(leaf[:4]), frames))
        compiled[name] = compile_jax(task.step, params, task.start(), frame)
    results = measure(compiled, seconds)
    rows = [
        [name, f"{r['median_ms']:.2f}", f"{r['least_ms']:.2f}", f"{r['ratio']:.3f}", f"{r['compile_s']:.1f}"]
        for name, r in results.items()
    ]
    table = markdown_table(["a frame of a stream", "median ms", "least ms", "ratio", "compile s"], rows)
    record = {"machine": machine(), "results": results}
    print(table)
    save(out, "markers", record, table)
    return record


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__, seconds=20.0)
    options = parser.parse_args()
    run(options.out, options.seconds)


if __name__ == "__main__":
    main()

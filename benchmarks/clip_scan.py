"""Training on clips, unrolled and as a scan over time: size of the program, time to compile, loss.

    python -m benchmarks.clip_scan --out runs/bench                      # loss and gradient; minutes
    python -m benchmarks.clip_scan --out runs/bench --tiny --what loss   # a small decoder, the loss alone

Compile times are CPU seconds of this process, tracing apart. The clips are frames of one scene of the built-in world,
so that cameras see the BEV cells and every frame but the first has a memory; the benchmark stops if the memory changes
nothing. Parameters are invented.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from benchmarks.gpu.steps import invented
from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax.config import load_config
from tflane_jax.datasets.batches import first_example
from tflane_jax.scene import stack_examples
from tflane_jax.summary import shapes_of_params
from tflane_jax.training.loop_convolutions import with_fast_convolutions

CONFIG = "markers/cameras"
CLIPS = (2, 4)


def measured(clip: int, form: Literal["unrolled", "scan"], what: str, *, tiny: bool) -> dict[str, Any]:
    """Return what the program of one clip takes, and its loss."""
    config: Any = load_config(CONFIG)
    task: Any = replace(config.task, clip=clip, time=form)
    if tiny:
        task = replace(task, model=replace(task.model, decoder=replace(task.model.decoder, layers=1), elements=None))
    data = replace(config.data, train=1)
    params = jax.tree.map(lambda leaf: 0.1 * leaf, invented(shapes_of_params(task, task.shapes(data))))
    frames: Any = task.load(data.source("train"), progress=False)
    batch = stack_examples([first_example(task.examples(frames))])
    of_loss = lambda *arguments: task.loss(*arguments)[0]  # noqa: E731
    function = of_loss if what == "loss" else jax.value_and_grad(of_loss)
    began = time.process_time()
    lowered = jax.jit(with_fast_convolutions(function)).lower(params, batch, jax.random.key(0))
    traced = time.process_time()
    compiled = lowered.compile()
    done = time.process_time()
    found = compiled(params, batch, jax.random.key(0))
    loss = float(found if what == "loss" else found[0])
    forgetful = batch.replace(has_previous=np.zeros_like(batch.has_previous))
    without = compiled(params, forgetful, jax.random.key(0))
    if loss == float(without if what == "loss" else without[0]):
        raise RuntimeError(f"the memory changes no loss of a clip of {clip}: nothing shows that the forms keep it")
    return {
        "clip": clip,
        "form": form,
        "lines": lowered.as_text().count("\n"),
        "trace_s": traced - began,
        "compile_s": done - traced,
        "loss": loss,
    }


def run(out: Path, what: str = "gradient", *, tiny: bool = False) -> list[dict[str, Any]]:
    """Compare both forms, print the table, and write `clip_scan.json` and `.md` into `out`."""
    rows = [measured(clip, form, what, tiny=tiny) for clip in CLIPS for form in ("unrolled", "scan")]
    header = ["clip", "form", "lines of StableHLO", "trace, CPU s", "compile, CPU s", "loss"]
    lines = [
        [str(r["clip"]), r["form"], f"{r['lines']:,}", f"{r['trace_s']:.0f}", f"{r['compile_s']:.0f}", repr(r["loss"])]
        for r in rows
    ]
    text = markdown_table(header, lines)
    print(text)
    save(out, "clip_scan", machine() | {"what": what, "tiny": tiny, "rows": rows}, text)
    losses = {clip: [row["loss"] for row in rows if row["clip"] == clip] for clip in CLIPS}
    for clip, found in losses.items():
        np.testing.assert_allclose(*found, rtol=1e-6, err_msg=f"losses of clip {clip}")
    return rows


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__)
    parser.add_argument("--what", choices=["gradient", "loss"], default="gradient")
    parser.add_argument("--tiny", action="store_true", help="one decoder layer, no traffic elements")
    options = parser.parse_args()
    run(options.out, options.what, tiny=options.tiny)


if __name__ == "__main__":
    main()

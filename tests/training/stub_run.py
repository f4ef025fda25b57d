"""Train the stub task into a folder: `python -m tests.training.stub_run FOLDER START KILL`.

KILL is where the process ends itself by SIGKILL: "evaluation:STEP", "checkpoint:STEP" (half-way through writing) or
"never".
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from tests.training.stub import LineTask, line_arrays
from tflane_jax.training import checkpoint, loop
from tflane_jax.training.schedule import OptimConfig

CONFIG = loop.TrainingConfig(
    steps=30, batch_size=3, log_every=4, eval_every=10, checkpoint_every=7, best_metric="score"
)
TASK = LineTask()
OPTIM = OptimConfig(lr=0.05, warmup_steps=3)
RESOLVED = {"class": "RunConfig", "training": {"seeds": [0], "best_metric": "score"}}


def score(params) -> dict[str, float]:
    return {"score": -float(jnp.abs(params["line"]["kernel"]).sum())}


def run(
    folder: Path, *, start="new", config=CONFIG, optim=OPTIM, task=TASK, arrays=None, **others
) -> loop.TrainingResult:
    options = {"resolved": RESOLVED, "evaluate": score, "progress": False} | others
    arrays = line_arrays() if arrays is None else arrays
    return loop.train(task, arrays, folder, config=config, optim=optim, start=start, **options)


def main() -> None:
    folder, start, (place, _, step) = Path(sys.argv[1]), sys.argv[2], sys.argv[3].partition(":")
    jax.config.update("jax_numpy_rank_promotion", "raise")
    if place == "checkpoint":
        checksums = checkpoint._checksums

        def die_while_writing(writing):
            # The state is on disk, the manifest is not.
            if ".writing" in writing.name and int(checkpoint.load_arrays(writing / "state")["step"]) == int(step):
                os.kill(os.getpid(), signal.SIGKILL)
            return checksums(writing)

        checkpoint._checksums = die_while_writing

    evaluations = iter(range(10, 31, 10)) if start == "new" else iter(())

    def evaluate(params):
        if place == "evaluation" and next(evaluations) == int(step):
            os.kill(os.getpid(), signal.SIGKILL)
        return score(params)

    run(folder, start=start, evaluate=evaluate)


if __name__ == "__main__":
    main()

"""One of several processes that train the stub task: `python -m tests.training.many_processes FOLDER PORT N I START`.

START "new", "resume", or "shared", which is new with a state that all share, as is "unpictured", which cannot draw;
"early" sends this process SIGTERM while it reads its data, "stopped" in its first evaluation, "killed" SIGKILL in its
second one; "unreadable:STEP" cannot read the data of an update, "fewer" lacks one of the examples. It evaluates
with predictions, which all processes make together, and draws with predictions of its own.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
from pathlib import Path

import jax
import numpy as np

from tests.training.many_devices import EVENLY, Line
from tests.training.stub import line_arrays
from tests.training.stub_run import run
from tflane_jax import processes
from tflane_jax.cli import _ending_on_sigterm
from tflane_jax.errors import UserError
from tflane_jax.evaluation.predict import predicted_batches, predictions

CONFIG = dataclasses.replace(EVENLY, seeds=(0,))


def total(params) -> float:
    """Return the sum of all predictions; every process gets all examples with them, of which it loads its own."""
    found, examples = 0.0, line_arrays() | {"even": np.arange(20) % 2 == 0, "none": np.zeros((20, 0, 2))}
    for indices, batch, answer in predicted_batches(Line(), params, examples, 8):
        for name, value in batch.items():
            np.testing.assert_array_equal(value[: len(indices)], examples[name][list(indices)])
        found += float(np.abs(answer).sum())
    assert found == sum(float(np.abs(answer).sum()) for _, answer in predictions(Line(), params, line_arrays(), 8))
    return found


def score(params) -> dict[str, float]:
    return {"score": -total(params)}


def draw(folder: Path, step: int, params, records) -> None:
    (folder / "picture.txt").write_text(f"{step} {total(params)} {len(records)}")


def main() -> None:
    folder, port, count, index, start = sys.argv[1:]
    jax.config.update("jax_numpy_rank_promotion", "raise")
    if int(count) > 1:
        processes.join(f"localhost:{port}", int(count), int(index))

    evaluations = iter(range(1, 9))

    def evaluate(params):
        number = next(evaluations)
        if start == "stopped":
            os.kill(os.getpid(), signal.SIGTERM)
        if (start, number) == ("killed", 2):
            os.kill(os.getpid(), signal.SIGKILL)
        return score(params)

    def prepare(example, key):
        if start == f"unreadable:{key[1]}":
            raise UserError("cannot read image.jpg")
        return example

    begin = "resume" if start == "resume" else "new"
    try:
        config = dataclasses.replace(CONFIG, shard_state=start in ("shared", "unpictured"))
        others = {"evaluate": evaluate, "draw": None if start == "unpictured" else draw}
        with processes.leaving():
            with processes.agreed():
                if start == "early":
                    os.kill(os.getpid(), signal.SIGTERM)
                others["arrays"] = line_arrays(19 if start == "fewer" else 20)
            result = run(Path(folder), start=begin, config=config, prepare=prepare, **others)
    except UserError as error:
        print(json.dumps({"error": str(error)}))
        return
    print(json.dumps(dataclasses.asdict(result) | {"processes": processes.process_count()}))


if __name__ == "__main__":
    with _ending_on_sigterm():  # as the command line does, before it joins
        main()

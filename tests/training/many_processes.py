"""One of several processes that train the stub task: `python -m tests.training.many_processes FOLDER PORT N I START`.

START "new", "resume", or "shared", which is new with a state that all share; "stopped" sends this process SIGTERM in
its first evaluation. It evaluates with predictions, which all processes make together, and draws with predictions of
its own.
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
from tflane_jax.errors import UserError
from tflane_jax.evaluation.predict import predictions

CONFIG = dataclasses.replace(EVENLY, seeds=(0,))


def total(params) -> float:
    """Return the sum of all predictions."""
    return float(sum(np.abs(answer).sum() for _, answer in predictions(Line(), params, line_arrays(), 8)))


def score(params) -> dict[str, float]:
    return {"score": -total(params)}


def draw(folder: Path, step: int, params, records) -> None:
    (folder / "picture.txt").write_text(f"{step} {total(params)} {len(records)}")


def main() -> None:
    folder, port, count, index, start = sys.argv[1:]
    jax.config.update("jax_numpy_rank_promotion", "raise")
    if int(count) > 1:
        processes.join(f"localhost:{port}", int(count), int(index))

    def evaluate(params):
        if start == "stopped":
            os.kill(os.getpid(), signal.SIGTERM)
        return score(params)

    begin = "resume" if start == "resume" else "new"
    try:
        config = dataclasses.replace(CONFIG, shard_state=start == "shared")
        result = run(Path(folder), start=begin, config=config, evaluate=evaluate, draw=draw)
    except UserError as error:
        print(json.dumps({"error": str(error)}))
        return
    print(json.dumps(dataclasses.asdict(result) | {"processes": processes.count()}))


if __name__ == "__main__":
    main()

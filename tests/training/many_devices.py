"""Train the stub task on all devices of this process: `python -m tests.training.many_devices FOLDER`; facts as JSON.

The number of devices is set before JAX starts: XLA_FLAGS=--xla_force_host_platform_device_count=8.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import jax
import numpy as np

from tests.training.stub import LineTask, line_arrays
from tests.training.stub_run import CONFIG, run
from tflane_jax.devices import active, divided, training_mesh
from tflane_jax.errors import UserError
from tflane_jax.evaluation.predict import predictions
from tflane_jax.matching import match

BATCH = 8
EVENLY = dataclasses.replace(CONFIG, batch_size=BATCH, seeds=(0, 1))


def assignments(backend: str) -> list:
    """Return the assignment of random problems of a batch, from a program for all devices."""
    rng = np.random.default_rng(0)
    cost, valid = rng.random((BATCH, 2, 9, 5), np.float32), rng.random((BATCH, 1, 5)) < 0.7
    mesh = training_mesh(BATCH)
    with active(mesh):
        found = jax.jit(lambda c, v: match(c, v, backend))(divided(cost, mesh), divided(valid, mesh))
    return np.where(found.matched, found.query, -1).tolist()


def refused() -> str:
    try:
        training_mesh(BATCH + 1)
    except UserError as error:
        return str(error)
    return ""


class Line(LineTask):
    """The stub as evaluation calls it."""

    streams = False


def predicted(batch_size: int) -> list:
    arrays = line_arrays()
    params = jax.tree.map(np.asarray, Line().init(jax.random.key(3), {"x": arrays["x"][0]}))
    return np.concatenate([answer for _, answer in predictions(Line(), params, arrays, batch_size)]).tolist()


def main() -> None:
    folder = Path(sys.argv[1])
    jax.config.update("jax_numpy_rank_promotion", "raise")
    run(folder / "whole", config=EVENLY)
    run(folder / "resumed", config=EVENLY)
    for step in (28, 30):
        shutil.rmtree(folder / "resumed" / "checkpoints" / f"step_{step:08d}")
    run(folder / "resumed", start="resume", config=EVENLY)
    facts = {
        "devices": jax.device_count(),
        "assignments": {backend: assignments(backend) for backend in ("jax", "scipy")},
        "refused": refused(),
        "predicted": predicted(BATCH),
        "predicted by one": predicted(BATCH - 1),
    }
    print(json.dumps(facts))


if __name__ == "__main__":
    main()

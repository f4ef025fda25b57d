"""Losses of small models on all devices of this process: `python -m tests.training.divided_losses NAME`, as JSON.

The number of devices is set before JAX starts: XLA_FLAGS=--xla_force_host_platform_device_count=2.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from tests.models.cases import LIFTED_LINES, make_depth_example
from tests.models.images import road_image, tiny_task
from tests.parameters import random_params
from tflane_jax.devices import active, divided, everywhere, replicated, training_mesh
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

BATCH = 4
LINES = replace(LIFTED_LINES, decoder=replace(LIFTED_LINES.decoder, dropout=0.1))
CASES: dict[str, tuple[Any, Any]] = {
    "lstr": (tiny_task(), road_image),
    "maptrv2": (LaneGraphTask(LINES, MapTrV2LossConfig(many_repeats=2)), make_depth_example),
}
"""By name: a task and a function seed -> example. Both have batch norms that learn, and dropout; MapTRv2 also depth."""


def losses(name: str) -> dict[str, Any]:
    """Return loss, terms and running statistics of a batch of different examples, without near-ties to match."""
    task, make = CASES[name]
    params = random_params(task.init, make(0), spread=0.1)
    batch: Any = jax.tree.map(lambda *leaves: np.stack(leaves), *[make(seed) for seed in range(BATCH)])
    mesh = training_mesh(BATCH)
    with active(mesh):
        program = jax.jit(task.loss, out_shardings=everywhere(mesh))
        loss, terms = program(replicated(params, mesh), divided(batch, mesh), jax.random.key(0))
    found = {"loss": loss} | {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree.leaves_with_path(terms)}
    return {name: np.asarray(value).tolist() for name, value in found.items()}


def main() -> None:
    jax.config.update("jax_numpy_rank_promotion", "raise")
    print(json.dumps({"devices": jax.device_count(), "losses": losses(sys.argv[1])}))


if __name__ == "__main__":
    main()

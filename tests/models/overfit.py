"""Train a configuration on twenty frames and print its scores on them, as JSON: `python -m tests.models.overfit NAME`.

A process of its own, because the tests' own programs are unoptimised and 1,500 updates with them take half an hour.
"""

import json
import sys
from dataclasses import replace

import jax
import numpy as np

from tflane_jax.config import WorldData, load_config
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training.schedule import make_optimizer
from tflane_jax.training.state import init_states
from tflane_jax.training.step import make_update_step

STEPS, BATCH = 1500, 4


def overfit(name: str) -> dict[str, dict[str, float]]:
    """Return the scores of each group of frames or lanes, as fractions."""
    config = load_config(name)
    task, data = config.task, config.data
    assert isinstance(task, LaneGraphTask)
    assert isinstance(data, WorldData)
    optim = replace(config.optim, ema_decay=0.99)
    frames = task.load(replace(data, train=5).source("train"), progress=False)
    [state] = init_states(task, make_optimizer(optim, STEPS), [0], jax.tree.map(lambda leaf: leaf[0], frames))
    update, rng = make_update_step(task, optim, STEPS), np.random.default_rng(0)
    for _ in range(STEPS // 5):
        for rows in rng.permutation(20).reshape(5, BATCH):
            state, metrics = update(state, jax.tree.map(lambda leaf, rows=rows: leaf[rows], frames))
    assert metrics["finite"]
    return task.evaluate(state.ema_params, frames, EvaluationConfig()).groups


if __name__ == "__main__":
    configure_jax()
    json.dump(overfit(sys.argv[1]), sys.stdout)

"""The small configurations can represent what they are trained on: a capacity test, not one of generalisation."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tflane_jax.config import WorldData, load_config
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.schedule import make_optimizer
from tflane_jax.training.state import init_states
from tflane_jax.training.step import make_update_step

STEPS, BATCH = 1500, 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "group", "score"),
    [
        ("tf_lane/toponet", "all", "DET_l@1.0"),
        ("tf_lane/toponet:street", "all", "DET_l@1.0"),
        ("tf_lane/lanesegnet:street", "all", "AP_ls@1.0"),
        ("tf_lane/maptr:street", "lines", "mAP@1.0"),
        ("tf_lane/maptrv2:street", "lines", "mAP@1.0"),
    ],
)
def test_twenty_frames_are_learned_to_a_metre(name, group, score):
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
    scores = task.evaluate(state.ema_params, frames, EvaluationConfig()).groups[group]
    assert scores[score] > 0.8, scores

"""Which job a worker takes next."""

from dataclasses import replace
from pathlib import Path

import pytest

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.training_queue import choose
from tflane_jax.config import RunConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

TASKS = [LaneGraphTask(TopoNetConfig(), clip=clip) for clip in (1, 2, 3)]


def job(model, seed):
    config = RunConfig(TASKS[model])
    return Job(replace(config, training=replace(config.training, seeds=(seed,))), Path(f"{model}/{seed}"))


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_every_model_gets_a_seed_before_any_gets_the_next(workers):
    waiting = [job(model, seed) for seed in (3, 4) for model in range(3)]
    compiled = [set() for _ in range(workers)]
    seeds = []
    for turn in range(6):
        mine = compiled[turn % workers]
        others = set().union(*(tasks for tasks in compiled if tasks is not mine))
        chosen = choose(waiting, mine, others)
        waiting.remove(chosen)
        mine.add(chosen.config.task)
        seeds += chosen.config.training.seeds
    assert seeds == [3, 3, 3, 4, 4, 4]


def test_a_worker_prefers_what_it_has_compiled_then_what_nobody_has():
    waiting = [job(model, 0) for model in range(3)] + [job(0, 1)]
    assert choose(waiting, {TASKS[2]}, {TASKS[0]}) is waiting[2]
    assert choose(waiting, set(), {TASKS[0]}) is waiting[1]
    assert choose(waiting, set(), set(TASKS)) is waiting[0]

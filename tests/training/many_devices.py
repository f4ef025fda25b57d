"""Train the stub task on all devices of this process: `python -m tests.training.many_devices FOLDER`; facts as JSON.

The number of devices is set before JAX starts: XLA_FLAGS=--xla_force_host_platform_device_count=8.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import WITH_TRAFFIC, make_example
from tests.parameters import random_params
from tests.training.stub import LineTask, line_arrays
from tests.training.stub_run import CONFIG, OPTIM, TASK, run, score
from tflane_jax.devices import active, divided, everywhere, made_on_host, replicated, training_mesh
from tflane_jax.errors import UserError
from tflane_jax.evaluation.predict import predictions
from tflane_jax.layers.batch_norm import BATCH_AXIS, STATISTICS, BatchNorm
from tflane_jax.matching import match
from tflane_jax.scene import stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.sharding import placed
from tflane_jax.training.state import init_states
from tflane_jax.training.step import UpdateForm, compiled_update

BATCH = 8
EVENLY = dataclasses.replace(CONFIG, batch_size=BATCH, seeds=(0, 1))
SHARED = dataclasses.replace(EVENLY, shard_state=True)


def assignments(backend: str) -> list:
    """Return the assignment of random problems of a batch, from a program for all devices."""
    rng = np.random.default_rng(0)
    cost, valid = rng.random((BATCH, 2, 9, 5), np.float32), rng.random((BATCH, 1, 5)) < 0.7
    mesh = training_mesh(BATCH)
    with active(mesh):
        found = jax.jit(lambda c, v: match(c, v, backend))(divided(cost, mesh), divided(valid, mesh))
    return np.where(found.matched, found.query, -1).tolist()


def refused() -> dict[str, str]:
    """Return the messages about a batch that does not divide, and about a matcher that could wait for itself."""
    said = {}
    for name, ask in {"batch": lambda: training_mesh(BATCH + 1), "matcher": lambda: assignments("scipy")}.items():
        with pytest.raises(UserError) as error:
            ask()
        said[name] = str(error.value)
    return said


class Line(LineTask):
    """The stub as evaluation calls it."""

    streams = False


def predicted(batch_size: int) -> list:
    arrays = line_arrays()
    params = jax.tree.map(np.asarray, Line().init(jax.random.key(3), {"x": arrays["x"][0]}))
    return np.concatenate([answer for _, answer in predictions(Line(), params, arrays, batch_size)]).tolist()


def host_terms() -> dict[str, float]:
    """Return loss terms and gradient norm of a small TopoNet with traffic flow, of parameters without near-ties."""
    task = LaneGraphTask(WITH_TRAFFIC)
    params = random_params(task.init, make_example(), spread=0.1)
    batch, mesh = stack_examples([make_example(i) for i in range(BATCH)]), training_mesh(BATCH)
    with active(mesh):
        program = jax.jit(jax.value_and_grad(task.loss, has_aux=True), out_shardings=everywhere(mesh))
        (loss, terms), gradient = program(replicated(params, mesh), divided(batch, mesh), jax.random.key(0))
    return {
        "loss": float(loss),
        "gradient": float(np.sqrt(sum(np.square(leaf).sum() for leaf in jax.tree.leaves(gradient)))),
    } | {name: float(value) for name, value in terms.items()}


class Quiet(LineTask):
    """The stub without dropout, whose loss is a mean over examples."""

    def loss(self, params, batch, key):
        fit = ((jax.vmap(lambda x: self._apply(params, x))(batch["x"]) - batch["y"][:, None]) ** 2).mean()
        return fit, {"fit": fit} | self._statistics(params, batch)


def in_parts(accumulate: int = 2) -> list:
    """Return parameters after an update of a batch that passes through the model in parts, and the number of gathers.

    Each device holds examples of every part, so that no example moves.
    """
    arrays, optim = line_arrays(2 * BATCH), OptimConfig(lr=0.05, warmup_steps=0)
    mesh = training_mesh(2 * BATCH, accumulate)
    [state] = init_states(Quiet(), make_optimizer(optim, 9), [0], {"x": arrays["x"][0]})
    state, batch = replicated(state, mesh), divided(arrays, mesh)
    update: Any = compiled_update(Quiet(), optim, 9, state, batch, UpdateForm(mesh=mesh, accumulate=accumulate))
    moved = sum(update.as_text().count(name) for name in (" all-gather(", " all-to-all(", " collective-permute("))
    return [np.asarray(update(state, batch)[0].params["line"]["kernel"]).tolist(), moved]


def normalised(*, frozen: bool = False) -> dict[str, Any]:
    """Return what a batch norm in training gives for a divided batch, and the number of exchanges between devices."""
    x = np.random.default_rng(5).normal(size=(BATCH, 3, 2)).astype(np.float32)
    x += np.arange(BATCH, dtype=np.float32)[:, None, None]  # devices have different means
    norm, mesh = BatchNorm(frozen), training_mesh(BATCH)
    variables = norm.init(jax.random.key(0), x[0], train=True)

    def apply(variables, x):
        one = lambda x: norm.apply(variables, x, train=True, mutable=[STATISTICS])  # noqa: E731
        return jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, None))(x)

    with active(mesh):
        program: Any = jax.jit(apply).lower(replicated(variables, mesh), divided(x, mesh)).compile()
        found, updated = program(replicated(variables, mesh), divided(x, mesh))
    exchanges = program.as_text().count(" all-reduce(") + program.as_text().count(" all-reduce-start(")
    statistics = {name: np.asarray(value).tolist() for name, value in updated[STATISTICS].items()}
    return {"output": np.asarray(found).tolist(), "statistics": statistics, "exchanges": exchanges}


def shared_by_turns(folder: Path) -> None:
    """Train with a state that the devices share up to step 10, whole on each up to 20, and shared again."""
    stopped = []

    def evaluate_and_stop(params):
        stopped.append(params)
        if len(stopped) == 2:  # both seeds
            os.kill(os.getpid(), signal.SIGTERM)
        return score(params)

    run(folder, config=SHARED, evaluate=evaluate_and_stop)
    stopped.clear()
    run(folder, start="resume", config=EVENLY, evaluate=evaluate_and_stop)
    run(folder, start="resume", config=SHARED)


def updated(optim: OptimConfig, *, shard: bool) -> Any:
    """Return the state of the stub after the first update of `run`, on the devices."""
    arrays, mesh = line_arrays(BATCH), training_mesh(BATCH)
    [state] = init_states(TASK, make_optimizer(optim, CONFIG.steps), [0], {"x": arrays["x"][0]})
    state, batch = placed(state, mesh, shard=shard), divided(arrays, mesh)
    form = UpdateForm(donate=False, mesh=mesh, shard_state=shard)
    return compiled_update(TASK, optim, CONFIG.steps, state, batch, form)(state, batch)[0]


def held() -> dict[str, list]:
    """Return the numbers of each vector of a shared state after an update, and how many of them each device holds."""
    vectors = jax.tree_util.tree_flatten_with_path(updated(OPTIM, shard=True))[0]
    return {
        jax.tree_util.keystr(path): [leaf.size, [shard.data.size for shard in leaf.addressable_shards]]
        for path, leaf in vectors
        if leaf.ndim
    }


def beginning() -> dict[str, Any]:
    """Return where initial parameters are computed and where they lie, if the second device is an accelerator."""
    optimizer, example = make_optimizer(OPTIM, CONFIG.steps), {"x": line_arrays()["x"][0]}
    expected = init_states(TASK, optimizer, [0], example)
    with mock.patch.object(jax, "default_backend", return_value="gpu"), jax.default_device(jax.devices()[1]):
        computed = made_on_host(lambda: np.asarray(jnp.zeros(3).device.id))
        found = init_states(TASK, optimizer, [0], example)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return {
        "computed": int(computed),
        "lies": sorted({device.id for leaf in jax.tree.leaves(found) for device in leaf.devices()}),
        "equal": all((jax.device_get(leaf) == jax.device_get(other)).all() for leaf, other in pairs),
    }


def with_muon() -> list:
    """Return the stub's kernel after an update by Muon, with the state on every device, and shared."""
    muon = dataclasses.replace(OPTIM, optimizer="muon")
    return [np.asarray(updated(muon, shard=shard).params["line"]["kernel"]).tolist() for shard in (False, True)]


def main() -> None:
    folder = Path(sys.argv[1])
    jax.config.update("jax_numpy_rank_promotion", "raise")
    run(folder / "whole", config=EVENLY)
    run(folder / "resumed", config=EVENLY)
    for step in (28, 30):
        shutil.rmtree(folder / "resumed" / "checkpoints" / f"step_{step:08d}")
    run(folder / "resumed", start="resume", config=EVENLY)
    shared_by_turns(folder / "shared")
    facts = {
        "devices": jax.device_count(),
        "assignments": assignments("jax"),
        "refused": refused(),
        "predicted": predicted(BATCH),
        "predicted by one": predicted(BATCH - 1),
        "in parts": in_parts(),
        "norms": {"learned": normalised(), "frozen": normalised(frozen=True)},
        "held": held(),
        "beginning": beginning(),
        "host": host_terms() if jax.device_count() == 2 else {},  # compiling takes long
        "muon": with_muon() if jax.device_count() == 2 else [],
    }
    print(json.dumps(facts))


if __name__ == "__main__":
    main()

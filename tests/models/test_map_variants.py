"""The variants of MapTRv2's configuration learn: a step with the fourth class, and a step with heights."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.datasets.test_argoverse2_real import FLAT, real_log
from tests.models.cases import LINES
from tests.parameters import random_params
from tflane_jax.config import load_config
from tflane_jax.datasets import sources
from tflane_jax.datasets.examples import make_example
from tflane_jax.scene import LineClass, stack_examples

pytestmark = pytest.mark.slow


def small(name):
    """Return a configuration of MapTRv2 and its task, with small layers."""
    config = load_config(f"tf_lane/maptrv2:{name}")
    model = config.task.model
    decoder = replace(model.decoder, dim=16, heads=2, layers=1, hidden=16, sampling_points=2)
    encoder = replace(LINES.encoder, range=model.encoder.range)
    return config, replace(config.task, model=replace(model, decoder=decoder, encoder=encoder))


def step(task, examples):
    """Return parameters, loss, report and gradient of one batch."""
    params = random_params(task.init, examples[0])
    run = jax.jit(jax.value_and_grad(task.loss, has_aux=True))
    batch = stack_examples(examples)
    (loss, report), gradient = run(params, batch, jax.random.key(0))
    assert np.isfinite(loss)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert report["matching/lines"] == np.mean([example.map_lines.valid.sum() for example in examples])
    return params, loss, gradient, lambda changed: run(params, stack_examples(changed), jax.random.key(0))[0][0]


def test_a_step_with_centerlines():
    config, task = small("street_centerlines")
    source = replace(config.data.source("train"), scenes=1)
    dataset = sources.make_dataset(source)
    examples = [dataset.example(i) for i in (0, 1)]
    assert all((e.map_lines.category[e.map_lines.valid] == LineClass.CENTERLINE).any() for e in examples)
    params, _, gradient, _ = step(task, examples)
    assert task.predict(params, examples[0]).lines.logits.shape == (task.model.decoder.queries, 4)
    bias = gradient["heads_0"]["class"]
    assert all(np.abs(np.asarray(leaf)[..., LineClass.CENTERLINE]).max() > 0 for leaf in _last(bias))


def test_a_step_with_heights():
    config, task = small("argoverse2")
    log = real_log(FLAT, "traffic")
    examples = [make_example(log, i, config.data.example) for i in (0, 9)]
    params, loss, _, loss_of = step(task, examples)
    found = task.predict(params, examples[0]).lines
    assert found.points.shape[-1] == 3
    lines = examples[0].map_lines
    raised = lines.replace(points=lines.points + np.float32([0.0, 0.0, 0.5]))
    assert abs(loss_of([examples[0].replace(map_lines=raised), examples[1]]) - loss) > 1e-3
    metrics = task.evaluate(params, stack_examples(examples), replace(config.evaluation, batch_size=2))
    assert "with heights" in metrics.protocol


def _last(branch):
    """Return weight and bias of the last layer of a branch."""
    return jax.tree.leaves(branch[max(branch)])

"""Learning rate, weight decay and clipping against formulas in numpy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.training.schedule import OptimConfig, is_decayed, make_optimizer, make_schedule


@pytest.mark.parametrize(("warmup", "steps"), [(0, 1), (0, 10), (1, 2), (5, 40), (39, 40)])
def test_schedule_is_linear_then_cosine(warmup, steps):
    config = OptimConfig(lr=0.2, warmup_steps=warmup, warmup_ratio=0.25, final_ratio=0.1)
    schedule = make_schedule(config, steps)
    for step in range(steps + 3):
        if step < warmup:
            expected = 0.2 * (0.25 + 0.75 * step / warmup)
        else:
            progress = min((step - warmup) / (steps - warmup), 1.0)
            expected = 0.2 * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * progress)))
        np.testing.assert_allclose(schedule(step), expected, rtol=1e-5)


@pytest.mark.parametrize(("warmup", "steps"), [(10, 10), (-1, 10), (0, 0)])
def test_warm_up_that_does_not_end_is_refused(warmup, steps):
    with pytest.raises(UserError, match=r"optim\.warmup_steps"):
        make_schedule(OptimConfig(warmup_steps=warmup), steps)


def test_decay_leaves_biases_and_norms_alone():
    params = {
        "dense": {"kernel": jnp.ones((2, 3)), "bias": jnp.ones(3)},
        "attention": {"kernel": jnp.ones((2, 4, 3)), "bias": jnp.ones((4, 3))},
        "norm": {"scale": jnp.ones(3), "bias": jnp.ones(3)},
        "queries": {"embedding": jnp.ones((5, 3))},
    }
    assert is_decayed(params) == {
        "dense": {"kernel": True, "bias": False},
        "attention": {"kernel": True, "bias": False},
        "norm": {"scale": False, "bias": False},
        "queries": {"embedding": True},
    }


def test_first_update_is_adamw_with_clipping():
    config = OptimConfig(lr=0.1, warmup_steps=0, weight_decay=0.5, clip_norm=1.0)
    params = {"kernel": jnp.full((1, 2), 3.0), "bias": jnp.full(2, 3.0)}
    grads = {"kernel": jnp.array([[30.0, 0.0]]), "bias": jnp.array([0.0, 40.0])}
    optimizer = make_optimizer(config, 100)
    updates, _ = jax.jit(optimizer.update)(grads, optimizer.init(params), params)
    # Norm 50, so gradients become 0.6 and 0.8; Adam's first step is g / (|g| + eps); decay adds 0.5 * 3 to the kernel.
    np.testing.assert_allclose(updates["kernel"], [[-0.1 * (1 + 1.5), -0.1 * 1.5]], rtol=1e-4)
    np.testing.assert_allclose(updates["bias"], [0.0, -0.1], rtol=1e-4)

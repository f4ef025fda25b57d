"""Learning rate, weight decay and clipping against formulas in numpy and the numbers of PyTorch and mmcv."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.golden import case_id, golden_modules, load_module_case
from tflane_jax.errors import UserError
from tflane_jax.training.restarts import RestartsConfig
from tflane_jax.training.schedule import (
    DropsConfig,
    OptimConfig,
    make_optimizer,
    make_rate,
    make_schedule,
    scaled_to_batch,
    schedule_notices,
)
from tflane_jax.training.vectors import layout_of, norm, ravel

CASES = pytest.mark.parametrize("path", golden_modules("lr_schedules*"), ids=case_id)
LONG = 10**6  # steps: a run that ends within none of the cycles below


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


def as_vectors(tree):
    return ravel(tree, layout_of(tree))


def updates_of(optimizer, grads, params, count=1):
    """Return the trees of several updates with the same gradients (the parameters stay as they are)."""
    grads, params = as_vectors(grads), as_vectors(params)
    state, update, found = optimizer.init(params), jax.jit(optimizer.update), []
    for _ in range(count):
        updates, state = update(grads, state, params)
        found.append(updates.tree())
    return found


def test_decay_leaves_biases_and_norms_alone():
    params = {
        "dense": {"kernel": jnp.ones((2, 3)), "bias": jnp.ones(3)},
        "attention": {"kernel": jnp.ones((2, 4, 3)), "bias": jnp.ones((4, 3))},
        "norm": {"scale": jnp.ones(3), "bias": jnp.ones(3)},
        "stem": {"kernel": jnp.ones((3, 3, 2, 4))},
        "queries": {"embedding": jnp.ones((5, 3))},
    }
    config = OptimConfig(lr=1.0, warmup_steps=0, weight_decay=0.5, clip_norm=np.inf)
    plain, decayed = (
        updates_of(make_optimizer(each, 10), params, params)[0] for each in (replace(config, weight_decay=0.0), config)
    )
    assert jax.tree.map(lambda a, b: float(np.round(a - b, 4).mean()), plain, decayed) == {
        "dense": {"kernel": 0.5, "bias": 0.0},
        "attention": {"kernel": 0.5, "bias": 0.0},
        "norm": {"scale": 0.0, "bias": 0.0},
        "stem": {"kernel": 0.5},
        "queries": {"embedding": 0.5},
    }


def test_decay_of_all_spares_only_what_does_not_learn():
    params = {"dense": {"kernel": jnp.ones((2, 3)), "bias": jnp.ones(3)}, "norm": {"scale": jnp.ones(3)}}
    grads = params | {"norm": {"scale": jnp.zeros(3)}}
    config = OptimConfig(lr=1.0, warmup_steps=0, weight_decay=0.5, decayed="all", clip_norm=np.inf)
    plain, decayed = (
        updates_of(make_optimizer(each, 10), grads, params)[0] for each in (replace(config, weight_decay=0.0), config)
    )
    assert jax.tree.map(lambda a, b: float(np.round(a - b, 4).mean()), plain, decayed) == {
        "dense": {"kernel": 0.5, "bias": 0.5},
        "norm": {"scale": 0.0},
    }


def test_first_update_is_adamw_with_clipping():
    config = OptimConfig(lr=0.1, warmup_steps=0, weight_decay=0.5, clip_norm=1.0)
    params = {"kernel": jnp.full((1, 2), 3.0), "bias": jnp.full(2, 3.0)}
    grads = {"kernel": jnp.array([[30.0, 0.0]]), "bias": jnp.array([0.0, 40.0])}
    (updates,) = updates_of(make_optimizer(config, 100), grads, params)
    # Norm 50, so gradients become 0.6 and 0.8; Adam's first step is g / (|g| + eps); decay adds 0.5 * 3 to the kernel.
    np.testing.assert_allclose(updates["kernel"], [[-0.1 * (1 + 1.5), -0.1 * 1.5]], rtol=1e-4)
    np.testing.assert_allclose(updates["bias"], [0.0, -0.1], rtol=1e-4)


def test_coupled_decay_is_added_to_the_clipped_gradient():
    # With a huge epsilon, and as huge a learning rate, Adam's first update is the gradient itself.
    config = OptimConfig(lr=1e8, eps=1e8, warmup_steps=0, final_ratio=1.0, weight_decay=0.5, decay="coupled")
    optimizer = make_optimizer(replace(config, clip_norm=1.0), LONG)
    grads, params = {"kernel": jnp.array([[30.0, 40.0]])}, {"kernel": jnp.full((1, 2), 2.0)}
    (updates,) = updates_of(optimizer, grads, params)
    np.testing.assert_allclose(updates["kernel"], [[-(0.6 + 1.0), -(0.8 + 1.0)]], rtol=1e-5)


def test_parameters_without_gradients_do_not_decay():
    params = {"frozen": {"kernel": jnp.ones((2, 2))}, "learned": {"kernel": jnp.ones((2, 2))}}
    grads = {"frozen": {"kernel": jnp.zeros((2, 2))}, "learned": {"kernel": jnp.array([[1.0, 0.0], [0.0, 0.0]])}}
    for decay in ("decoupled", "coupled"):
        optimizer = make_optimizer(OptimConfig(lr=0.1, warmup_steps=0, weight_decay=0.5, decay=decay), 10)
        (updates,) = updates_of(optimizer, grads, params)
        np.testing.assert_array_equal(updates["frozen"]["kernel"], 0.0)
        assert (updates["learned"]["kernel"] < -0.01).all()


def test_muon_makes_the_updates_of_matrices_orthogonal_and_leaves_the_rest_to_adam():
    rng = np.random.default_rng(0)
    # Two thousand times as much of one direction as of another.
    left, right = np.linalg.qr(rng.normal(size=(6, 6)))[0], np.linalg.qr(rng.normal(size=(4, 4)))[0]
    kernel = jnp.asarray(left[:, :4] @ np.diag([20.0, 1.0, 0.1, 0.01]) @ right.T, jnp.float32)
    other = jnp.asarray(rng.normal(size=(6, 4)), jnp.float32)
    grads = {"kernel": kernel, "embedding": other, "bias": other[0]}
    params = jax.tree.map(jnp.zeros_like, grads)
    config = OptimConfig(lr=0.1, warmup_steps=0, weight_decay=0.0, clip_norm=np.inf)
    one, all_adam = (
        updates_of(make_optimizer(replace(config, optimizer=kind), 10), grads, params)[0] for kind in ("muon", "adam")
    )
    found, expected = -np.asarray(one["kernel"]), left[:, :4] @ right.T
    # Newton's iterations leave singular values about one; root mean square 0.2 stands for sqrt(6) times that.
    values = np.linalg.svd(found, compute_uv=False) / (0.1 * 0.2 * np.sqrt(6))
    assert values[0] < 1.3
    assert values[2] > 0.6
    assert (found * expected).sum() > 0.8 * np.linalg.norm(found) * np.linalg.norm(expected)
    for name in ("embedding", "bias"):
        np.testing.assert_allclose(one[name], all_adam[name], rtol=1e-5)


def test_new_settings_are_off_by_default():
    config = OptimConfig(lr=0.1, warmup_steps=2)
    params = {"kernel": jnp.full((1, 2), 3.0), "bias": jnp.full(2, 3.0)}
    grads = jax.tree.map(lambda leaf: leaf / 7, params)
    adamw = optax.adamw(make_schedule(config, 9), b1=0.9, b2=0.999, eps=1e-8, weight_decay=0.01, mask=decayed_by_name)
    state = adamw.init(params)
    for found in updates_of(make_optimizer(config, 9), grads, params, count=4):
        expected, state = jax.jit(adamw.update)(grads, state, params)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found, expected)


def decayed_by_name(params):
    return {name: name == "kernel" for name in params}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epoch_steps": -1}, r"optim\.epoch_steps is -1"),
        ({"epoch_steps": 5, "restarts": RestartsConfig()}, "exclude each other"),
        ({"restarts": RestartsConfig(cycle_steps=0)}, r"restarts\.cycle_steps is 0"),
        ({"restarts": RestartsConfig(factor=0.5)}, r"restarts\.factor is 0\.5"),
        ({"restarts": RestartsConfig(floor=-0.1)}, r"restarts\.floor is -0\.1"),
    ],
)
def test_invalid_settings_are_named(change, message):
    for make in (make_optimizer, make_rate):
        with pytest.raises(UserError, match=message):
            make(OptimConfig(warmup_steps=0, **change), 10)


@pytest.mark.parametrize(("epoch_steps", "steps"), [(1, 1), (4, 4), (4, 12), (5, 12)])
def test_schedule_by_epoch_is_constant_within_epochs(epoch_steps, steps):
    schedule = make_schedule(OptimConfig(lr=0.2, warmup_steps=0, final_ratio=0.1, epoch_steps=epoch_steps), steps)
    rates = np.array([schedule(step) for step in range(steps)])
    epochs = math.ceil(steps / epoch_steps)
    for step, rate in enumerate(rates):
        expected = 0.2 * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * (step // epoch_steps) / epochs)))
        np.testing.assert_allclose(rate, expected, rtol=1e-6)


# ---------------------------------------------------------------------------------------------------------------------
# PyTorch and mmcv. They compute schedules in float64.


def rates_of(config: OptimConfig, steps: int, count: int) -> np.ndarray:
    """Return the learning rates of the first `count` updates of a run, as the optimizer applies them."""
    optimizer, rate = make_optimizer(config, steps), make_rate(config, steps)
    nothing = as_vectors({"kernel": jnp.zeros((1, 1))})

    def update(state, step):
        return optimizer.update(nothing, state, nothing)[1], rate(state, step)

    return np.asarray(jax.jit(lambda s: jax.lax.scan(update, s, jnp.arange(count))[1])(optimizer.init(nothing)))


@CASES
def test_warm_restarts_are_pytorchs(path):
    case = load_module_case(path)
    assert case.meta["cawr_cases"] == 10
    for i in range(case.meta["cawr_cases"]):
        first, factor, lr, least = case.inputs[f"cawr.{i}.params"]
        # PyTorch's fractional epochs come in quarters, so that a quarter is a step.
        np.testing.assert_array_equal(case.inputs[f"cawr.{i}.frac_epoch"], np.arange(48) / 4)
        for name, per_epoch in (("lr", 1), ("frac_lr", 4)):
            restarts = RestartsConfig(cycle_steps=int(first) * per_epoch, factor=factor, floor=least / lr)
            expected = case.outputs[f"cawr.{i}.{name}"]
            rates = rates_of(OptimConfig(lr=lr, warmup_steps=0, restarts=restarts), LONG, len(expected))
            np.testing.assert_allclose(rates, expected, rtol=1e-6, err_msg=f"cawr.{i}.{name}")


@CASES
def test_one_cosine_is_pytorchs(path):
    expected = load_module_case(path).outputs["cosine_annealing_T20"]
    rates = rates_of(OptimConfig(lr=1e-3, warmup_steps=0, final_ratio=0.01), 20, 21)
    # Beyond its end PyTorch's schedule rises again; our runs end before that.
    back = 20 - np.abs(np.arange(len(expected)) % 40 - 20)
    # Tolerance: float32 rounding relative to the peak, because optax's schedule is not exact near its end.
    np.testing.assert_allclose(rates[back], expected, rtol=1e-6, atol=1e-7 * 1e-3)


@CASES
def test_cosine_by_epoch_is_mmcvs(path):
    case = load_module_case(path)
    mmcv = case.meta["mmcv"]
    steps = mmcv["epochs"] * mmcv["iters_per_epoch"]
    expected = case.outputs["mmcv_cosine_warmup_lr"]
    for group, lr in enumerate(mmcv["base"]):
        config = OptimConfig(
            lr=lr,
            warmup_steps=mmcv["warmup_iters"],
            warmup_ratio=mmcv["warmup_ratio"],
            final_ratio=mmcv["min_lr_ratio"],
            epoch_steps=mmcv["iters_per_epoch"],
        )
        np.testing.assert_allclose(rates_of(config, steps, steps), expected[:, group], rtol=1e-6)


@CASES
@pytest.mark.parametrize(("name", "decay"), [("adamw", "decoupled"), ("adam", "decoupled"), ("adam_l2", "coupled")])
def test_updates_are_pytorchs(path, name, decay):
    case = load_module_case(path)
    settings = {"weight_decay": 0.0} | case.meta[name]
    constant = OptimConfig(warmup_steps=0, final_ratio=1.0, clip_norm=math.inf, decay=decay, **settings)
    optimizer = make_optimizer(constant, LONG)
    params = as_vectors({"kernel": jnp.asarray(case.inputs[f"{name}.w0"])[None]})
    state, update = optimizer.init(params), jax.jit(optimizer.update)
    for grad, expected in zip(case.inputs[f"{name}.grads"], case.outputs[f"{name}.trace"], strict=True):
        updates, state = update(as_vectors({"kernel": jnp.asarray(grad)[None]}), state, params)
        params = optax.apply_updates(params, updates)
        np.testing.assert_allclose(params.tree()["kernel"][0], expected, rtol=1e-6, atol=1e-6)


@CASES
def test_clipping_is_pytorchs(path):
    case = load_module_case(path)
    grads = {name: jnp.asarray(case.inputs[f"clip.{name}"]) for name in ("g0", "g1")}
    np.testing.assert_allclose(norm(as_vectors(grads)), case.outputs["clip.norm"], rtol=1e-6)
    # With a huge epsilon, and as huge a learning rate, Adam's first update is the clipped gradient itself.
    config = OptimConfig(
        lr=1e8, eps=1e8, warmup_steps=0, final_ratio=1.0, weight_decay=0.0, clip_norm=case.meta["clip"]["max_norm"]
    )
    (updates,) = updates_of(make_optimizer(config, LONG), grads, grads)
    for name, update in updates.items():
        np.testing.assert_allclose(-update, case.outputs[f"clip.{name}"], rtol=1e-6)


def test_a_constant_rate_drops_at_its_steps():
    config = OptimConfig(lr=2.0, warmup_steps=2, warmup_ratio=0.5, drops=DropsConfig((4, 6), 0.1))
    rates = [float(make_rate(config, 8)(None, step)) for step in range(8)]
    np.testing.assert_allclose(rates, [1.0, 1.5, 2.0, 2.0, 0.2, 0.2, 0.02, 0.02], rtol=1e-6)


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({}, []),
        ({"epoch_steps": 9}, []),
        ({"epoch_steps": 10}, ["optim.epoch_steps"]),
        ({"drops": DropsConfig((4, 9))}, []),
        ({"drops": DropsConfig((4, 10, 20))}, ["before the learning rate drops at 10"]),
        ({"restarts": RestartsConfig(7), "warmup_steps": 2}, []),
        ({"restarts": RestartsConfig(8), "warmup_steps": 2}, ["optim.restarts: the run ends at step 10, before"]),
        ({"restarts": RestartsConfig(3, last_cycle="fit"), "warmup_steps": 1}, []),
        ({"restarts": RestartsConfig(3, last_cycle="fit"), "warmup_steps": 2}, ["optim.restarts: the run ends"]),
    ],
)
def test_what_of_the_schedule_a_run_does_not_reach_is_told(settings, names):
    notices = schedule_notices(OptimConfig(**settings), 10)
    assert len(notices) == len(names)
    assert all(name in notice for name, notice in zip(names, notices, strict=True))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"drops": DropsConfig(())}, "optim.drops.steps"),
        ({"drops": DropsConfig((5, 5))}, "optim.drops.steps"),
        ({"drops": DropsConfig((0, 5))}, "optim.drops.steps"),
        ({"drops": DropsConfig((5,), 0.0)}, "optim.drops.factor"),
        ({"drops": DropsConfig(), "restarts": RestartsConfig()}, "optim.restarts exclude each other"),
        ({"drops": DropsConfig(), "epoch_steps": 3}, "optim.epoch_steps exclude each other"),
    ],
)
def test_drops_that_cannot_be_followed_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        make_optimizer(OptimConfig(warmup_steps=0, **settings), 10)


@pytest.mark.parametrize(
    ("rule", "batch", "expected"), [("none", 64, 0.1), ("linear", 64, 0.8), ("linear", 4, 0.05), ("sqrt", 32, 0.2)]
)
def test_the_rate_is_scaled_by_the_global_batch(rule, batch, expected):
    config = OptimConfig(lr=0.1, lr_scaling=rule, reference_batch=8)
    scaled = scaled_to_batch(config, batch)
    assert scaled.lr == pytest.approx(expected)
    assert replace(scaled, lr=0.1) == replace(config, lr_scaling="none")
    assert scaled_to_batch(scaled, batch) is scaled


def test_an_unscaled_rate_and_a_reference_batch_of_zero_are_refused():
    with pytest.raises(ValueError, match="scaled_to_batch"):
        make_optimizer(OptimConfig(lr_scaling="sqrt", reference_batch=8), 1000)
    with pytest.raises(UserError, match=r"optim\.reference_batch is 0"):
        scaled_to_batch(OptimConfig(reference_batch=0), 8)
    with pytest.raises(UserError, match=r"optim\.reference_batch is None: it must be the batch size"):
        scaled_to_batch(OptimConfig(lr_scaling="linear"), 8)

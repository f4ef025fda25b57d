"""Cycles of the learning rate: Eq. (2) at its ends, exact restarts, the end of the run, and changes during it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.test_config import configurations
from tests.training.test_schedule import as_vectors, rates_of
from tflane_jax.training.adaptive import AdaptiveConfig, Memory
from tflane_jax.training.restarts import (
    RestartsConfig,
    adapt,
    current_cycle,
    cycle_of,
    doubling_cycles,
    extended_cycle,
    first_cycle,
    half_cosine,
    relative_rate,
    restarted_cycle,
    with_cycle,
)
from tflane_jax.training.schedule import OptimConfig, make_optimizer, make_rate, make_schedule


def test_eq_2_at_its_ends_and_middle():
    lengths = np.array([1, 2, 7, 1000, 2**24])
    np.testing.assert_array_equal(half_cosine(0, lengths), np.ones(5))
    np.testing.assert_array_equal(half_cosine(lengths, lengths), np.zeros(5))
    np.testing.assert_allclose(half_cosine(5, 10), 0.5, rtol=1e-6)
    # One step before the end of a long cycle, where 1 + cos has no digit left.
    np.testing.assert_allclose(half_cosine(99_999, 100_000), (np.pi / 2 / 1e5) ** 2, rtol=1e-6)


def peaks(rates: np.ndarray) -> list[int]:
    return [i for i, rate in enumerate(rates) if rate == rates.max()]


@pytest.mark.parametrize(
    ("first", "factor", "expected"),
    [(1, 1.0, list(range(20))), (5, 1.0, [0, 5, 10, 15]), (3, 2.0, [0, 3, 9]), (4, 1.5, [0, 4, 10, 19])],
)
def test_restarts_come_at_exactly_their_steps(first, factor, expected):
    rates = rates_of(OptimConfig(lr=0.5, warmup_steps=0, restarts=RestartsConfig(first, factor)), 1000, 20)
    assert peaks(rates) == expected
    assert rates[0] == 0.5
    for begin, end in zip(expected, [*expected[1:], 20], strict=True):
        assert (np.diff(rates[begin:end]) < 0).all()


def test_cycles_follow_the_warm_up():
    restarts = RestartsConfig(4, 1.0, floor=0.1)
    rates = rates_of(OptimConfig(lr=0.8, warmup_steps=4, warmup_ratio=0.25, restarts=restarts), 20, 13)
    np.testing.assert_allclose(rates[:4], [0.2, 0.35, 0.5, 0.65], rtol=1e-6)
    np.testing.assert_array_equal(rates[4:8], rates[8:12])
    assert rates[4] == rates[12] == np.float32(0.8)
    np.testing.assert_allclose(rates[6], 0.8 * 0.55, rtol=1e-6)


@settings(max_examples=60)
@given(st.integers(1, 9), st.sampled_from([1.0, 1.3, 2.0, 3.0]), st.integers(0, 5), st.integers(1, 60))
def test_a_fitted_run_ends_at_the_end_of_a_cycle(first, factor, warmup, length):
    config, steps = RestartsConfig(first, factor, last_cycle="fit"), warmup + length
    cycle = jax.tree.map(np.asarray, first_cycle(config, warmup, steps))
    whole = True
    while (end := int(cycle.start + cycle.length)) < steps:
        whole &= int(cycle.length) == int(cycle.period)
        cycle = jax.tree.map(np.asarray, current_cycle(config, cycle._replace(count=np.int32(end)), steps))
        assert int(cycle.start) == end
    assert end == steps
    assert whole
    # The last one is no shorter than planned, unless it is the first and the run is shorter than that.
    assert cycle.length >= cycle.period or int(cycle.number) == 0


def test_lengths_do_not_overflow():
    config = RestartsConfig(2**28, 3.0)
    cycle = first_cycle(config, 0, 10)
    for _ in range(4):
        cycle = current_cycle(config, cycle._replace(count=cycle.start + cycle.length), 10)
        assert cycle.length > 0
        cycle = cycle._replace(start=jnp.zeros_like(cycle.start))


def test_restarts_have_no_schedule_by_step():
    with pytest.raises(ValueError, match="optimizer's state"):
        make_schedule(OptimConfig(warmup_steps=0, restarts=RestartsConfig()), 10)


# ---------------------------------------------------------------------------------------------------------------------
# Changes during a run


@settings(max_examples=60)
@given(st.integers(1, 400), st.integers(1, 400), st.floats(0.0, 3.0), st.integers(0, 900))
def test_an_extension_keeps_the_rate_and_has_the_configured_length(elapsed, left, extend, run_left):
    config, steps = RestartsConfig(elapsed + left, floor=0.2), elapsed + run_left
    cycle = jax.device_get(first_cycle(config, 0, steps))._replace(count=np.int32(elapsed))
    longer = extended_cycle(config, cycle, extend, steps)
    lasts = int(longer.start + longer.length - longer.count)
    assert lasts == max(left, min(round(left * (1 + extend)), run_left))
    # Whole steps: the place in the cycle may move by one.
    moved = np.pi / 2 / (elapsed + left)
    assert abs(float(relative_rate(config, longer) - relative_rate(config, cycle))) <= moved
    assert (longer.period, longer.number) == (cycle.period, cycle.number)
    assert longer.start.dtype == longer.length.dtype == np.int32


ADAPTIVE = AdaptiveConfig(metric="loss", patience=1, grace=0.0, extend=1.0, shrink=0.5)
OPTIM = OptimConfig(lr=0.8, warmup_steps=0, restarts=RestartsConfig(8, 2.0, floor=0.25, adaptive=ADAPTIVE))
PARAMS = as_vectors({"kernel": jnp.ones((1, 2))})


def rates_with(losses: dict[int, list[float]], *, count: int, optim=OPTIM, steps=100) -> np.ndarray:
    """Return the rates (count, seeds) of updates with evaluations before some of them; every step is traced once."""
    seeds, traces = len(next(iter(losses.values()))), 0
    optimizer, rate = make_optimizer(optim, steps), make_rate(optim, steps)

    @jax.jit
    @jax.vmap
    def update(state, step):
        nonlocal traces
        traces += 1
        return optimizer.update(PARAMS, state, PARAMS)[1], rate(state, step)

    state = jax.vmap(lambda _: optimizer.init(PARAMS))(jnp.arange(seeds))
    memories, rates = [Memory()] * seeds, []
    for step in range(count):
        if step in losses:
            evaluations = [{"loss": loss} for loss in losses[step]]
            state, memories, _ = adapt(optim.restarts, state, memories, evaluations, steps)
        state, now = update(state, jnp.full(seeds, step))
        rates.append(np.asarray(now))
    assert traces == 1
    return np.stack(rates)


def cosine(elapsed, length, magnitude=1.0):
    share = 0.25 + 0.75 * magnitude * 0.5 * (1 + np.cos(np.pi * np.asarray(elapsed) / length))
    return 0.8 * share


def test_each_seed_is_judged_by_its_own_loss():
    # At step 6 the first seed improves, the second is stuck, the third gives no number that counts.
    rates = rates_with({4: [1.0, 1.0, 1.0], 6: [0.5, 1.0, np.nan]}, count=40)
    np.testing.assert_allclose(rates[:6], np.repeat(cosine(np.arange(6), 8)[:, None], 3, 1), rtol=1e-6)
    # Extended: the last two of eight steps take four, at half the pace; then a cycle of sixteen.
    np.testing.assert_allclose(rates[6:10, 0], cosine(6 + np.arange(4) / 2, 8), rtol=1e-6)
    np.testing.assert_allclose(rates[10:26, 0], cosine(np.arange(16), 16), rtol=1e-6)
    # Restarted: eight steps from half as high over the floor, then sixteen.
    for seed in (1, 2):
        np.testing.assert_allclose(rates[6:14, seed], cosine(np.arange(8), 8, 0.5), rtol=1e-6)
        np.testing.assert_allclose(rates[14:30, seed], cosine(np.arange(16), 16, 0.5), rtol=1e-6)


def test_seeds_together_equal_each_seed_alone():
    losses = {3: [1.0, 2.0], 5: [0.9, 2.0], 12: [0.8, 1.5], 20: [0.1, 1.5]}
    together = rates_with(losses, count=40)
    for seed in range(2):
        alone = rates_with({step: [values[seed]] for step, values in losses.items()}, count=40)
        np.testing.assert_array_equal(together[:, seed], alone[:, 0])
    assert (together[:, 0] != together[:, 1]).any()


def test_an_evaluation_at_the_end_of_a_cycle_changes_nothing():
    np.testing.assert_array_equal(
        rates_with({6: [1.0], 8: [2.0]}, count=20), rates_with({6: [1.0], 8: [0.1]}, count=20)
    )


def test_a_fitted_run_ends_at_a_low_rate_whatever_the_rule_decides():
    restarts = dataclasses.replace(OPTIM.restarts, last_cycle="fit", factor=1.0)
    optim = dataclasses.replace(OPTIM, restarts=restarts)
    rng = np.random.default_rng(0)
    losses = {step: rng.uniform(1, 2, 20).tolist() for step in range(2, 64, 2)}
    rates = rates_with(losses, count=64, optim=optim, steps=64)
    assert len(np.unique(rates, axis=1).T) > 3
    assert (rates[-1] < 0.8 * 0.3).all()


@pytest.mark.parametrize(
    ("cycle_steps", "rule", "losses"),
    [
        (100, {"max_extensions": 3}, {30: 1.0, 50: 0.5, 60: 0.25, 75: 0.125}),
        (100, {"extend": 1.0, "max_extensions": 2}, {30: 1.0, 50: 0.5, 105: 0.25}),
        (30, {"extend": 1.0, "fraction": 1.0, "grace": 0.0}, {1: 1.0, 2: 0.5}),
    ],
)
def test_a_fitted_run_does_not_end_with_a_few_steps_at_the_peak(cycle_steps, rule, losses):
    """Regression: after an extension one to five steps were left, and became a cycle of their own."""
    adaptive = AdaptiveConfig(metric="loss", **rule)
    restarts = RestartsConfig(cycle_steps, 1.0, last_cycle="fit", adaptive=adaptive)
    optim, steps = OptimConfig(lr=1.0, warmup_steps=0, restarts=restarts), 2 * cycle_steps
    rates = rates_with({step: [loss] for step, loss in losses.items()}, count=steps, optim=optim, steps=steps)
    assert rates[-cycle_steps // 2 :].max() < 0.9
    assert (np.diff(rates[:, 0]) < 0.01).all()  # one cycle, or none after the first began
    assert rates[-1] < 0.01


def test_an_extended_cycle_leaves_the_next_one_at_least_half_or_nothing():
    config = RestartsConfig(100, 1.0, last_cycle="fit")
    cycle = jax.device_get(first_cycle(config, 0, 250))._replace(count=np.int32(80))
    for steps, end in ((150, 150), (159, 159), (160, 110), (300, 110)):
        longer = extended_cycle(config, cycle, 0.5, steps)
        assert longer.start + longer.length == end, steps
        assert longer.count == 80


@pytest.mark.parametrize(("count", "length"), [(14, 16), (12, 18), (10, 10), (25, 5)])
def test_a_restarted_cycle_of_a_fitted_run_leaves_no_short_rest(count, length):
    """Cycles of 10 steps, 30 in all: what does not fill another cycle after this one belongs to it."""
    config = RestartsConfig(10, 1.0, last_cycle="fit")
    stuck = jax.device_get(first_cycle(config, 0, 30))._replace(start=np.int32(10), count=np.int32(count))
    cycle = restarted_cycle(config, stuck, 0.5, 30)
    assert (cycle.start, cycle.length, cycle.period, cycle.magnitude) == (count, length, 10, 0.5)


def test_cycles_are_recorded():
    state = make_optimizer(OPTIM, 100).init(PARAMS)
    state = with_cycle(state, cycle_of(state)._replace(count=np.int32(6)))
    memory = Memory(best=1.0, cycle_best=1.0)
    _, _, record = adapt(OPTIM.restarts, state, [memory], [{"loss": 0.5}], 100)
    assert record == {"number": [0], "length": [16], "magnitude": [1.0], "extensions": [1]}
    changed, _, record = adapt(OPTIM.restarts, state, [memory], [{"loss": 1.5}], 100)
    assert record == {"number": [1], "length": [8], "magnitude": [0.5], "extensions": [0]}
    assert cycle_of(changed) == (6, 6, 8, 8, 0.5, 1)


# ---------------------------------------------------------------------------------------------------------------------
# The paper's cycles as shipped


def followed(config, steps, *, warmup=0, every=None, loss=None):
    """Return the cycles of a run as (number, start, length, magnitude), judged by loss(step) every so many steps."""
    cycle, memories, seen = jax.device_get(first_cycle(config, warmup, steps)), [Memory()], {}
    for step in sorted({*range(every or steps, steps + 1, every or steps), steps}):
        while (end := int(cycle.start + cycle.length)) < step:
            seen[int(cycle.number)] = cycle
            cycle = jax.device_get(current_cycle(config, cycle._replace(count=np.int32(end)), steps))
        cycle = cycle._replace(count=np.int32(step))
        if loss is not None:
            judged, memories, _ = adapt(config, cycle, memories, [{config.adaptive.metric: loss(step)}], steps)
            seen[int(cycle.number)] = cycle
            cycle = jax.device_get(judged)
    seen[int(cycle.number)] = cycle
    return [(number, int(c.start), int(c.length), float(c.magnitude)) for number, c in sorted(seen.items())]


def test_an_evaluation_without_the_score_is_no_improvement():
    """Regression: it ended the run, and lost the updates since the last checkpoint."""
    config = doubling_cycles(710, warmup_steps=10)
    cycle = jax.device_get(first_cycle(config, 10, 710))._replace(count=np.int32(60))
    (memory,) = adapt(config, cycle, [Memory()], [{"all/other": 0.5}], 710)[1]
    assert (memory.best, memory.cycle_best, memory.stale) == (None, None, 1)


def test_doubling_cycles_fill_a_run_unless_one_is_extended():
    config = doubling_cycles(710, warmup_steps=10)
    assert followed(config, 710, warmup=10) == [(0, 10, 100, 1), (1, 110, 200, 1), (2, 310, 400, 1)]
    assert len(followed(doubling_cycles(500, warmup_steps=0, cycles=5), 500)) == 5
    # An extension of the first leaves room for two.
    longer = followed(config, 710, warmup=10, every=20, loss=lambda step: 1.0 / step)
    assert [number for number, *_ in longer] == [0, 1]


def test_shipped_runs_with_the_rule_can_be_given_either_verdict():
    with_rule = {name: config for name, config in configurations().items() if config.optim.restarts}
    assert with_rule
    for name, config in with_rule.items():
        training, optim = config.training, config.optim
        run = {"warmup": optim.warmup_steps, "every": training.eval_every}
        planned = followed(optim.restarts, training.steps, warmup=optim.warmup_steps)
        falling = followed(optim.restarts, training.steps, **run, loss=lambda step: 1.0 / step)
        rising = followed(optim.restarts, training.steps, **run, loss=float)
        assert {magnitude for *_, magnitude in falling} == {1.0}, name
        assert any(length > planned[number][2] for number, _, length, _ in falling), name
        assert min(magnitude for *_, magnitude in rising) < 1.0, name

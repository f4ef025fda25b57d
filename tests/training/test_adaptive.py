"""The rule for cycles on evaluations, and whole runs that follow it."""

import dataclasses
import math
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from tests.training.stub_run import CONFIG, OPTIM, run, score
from tests.training.test_loop import arrays, timeless
from tflane_jax.errors import UserError
from tflane_jax.limits import check_settings
from tflane_jax.plots.curves import curves
from tflane_jax.training.adaptive import AdaptiveConfig, Memory, judge
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.restarts import RestartsConfig

RULE = AdaptiveConfig(metric="loss", threshold=0.1, fraction=0.5, max_extensions=1, grace=0.25, patience=2)


def verdicts(values, *, config=RULE, length=100, every=10, number=0, memory=None, left=1000):
    """Judge evaluations at every tenth of a cycle."""
    memory, found = memory or Memory(), []
    for i, value in enumerate(values, 1):
        memory, verdict = judge(
            config, memory, value, number=number, elapsed=i * every, length=length, left=left - i * every
        )
        found.append({"go on": ".", "extend": "E", "restart": "R"}[verdict])
    return "".join(found), memory


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        # The first two of ten lie in the grace period; the third is the first best value.
        ([1.0] * 10, "....RRRRR."),
        ([0.1, 0.1, 1.0, 0.95, 0.85, 0.84, 0.6, 0.5], "....E..."),  # 0.95 is no better by a tenth, 0.85 is
        ([9.0, 9.0, 1.0, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05, 0.04], "....E....."),  # late only; once only
        ([9.0, 9.0, 1.0, 0.5, 0.51, 0.4, 0.41, 0.42], ".....E.R"),
        ([9.0, 9.0, math.nan, math.inf, 1.0, 0.5], "...R.E"),  # nan, inf: no improvement
        ([1.0] * 3 + [0.95, 0.85] + [0.8] * 3, "....E.RR"),
    ],
)
def test_rule_within_the_first_cycle(values, expected):
    assert verdicts(values)[0] == expected


def test_a_metric_to_maximise():
    values = [1.0, 1.0, 1.0, 1.2, 1.5, 1.2, 1.1]
    config = dataclasses.replace(RULE, mode="max")
    assert verdicts(values, config=config)[0] == "....E.R"
    # Numbers below zero: the sign of the goal decides, not that of the number.
    assert verdicts([-v for v in values])[0] == "....E.R"
    assert verdicts([-1.0] * 10)[0] == "....RRRRR."  # nor is an equal number better


def test_a_new_cycle_is_measured_by_itself_but_extended_for_a_record_of_the_run():
    _, memory = verdicts([9.0, 9.0, 1.0])
    assert memory == Memory(best=1.0, cycle_best=1.0)
    # Worse than the run's best all the time, but improving: neither extended nor stuck.
    assert verdicts([9, 9, 5, 4, 3, 2, 1.5], number=1, memory=memory)[0] == "......."
    assert verdicts([9, 9, 5, 4, 3, 2, 0.5], number=1, memory=memory)[0] == "......E"
    # The extension of the cycle before does not count against this one.
    spent = dataclasses.replace(memory, extensions=1)
    assert verdicts([9, 9, 5, 4, 3, 2, 0.5], number=1, memory=spent)[0] == "......E"
    assert verdicts([9, 9, 0.9, 0.8, 0.7, 0.6, 0.5], number=0, memory=spent)[0] == "......."


def test_warm_up_and_the_end_of_a_cycle_are_left_alone():
    stuck, leading = Memory(best=1.0, cycle_best=1.0, stale=9), Memory(best=1.0, cycle_best=1.0)
    config = dataclasses.replace(RULE, grace=0.0)
    for elapsed in (-5, 0):
        assert judge(config, stuck, 2.0, number=0, elapsed=elapsed, length=10, left=99) == (stuck, "go on")
    assert judge(config, stuck, 2.0, number=0, elapsed=10, length=10, left=99)[1] == "go on"
    memory, verdict = judge(config, leading, 0.5, number=0, elapsed=10, length=10, left=99)
    assert (memory.best, verdict) == (0.5, "go on")


@pytest.mark.parametrize(("left", "extend", "verdict"), [(40, 0.5, "go on"), (41, 0.5, "extend"), (99, 0.0, "go on")])
def test_an_extension_that_would_change_nothing_is_none(left, extend, verdict):
    """Regression: the last cycle of a run was recorded as extended, and stayed as it was."""
    leading, config = Memory(best=1.0, cycle_best=1.0), dataclasses.replace(RULE, extend=extend)
    memory, found = judge(config, leading, 0.5, number=0, elapsed=60, length=100, left=left)
    assert (found, memory.extensions) == (verdict, int(verdict == "extend"))


@pytest.mark.parametrize(("left", "verdict"), [(59, "go on"), (60, "restart")])
def test_no_restart_near_the_end_of_the_run(left, verdict):
    stuck = Memory(best=1.0, cycle_best=1.0, stale=5)
    assert judge(RULE, stuck, 2.0, number=0, elapsed=60, length=100, left=left)[1] == verdict


@pytest.mark.parametrize(
    "change",
    [
        {"threshold": 1.0},
        {"threshold": -0.1},
        {"fraction": 1.5},
        {"extend": -1.0},
        {"extend": math.inf},
        {"max_extensions": -1},
        {"grace": math.nan},
        {"patience": 0},
        {"shrink": 0.0},
        {"shrink": 1.1},
    ],
)
def test_invalid_settings_are_named(change):
    check_settings(RULE, "adaptive.")
    with pytest.raises(UserError, match=rf"adaptive\.{next(iter(change))} is"):
        check_settings(dataclasses.replace(RULE, **change), "adaptive.")


# ---------------------------------------------------------------------------------------------------------------------
# Whole runs

ADAPTIVE = AdaptiveConfig(metric="loss", threshold=0.0, fraction=0.6, grace=0.0, patience=1, shrink=0.5)
CYCLES = RestartsConfig(cycle_steps=8, factor=1.5, floor=0.05, adaptive=ADAPTIVE)
FREQUENT = dataclasses.replace(CONFIG, eval_every=3, log_every=1, keep_checkpoints=40)
CYCLIC = dataclasses.replace(OPTIM, restarts=CYCLES)


def up_and_down(params):
    """Evaluate to a loss that goes up and down as parameters move, so that every verdict occurs."""
    return score(params) | {"loss": 1.0 + math.sin(40.0 * score(params)["score"])}


def run_cycles(folder: Path, **others):
    return run(folder, **({"config": FREQUENT, "optim": CYCLIC, "evaluate": up_and_down} | others))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run with cycles that was never stopped."""
    folder = tmp_path_factory.mktemp("cycles") / "run"
    assert run_cycles(folder).step == 30
    return folder


def test_a_run_follows_its_evaluations_and_records_it(whole, tmp_path):
    series = curves(timeless(whole))
    changes = {name: series["cycle", name] for name in ("number", "length", "magnitude", "extensions")}
    assert changes["number"][0].tolist() == list(range(3, 31, 3))
    assert changes["extensions"][1].max() == 1
    assert changes["magnitude"][1].min() < 1.0
    fixed = dataclasses.replace(CYCLIC, restarts=dataclasses.replace(CYCLES, adaptive=None))
    run_cycles(tmp_path / "fixed", optim=fixed)
    other = curves(timeless(tmp_path / "fixed"))
    assert not [split for split, _ in other if split == "cycle"]
    # The learning rate is the same up to the first change and differs right after it.
    changed = (changes["extensions"][1] > 0) | (changes["magnitude"][1] < 1.0)
    first = changes["number"][0][np.argmax(changed)]
    rates, untouched = (one["train", "learning_rate"][1][:, 0] for one in (series, other))
    np.testing.assert_array_equal(rates[:first], untouched[:first])
    assert (rates[first + 1 :] != untouched[first + 1 :]).any()


@pytest.mark.parametrize("stop", [6, 18])
def test_a_resumed_run_gives_the_same_bits(whole, tmp_path, stop):
    folder, evaluations = tmp_path / "run", iter(range(3, 31, 3))

    def evaluate_and_signal(params):
        if next(evaluations) == stop:
            os.kill(os.getpid(), signal.SIGTERM)
        return up_and_down(params)

    assert run_cycles(folder, evaluate=evaluate_and_signal).step == stop
    run_cycles(folder, start="resume")
    assert arrays(folder) == arrays(whole)
    assert timeless(folder) == timeless(whole)


def test_a_run_resumed_between_evaluations_judges_again(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    checkpoints = Checkpoints(folder / "checkpoints")
    for step in checkpoints.steps():
        if step > 14:
            shutil.rmtree(checkpoints.path(step))
    (memory,) = checkpoints.manifest(checkpoints.steps()[-1]).progress["cycles"]
    assert Memory(**memory) != Memory()
    run_cycles(folder, start="resume")
    assert arrays(folder) == arrays(whole)
    assert timeless(folder) == timeless(whole)


@pytest.mark.slow
def test_seeds_have_cycles_of_their_own(whole, tmp_path):
    config = dataclasses.replace(FREQUENT, seeds=(0, 5))
    run_cycles(tmp_path / "a", config=config)
    records = [r for r in timeless(tmp_path / "a") if r["split"] == "cycle"]
    assert any(r["length"][0] != r["length"][1] for r in records)
    checkpoints = Checkpoints(tmp_path / "a" / "checkpoints")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    for step in checkpoints.steps():
        if step > 14:
            shutil.rmtree(Checkpoints(tmp_path / "b" / "checkpoints").path(step))
    run_cycles(tmp_path / "b", config=config, start="resume")
    assert arrays(tmp_path / "a") == arrays(tmp_path / "b")
    assert len(checkpoints.manifest(30).progress["cycles"]) == 2


def test_a_missing_metric_is_named_and_ends_no_run(tmp_path, capsys):
    run_cycles(tmp_path / "run", evaluate=score)
    assert (
        "no loss (optim.restarts.adaptive.metric), so the rule takes it for no improvement" in capsys.readouterr().err
    )
    with pytest.raises(UserError, match="needs evaluations"):
        run_cycles(tmp_path / "other", evaluate=None)
    assert not (tmp_path / "other").exists()


def test_runs_without_the_rule_have_no_state_of_it(tmp_path):
    run(tmp_path / "run", config=dataclasses.replace(CONFIG, steps=10))
    assert "cycles" not in Checkpoints(tmp_path / "run" / "checkpoints").manifest(10).progress
    assert not any("magnitude" in name for name in arrays(tmp_path / "run", 10))

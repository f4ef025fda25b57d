"""`tflane summary --plan`: the arithmetic of the estimate, without compiling."""

from dataclasses import dataclass

import jax
import numpy as np
import pytest

from tests.training.stub import LineTask
from tflane_jax import plan as module
from tflane_jax.cli import main
from tflane_jax.commands import summary as command
from tflane_jax.errors import UserError
from tflane_jax.plan import ACCELERATORS, GIB, make_plan
from tflane_jax.summary import Program, any_steps
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig, make_optimizer


@dataclass(frozen=True)
class Task(LineTask):
    frames: int = 1
    precision: str = "float32"


EXAMPLE = {"x": jax.ShapeDtypeStruct((2**20,), np.float32), "y": jax.ShapeDtypeStruct((), np.float32)}
LEARNED = (2**20 * 4 + 64) * 4 / GIB  # kernel of 2^20 x 4, and a row for the bias


@pytest.fixture
def counted(monkeypatch):
    """Stand in for the counted program; return the batch sizes that were asked for."""
    asked = []

    def program(task, example, batch_size, optim, *, compiled):
        asked.append(batch_size)
        return Program("training step", batch_size, 1000.0 * batch_size, None, 512.0 if compiled else None)

    monkeypatch.setattr(module, "training_program", program)
    return asked


def estimate(task=None, accumulate=1, devices=4, *, shard_state=False, **settings):
    training = TrainingConfig(steps=3600, batch_size=16, accumulate=accumulate, shard_state=shard_state)
    options = {"devices": devices, "kind": "h100", "utilisation": 0.5} | settings
    optim = OptimConfig(lr_scaling="sqrt", reference_batch=8)
    return make_plan(task or Task(features=4), EXAMPLE, optim, training, **options)


def test_memory_and_time_of_a_step(counted):
    plan = estimate()
    assert counted == [4]
    batch = 4 * (2**20 + 1) * 4 / GIB
    # Parameters, average, two moments of Adam; and what the compiler plans.
    assert plan.memory == pytest.approx(4 * LEARNED + batch + 0.5, rel=1e-5)
    computing = 4e12 / (ACCELERATORS["h100"].float32 * 1e12 * 0.5)
    exchange = 2 * 3 / 4 * LEARNED * GIB / (ACCELERATORS["h100"].link * 1e9)
    assert plan.step_s == pytest.approx(computing + exchange)
    assert plan.rows[-1]["estimate"] == "time of 3,600 steps, hours"
    assert float(plan.rows[-1]["value"]) == pytest.approx(plan.step_s, rel=1e-2)
    assert any("reaches 50% of the peak" in sentence for sentence in plan.assumptions)


def test_parts_of_a_batch_take_memory_for_a_further_gradient_and_the_same_operations(counted):
    whole, parts = estimate(), estimate(accumulate=2)
    assert counted == [4, 2]
    assert parts.step_s == pytest.approx(whole.step_s)
    assert parts.memory == pytest.approx(whole.memory + LEARNED)


def test_a_shared_state_takes_a_part_of_the_memory_and_more_exchange(counted):
    whole, shared = estimate(), estimate(shard_state=True)
    # Parameters, average and two moments in quarters; parameters are gathered.
    assert shared.memory == pytest.approx(whole.memory - 4 * LEARNED + 4 * LEARNED / 4 + LEARNED, rel=1e-5)
    assert shared.step_s - whole.step_s == pytest.approx(3 / 4 * LEARNED * GIB / (ACCELERATORS["h100"].link * 1e9))
    assert estimate(shard_state=True, devices=1).memory == estimate(devices=1).memory


def test_a_long_warm_up_fits_the_counted_step():
    optim = OptimConfig(warmup_steps=5000)
    make_optimizer(optim, any_steps(optim))  # raises where it does not


def test_half_precision_and_one_device(counted):
    full, half = (estimate(Task(features=4, precision=p), devices=1) for p in ("float32", "bfloat16"))
    assert full.step_s / half.step_s == pytest.approx(ACCELERATORS["h100"].bfloat16 / ACCELERATORS["h100"].float32)


def test_without_compiling_memory_is_not_estimated(counted):
    plan = estimate(compiled=False)
    assert plan.memory is None
    assert [row["value"] for row in plan.rows].count("not compiled") == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"devices": 3}, "choose a multiple of 3"),
        ({"devices": 0}, "^--plan 0: at least 1 device$"),
        ({"utilisation": 1.5}, "^--utilisation 1.5: above 0 and at most 1$"),
    ],
)
def test_what_cannot_be_is_named(counted, change, message):
    with pytest.raises(UserError, match=message):
        estimate(**change)


def test_the_command_prints_an_estimate_with_its_assumptions(counted, monkeypatch, tmp_path, capsys):
    plan = estimate(compiled=False)
    monkeypatch.setattr(command, "make_plan", lambda *args, devices, kind, utilisation, compiled: plan)
    arguments = ["summary", "--config", "gtn_lane/lstr", "--plan", "2", "--kind", "a100", "--no-compile"]
    assert main([*arguments, "--out", str(tmp_path / "plan")]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("Estimate, not a measurement: gtn_lane/lstr on 2 x a100")
    assert "- computing reaches 50% of the peak (--utilisation); measured" in printed
    assert (tmp_path / "plan.json").exists()


def test_the_parser_offers_every_kind(capsys):
    with pytest.raises(SystemExit):
        main(["summary", "--kind", "abacus"])
    message = capsys.readouterr().err
    assert all(kind in message for kind in ACCELERATORS)

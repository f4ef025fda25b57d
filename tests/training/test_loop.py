"""The training program: bit-identical reruns and resumes, and clean errors."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared import ROOT
from tests.training.stub import LineDataset, LineTask, line_arrays
from tests.training.stub_run import CONFIG, OPTIM, RESOLVED, run, score
from tflane_jax.datasets.batches import batch_indices
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.loop import train
from tflane_jax.training.records import read_records


def arrays(folder: Path, step: int = 30) -> dict[str, bytes]:
    return {name: leaf.tobytes() for name, leaf in Checkpoints(folder / "checkpoints").arrays(step).items()}


def timeless(folder: Path) -> list[dict]:
    timed, records = ("seconds", "waiting"), read_records(folder / "metrics.jsonl")
    return [{k: v for k, v in record.items() if k not in timed} for record in records]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    result = run(folder)
    assert (result.step, result.stopped_by) == (30, None)
    assert result.metrics == score(Checkpoints(folder / "checkpoints").params(30))
    return folder


def test_a_rerun_gives_the_same_bits(whole, tmp_path):
    run(tmp_path / "run")
    assert arrays(tmp_path / "run") == arrays(whole)
    assert timeless(tmp_path / "run") == timeless(whole)


@dataclasses.dataclass(frozen=True)
class Telling(LineTask):
    notices: ClassVar = {"loss/fit": "It is above 0.", "loss/explosive": "It is not.", "lost/absent": "There is none."}


def test_what_a_model_leaves_out_is_told_once(tmp_path, capsys):
    run(tmp_path / "run", task=Telling())
    told = [line for line in capsys.readouterr().err.splitlines() if "It is" in line or "There is" in line]
    (line,) = told
    assert re.fullmatch(r"step 4: loss/fit is [\d.]+\. It is above 0\.", line)


def test_another_seed_gives_other_bits(whole, tmp_path):
    run(tmp_path / "run", config=dataclasses.replace(CONFIG, seeds=(1,)))
    assert arrays(tmp_path / "run") != arrays(whole)


def test_a_killed_run_resumes_to_the_same_bits(whole, tmp_path):
    folder = tmp_path / "run"
    for start, kill, last in (("new", "evaluation:20", 14), ("resume", "checkpoint:28", 21)):
        command = [sys.executable, "-m", "tests.training.stub_run", str(folder), start, kill]
        ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100)
        assert ended.returncode == -signal.SIGKILL, ended.stderr
        assert Checkpoints(folder / "checkpoints").steps()[-1] == last
    # What a killed process had begun to write.
    with open(folder / "metrics.jsonl", "a") as file:
        file.write('{"step": 28, "spl')
    result = run(folder, start="resume")
    assert result.step == 30
    assert arrays(folder) == arrays(whole)
    assert timeless(folder) == timeless(whole)
    assert len(json.loads((folder / "provenance.json").read_text())) == 3


@pytest.mark.parametrize("step", [10, 30])
def test_a_failing_evaluation_loses_no_update_and_a_resumed_run_begins_with_it(whole, tmp_path, step):
    """Such as for lack of memory: it may be resumed with a smaller evaluation.batch_size."""
    asked = []

    def failing(params):
        asked.append(params)
        if len(asked) == step // 10:
            raise MemoryError("the device is full")
        return score(params)

    with pytest.raises(MemoryError):
        run(tmp_path / "run", evaluate=failing)
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints", best_metric="score")
    assert checkpoints.steps()[-1] == step
    assert checkpoints.manifest(step).progress["due"]
    assert run(tmp_path / "run", start="resume").step == 30
    assert arrays(tmp_path / "run") == arrays(whole)
    assert timeless(tmp_path / "run") == timeless(whole)
    assert checkpoints.manifest(30).metrics == score(checkpoints.params(30))
    assert "due" not in checkpoints.manifest(30).progress


def test_an_evaluation_that_is_made_again_is_recorded_once(whole, tmp_path, monkeypatch):
    """Regression: a run that was killed between record and checkpoint had the record twice."""

    def failing(params):
        raise MemoryError("the device is full")

    def killed(self, state, manifest):
        if manifest.metrics:
            raise RuntimeError("killed")
        return save(self, state, manifest)

    with pytest.raises(MemoryError):
        run(tmp_path / "run", evaluate=failing)
    save = Checkpoints.save
    monkeypatch.setattr(Checkpoints, "save", killed)
    with pytest.raises(RuntimeError, match="killed"):
        run(tmp_path / "run", start="resume")
    monkeypatch.setattr(Checkpoints, "save", save)
    run(tmp_path / "run", start="resume")
    assert arrays(tmp_path / "run") == arrays(whole)
    assert timeless(tmp_path / "run") == timeless(whole)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_step_and_saves_it(whole, tmp_path, number):
    def evaluate_and_signal(params):
        os.kill(os.getpid(), number)
        return score(params)

    before = signal.getsignal(number)
    result = run(tmp_path / "run", evaluate=evaluate_and_signal)
    assert signal.getsignal(number) is before
    assert (result.step, result.stopped_by) == (10, number)
    run(tmp_path / "run", start="resume")
    assert arrays(tmp_path / "run") == arrays(whole)


def test_a_signal_in_the_last_step_is_told_of_a_complete_run(tmp_path):
    evaluated = []

    def signal_in_the_last_evaluation(params):
        evaluated.append(params)
        if len(evaluated) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return score(params)

    result = run(tmp_path / "run", evaluate=signal_in_the_last_evaluation)
    assert (result.step, result.stopped_by, result.asked_by) == (30, None, signal.SIGTERM)


def test_streamed_data_give_the_same_bits_and_resume_at_their_position(whole, tmp_path):
    """The checkpoint's step is the position in the data: a resumed run starts with the next batch."""

    def evaluate_and_stop(params):
        os.kill(os.getpid(), signal.SIGTERM)
        return score(params)

    folder, (before, after) = tmp_path / "run", (LineDataset(), LineDataset())
    assert run(folder, arrays=Streamed(before, StreamingConfig(threads=3)), evaluate=evaluate_and_stop).step == 10
    assert Checkpoints(folder / "checkpoints").manifest(10).step == 10
    resumed = run(folder, start="resume", arrays=Streamed(after, StreamingConfig(threads=0)))
    assert resumed.step == 30
    assert arrays(folder) == arrays(whole)
    assert timeless(folder) == timeless(whole)
    expected = np.concatenate([batch_indices(0, step, len(after), CONFIG.batch_size) for step in range(10, 30)])
    assert after.asked == [0, *expected]  # the first one is asked for its shapes


@pytest.mark.parametrize("step", [10, 22])  # with an evaluation and a checkpoint of its own, and without
def test_examples_that_cannot_be_read_lose_no_update(whole, tmp_path, step, capsys):
    class Failing(LineDataset):
        def example(self, index):
            if len(self.asked) > step * CONFIG.batch_size:  # one more was asked for its shapes
                raise UserError("image 7 cannot be read")
            return super().example(index)

    folder = tmp_path / "run"
    with pytest.raises(UserError, match="image 7"):
        run(folder, arrays=Streamed(Failing(), StreamingConfig(threads=0)))
    assert Checkpoints(folder / "checkpoints").steps()[-1] == step
    assert f"step {step} is saved: go on with --resume" in capsys.readouterr().err
    assert run(folder, start="resume", arrays=Streamed(LineDataset(), StreamingConfig(threads=0))).step == 30
    assert arrays(folder) == arrays(whole)
    assert timeless(folder) == timeless(whole)


def test_a_complete_run_resumes_to_itself(whole):
    before = arrays(whole)
    assert run(whole, start="resume").step == 30
    assert arrays(whole) == before


def test_records_are_means_over_the_steps_between(whole, tmp_path):
    run(tmp_path / "run", config=dataclasses.replace(CONFIG, log_every=1))
    single = [r["loss"] for r in timeless(tmp_path / "run") if r["split"] == "train"]
    records = timeless(whole)
    train_records = [r for r in records if r["split"] == "train"]
    assert [r["step"] for r in train_records] == [4, 8, 12, 16, 20, 24, 28, 30]
    means = [np.mean(single[i : min(i + 4, 30)]) for i in range(0, 30, 4)]
    np.testing.assert_allclose([r["loss"] for r in train_records], means, rtol=1e-12)
    assert [r["step"] for r in records if r["split"] == "val"] == [10, 20, 30]
    assert {"loss", "loss/fit", "loss/explosive", "grad_norm", "learning_rate"} < train_records[0].keys()


def test_the_folder_records_provenance(whole):
    assert json.loads((whole / "config.json").read_text()) == RESOLVED
    start, *_ = json.loads((whole / "provenance.json").read_text())
    assert start["packages"]["jax"].startswith("0.1")
    assert start["git"] is None or len(start["git"]["commit"]) == 40
    assert list((whole / "tensorboard").glob("events.*"))
    assert Checkpoints(whole / "checkpoints", best_metric="score").manifest(30).config == RESOLVED


def test_several_seeds_train_side_by_side(whole, tmp_path):
    result = run(tmp_path / "run", config=dataclasses.replace(CONFIG, seeds=(0, 5)))
    together = Checkpoints(tmp_path / "run" / "checkpoints").params(30)["line"]["kernel"]
    alone = Checkpoints(whole / "checkpoints").params(30)["line"]["kernel"]
    np.testing.assert_array_equal(together[0], alone)
    last = timeless(tmp_path / "run")[-1]
    assert result.metrics["score"] == pytest.approx(np.mean(last["score"]))
    assert len(last["score"]) == 2


def test_numbers_of_examples_that_are_not_finite_are_named(tmp_path):
    arrays = line_arrays()
    arrays["x"][:] = np.nan
    with pytest.raises(
        UserError, match=r"step 1, .*Numbers of its examples are not finite either: x; see whether valid"
    ):
        run(tmp_path / "run", arrays=arrays)


class SteepTask(LineTask):
    """Its loss is finite everywhere, and its gradient is not where an example is 0."""

    def loss(self, params, batch, key):
        loss, terms = super().loss(params, batch, key)
        first = batch["x"][:, 0] * params["line"]["kernel"][0, 0]
        return loss + jnp.sqrt(jnp.abs(first)).mean(), terms


@pytest.mark.parametrize("zero_in_step", [0, 1])
def test_advice_where_only_the_gradient_is_not_finite(tmp_path, zero_in_step):
    arrays = line_arrays()
    arrays["x"][batch_indices(0, zero_in_step, len(arrays["y"]), CONFIG.batch_size)[0], 0] = 0.0
    with pytest.raises(UserError, match=rf"step {zero_in_step + 1}, .*: grad_norm = \w+ is not finite") as error:
        run(tmp_path / "run", task=SteepTask(), arrays=arrays)
    first, later = "No update has been made", "clipping comes after it"
    assert [words in str(error.value) for words in (first, later)] == [not zero_in_step, bool(zero_in_step)]


def test_a_loss_that_is_not_finite_is_named_and_the_last_good_state_kept(whole, tmp_path):
    # The term becomes infinite at the step whose batch holds the largest value of the arrays.
    limit = float(line_arrays()["x"].max()) - 1e-3
    folder = tmp_path / "run"
    with pytest.raises(UserError, match=r"step \d+, seed 0: .*loss/explosive = inf.*is not finite") as error:
        run(folder, task=LineTask(blow_up=limit))
    kept = Checkpoints(folder / "checkpoints").steps()[-1]
    assert f"step {kept + 1}," in str(error.value)
    assert str(Checkpoints(folder / "checkpoints").path(kept)) in str(error.value)
    # The saved state equals that of a run without the infinite term.
    short = dataclasses.replace(CONFIG, checkpoint_every=1, eval_every=1000, keep_checkpoints=40)
    run(tmp_path / "other", config=short)
    assert arrays(folder, kept) == arrays(tmp_path / "other", kept)


def test_a_run_that_cannot_begin_leaves_no_run_behind(tmp_path):
    with pytest.raises(UserError, match=r"optim\.warmup_steps"):
        run(
            tmp_path / "run",
            config=dataclasses.replace(CONFIG, steps=1),
            optim=dataclasses.replace(OPTIM, warmup_steps=9),
        )
    assert not (tmp_path / "run" / "config.json").exists()


def test_drawing_sees_every_evaluation(tmp_path):
    seen = []
    run(tmp_path / "run", draw=lambda folder, step, params, records: seen.append((folder, step, len(records))))
    assert [step for _, step, _ in seen] == [10, 20, 30]
    assert seen[-1][2] == len(read_records(tmp_path / "run" / "metrics.jsonl"))


def test_a_picture_that_cannot_be_written_is_told_and_the_training_goes_on(tmp_path, capsys):
    def draw(folder, step, params, records):
        raise UserError(f"cannot write {folder}/curves.png: File too large")

    run(tmp_path / "run", draw=draw)
    assert Checkpoints(tmp_path / "run" / "checkpoints").steps()[-1] == 30
    told = [line for line in capsys.readouterr().err.splitlines() if "no pictures of step" in line]
    assert [line.partition(": ")[0] for line in told] == [f"no pictures of step {step}" for step in (10, 20, 30)]


def test_two_processes_never_share_a_folder(tmp_path):
    def second(params):
        with pytest.raises(UserError, match="another process is training"):
            run(tmp_path / "run", start="resume")
        return score(params)

    run(tmp_path / "run", evaluate=second, config=dataclasses.replace(CONFIG, steps=10))


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"steps": 0}, "steps"),
        ({"batch_size": 0}, "batch_size"),
        ({"accumulate": 0}, "accumulate"),
        ({"batch_size": 4, "accumulate": 3}, "accumulate"),
        ({"log_every": 0}, "log_every"),
        ({"seeds": ()}, "seeds"),
        ({"seeds": (1, 1)}, "seeds"),
    ],
)
def test_invalid_settings_are_named(tmp_path, change, name):
    with pytest.raises(UserError, match=rf"training\.{name} is"):
        run(tmp_path / "run", config=dataclasses.replace(CONFIG, **change))
    assert not (tmp_path / "run").exists()


def test_the_batch_scales_the_rate_and_passes_in_parts(tmp_path):
    config = dataclasses.replace(CONFIG, steps=4, batch_size=6, accumulate=3, log_every=1)
    optim = dataclasses.replace(OPTIM, lr_scaling="linear", reference_batch=3, warmup_steps=0)
    run(tmp_path / "run", config=config, optim=optim)
    first = next(record for record in read_records(tmp_path / "run" / "metrics.jsonl") if record["split"] == "train")
    assert first["learning_rate"] == pytest.approx(2 * OPTIM.lr)


def test_scores_may_be_of_numpy_or_jax(tmp_path):
    config = dataclasses.replace(CONFIG, steps=4)
    result = run(tmp_path / "run", config=config, evaluate=lambda _: {"score": np.float32(2), "other": jnp.ones(())})
    assert result.metrics == {"score": 2.0, "other": 1.0}


def test_training_needs_no_evaluation(tmp_path):
    config = dataclasses.replace(CONFIG, steps=3)
    how = {"config": config, "optim": dataclasses.replace(OPTIM, warmup_steps=0), "resolved": RESOLVED}
    result = train(LineTask(), line_arrays(), tmp_path / "run", progress=False, **how)
    assert (result.step, result.metrics) == (3, {})
    assert Checkpoints(tmp_path / "run" / "checkpoints").find("last") == 3

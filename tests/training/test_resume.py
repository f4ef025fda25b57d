"""Resuming runs of older versions, and checkpoints that a later save must not destroy."""

import copy
import dataclasses
import errno
import json
import shutil

import numpy as np
import pytest

from tests.training.stub import LineTask, line_arrays
from tests.training.stub_run import CONFIG, RESOLVED, run, score
from tflane_jax.datasets.batches import batch_indices
from tflane_jax.errors import UserError
from tflane_jax.training import loop
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.provenance import provenance, read_provenance, thread_setting
from tflane_jax.training.run_folder import claimed, read_config


def exploding_after(step: int) -> dict:
    """Return a task and arrays whose loss becomes infinite in the first update after a step."""
    arrays = line_arrays()
    earlier = {int(i) for s in range(step) for i in batch_indices(0, s, len(arrays["y"]), CONFIG.batch_size)}
    fresh = [int(i) for i in batch_indices(0, step, len(arrays["y"]), CONFIG.batch_size) if int(i) not in earlier]
    arrays["x"][fresh[0]] = 1e6
    return {"task": LineTask(blow_up=1e5), "arrays": arrays}


def test_a_loss_that_is_not_finite_after_an_evaluation_leaves_its_checkpoint(tmp_path):
    config = dataclasses.replace(CONFIG, eval_every=4, checkpoint_every=100)
    with pytest.raises(UserError, match=r"step 5, seed 0.*is not finite"):
        run(tmp_path / "run", config=config, **exploding_after(4))
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints", best_metric="score")
    assert checkpoints.steps() == [4]
    assert checkpoints.best_step() == 4
    assert checkpoints.manifest(4).metrics == score(checkpoints.params(4))


def older(folder, **without):
    """Rewrite a run's saved configuration as a version without some settings wrote it."""
    saved = json.loads((folder / "config.json").read_text())
    for part, name in without.items():
        del saved[part][name]
    (folder / "config.json").write_text(json.dumps(saved))


def completed(saved):
    """Add the setting that this version has and an older one had not."""
    new = copy.deepcopy(saved)
    new["training"].setdefault("best_metric", "score")
    return new, [] if "best_metric" in saved["training"] else ["setting training.best_metric is new: default score"]


def test_a_run_that_lacks_a_new_setting_resumes_with_its_default(tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    older(folder, training="best_metric")
    run(folder, start="resume", current_form=completed)
    assert "setting training.best_metric is new: default score\n" in capsys.readouterr().err
    assert json.loads((folder / "config.json").read_text()) == RESOLVED
    other = RESOLVED | {"training": RESOLVED["training"] | {"best_metric": "other"}}
    older(folder, training="best_metric")
    with pytest.raises(UserError, match=r"another configuration \(training\.best_metric: score there, other here\)"):
        run(folder, start="resume", current_form=completed, resolved=other)


def test_an_edited_configuration_is_not_resumed(tmp_path):
    """Only config.json was compared, with itself: a run went on with another schedule without a word."""
    folder, edited = tmp_path / "run", RESOLVED | {"training": RESOLVED["training"] | {"steps": 99}}
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    (folder / "config.json").write_text(json.dumps(edited))
    with pytest.raises(UserError, match=r"config.json was changed \(training.steps: .* since step 10: restore it from"):
        run(folder, start="resume", resolved=edited)
    (folder / "config.json").write_text(json.dumps(RESOLVED))
    assert run(folder, start="resume").step == 30


def test_a_checkpoint_without_a_configuration_is_damaged(tmp_path):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    path = max((folder / "checkpoints").glob("*/manifest.json"))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"config": {}}))

    def current(saved):
        if not saved:
            raise UserError("setting at the top should be a RunConfig, not {}")
        return saved, []

    with pytest.raises(UserError, match=r"step_00000010 is damaged: setting at the top .*; delete that folder"):
        run(folder, start="resume", current_form=current)


@pytest.mark.parametrize(
    "wrong",
    ['"step": -5, "split": "val"', '"step": 1, "split": "val", "a": 1' + "0" * 400],
)
def test_records_that_no_curve_can_show_are_named(tmp_path, wrong):
    """They ended in tracebacks when the curves were drawn, after the last step."""
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    path = folder / "metrics.jsonl"
    path.write_text("{" + wrong + "}\n" + path.read_text())
    with pytest.raises(UserError, match=r"metrics.jsonl, line 1 is no record: correct or delete that line"):
        run(folder, start="resume")


def test_records_of_other_numbers_of_seeds_are_named(tmp_path):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    path = folder / "metrics.jsonl"
    path.write_text('{"step": 0, "split": "train", "loss": [1, 2]}\n' + path.read_text())
    with pytest.raises(UserError, match=r"line 2 has another number of values of loss than a line before it: correct"):
        run(folder, start="resume")


def test_a_run_that_lost_its_configuration_says_where_a_copy_is(tmp_path):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    (folder / "config.json").unlink()
    with pytest.raises(UserError, match=r"holds no run \(it has no config.json\). A copy is the entry \"config\" of"):
        read_config(folder)


def test_no_damaged_checkpoint_is_advised(tmp_path):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10, checkpoint_every=5))
    checkpoints = Checkpoints(folder / "checkpoints")
    assert len(checkpoints.steps()) == 2
    for step in checkpoints.steps():
        (checkpoints.path(step) / "manifest.json").unlink()
    for step in checkpoints.steps():
        with pytest.raises(UserError, match="there is no other: start the run again"):
            checkpoints.manifest(step)


def test_a_resumed_run_may_have_other_workers(tmp_path):
    folder, workers = tmp_path / "run", {"threads": None, "ahead": None, "processes": 0}
    settings = RESOLVED | {"data": {"loading": {"where": "disk"} | workers}}
    run(folder, config=dataclasses.replace(CONFIG, steps=10), resolved=settings)
    more = RESOLVED | {"data": {"loading": {"where": "disk", "threads": 9, "ahead": 30, "processes": 2}}}
    run(folder, start="resume", resolved=more)
    assert json.loads((folder / "config.json").read_text()) == more
    with pytest.raises(UserError, match=r"data\.loading\.where"):
        run(folder, start="resume", resolved=RESOLVED | {"data": {"loading": {"where": "memory"} | workers}})


def test_a_resumed_run_may_evaluate_in_other_batches_and_draw_more(tmp_path):
    folder, settings = tmp_path / "run", {"batch_size": 16, "pictures": 4, "traffic": "own"}
    run(folder, config=dataclasses.replace(CONFIG, steps=10), resolved=RESOLVED | {"evaluation": settings})
    run(folder, start="resume", resolved=RESOLVED | {"evaluation": settings | {"batch_size": 2, "pictures": 0}})
    with pytest.raises(UserError, match=r"evaluation\.traffic: own there, none here"):
        run(folder, start="resume", resolved=RESOLVED | {"evaluation": settings | {"traffic": "none"}})


def test_a_run_is_not_resumed_on_another_number_of_examples(tmp_path):
    run(tmp_path / "run", config=dataclasses.replace(CONFIG, steps=10), arrays=line_arrays(20))
    with pytest.raises(UserError, match="was trained on 20 examples, and the training data have 10 now"):
        run(tmp_path / "run", start="resume", arrays=line_arrays(10))
    assert run(tmp_path / "run", start="resume", arrays=line_arrays(20)).step == 30


def test_a_run_is_not_resumed_on_files_that_changed(tmp_path):
    """As many scenes, but other ones: their number tells nothing."""
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10), content="scenes a, b")
    with pytest.raises(
        UserError, match=r"run was trained on other scenes or maps: .* have changed since: restore them"
    ):
        run(folder, start="resume", content="scenes a, c")
    assert run(folder, start="resume", content="scenes a, b").step == 30


def test_a_run_of_an_earlier_version_knows_no_files(tmp_path):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=10))
    path = max((folder / "checkpoints").glob("*/manifest.json"))
    manifest = json.loads(path.read_text())
    del manifest["progress"]["content"]
    path.write_text(json.dumps(manifest))
    assert run(folder, start="resume", content="scenes a, b").step == 30


def test_a_file_system_without_locks_is_told_and_trained_on(tmp_path, capsys, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with claimed(tmp_path / "run", "new"):
        assert (tmp_path / "run").is_dir()
    assert "this file system has no locks (No locks available)" in capsys.readouterr().err


def test_the_number_of_cores_is_recorded_and_a_change_is_reported(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=4))
    (start,) = read_provenance(folder)
    assert start["threads"] == thread_setting()
    assert start["threads"]["cores"] == len(start["pinned_to"]) >= 1
    run(folder, start="resume")
    assert "bit-identical" not in capsys.readouterr().err
    monkeypatch.setenv("OMP_NUM_THREADS", "77")
    run(folder, start="resume")
    told = capsys.readouterr().err
    assert "OMP_NUM_THREADS 77: the results are not bit-identical" in told
    assert read_provenance(folder)[-1]["threads"] == thread_setting() == start["threads"] | {"OMP_NUM_THREADS": "77"}


def test_other_code_and_packages_are_told_at_a_resume(tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, steps=4))
    (start,) = read_provenance(folder)
    start["git"] = {"commit": "0123456789abcdef", "uncommitted_changes": True}
    start["packages"] |= {"jax": "0.4.0", "gone": "1.0"}
    (folder / "provenance.json").write_text(json.dumps([start]))
    run(folder, start="resume")
    (told,) = [line for line in capsys.readouterr().err.splitlines() if "other code" in line]
    assert "jax 0.4.0 -> " in told
    assert "gone" not in told
    assert ("commit 012345678 with uncommitted changes -> " in told) == (provenance()["git"] is not None)
    run(folder, start="resume")
    assert "other code" not in capsys.readouterr().err
    run(folder, start="resume", own_code="feedbeef1234")
    assert "other code before (own modules none -> feedbeef1)" in capsys.readouterr().err


def test_a_checkpoint_is_identified_by_its_content(tmp_path):
    def content(name, **others):
        run(tmp_path / name, config=dataclasses.replace(CONFIG, steps=4), **others)
        return Checkpoints(tmp_path / name / "checkpoints").digest(4)

    first = content("one")
    assert first == Checkpoints(tmp_path / "one" / "checkpoints").digest(4)
    moved = {"x": line_arrays()["x"] + np.float32(1), "y": line_arrays()["y"]}
    assert content("other", arrays=moved) != first


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("checkpoints/step_00000021/manifest.json", r"step_00000021 is damaged \(manifest\.json"),
        ("metrics.jsonl", r"metrics\.jsonl is no file of records"),
    ],
)
def test_damage_that_would_end_the_run_later_is_named_before_the_first_step(tmp_path, file, said, monkeypatch):
    folder = tmp_path / "run"
    run(folder, config=dataclasses.replace(CONFIG, keep_checkpoints=3))  # those of 21, 28 and 30, and the best
    shutil.rmtree(folder / "checkpoints" / "step_00000030")
    (folder / file).write_bytes(b"\xff{")
    monkeypatch.setattr(loop, "compiled_update", None)
    with pytest.raises(UserError, match=said):
        run(folder, start="resume")


def without_best(params):
    return {"other": score(params)["score"]}


def test_an_evaluation_without_the_best_metric_is_told_once_and_leaves_no_best_checkpoint(tmp_path, capsys):
    for start, steps in (("new", 10), ("resume", 30)):
        config = dataclasses.replace(CONFIG, steps=steps)
        run(tmp_path / "run", start=start, config=config, evaluate=without_best)
    told = [line for line in capsys.readouterr().err.splitlines() if "training.best_metric" in line]
    assert [line.partition(" (")[0] for line in told] == ["step 10: the evaluation has no score"]
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints", best_metric="score")
    with pytest.raises(UserError, match=r"has the score score \(training\.best_metric\), .*ask for `last`"):
        checkpoints.find("best")


def test_a_score_that_some_seed_lacks_is_not_recorded(tmp_path):
    evaluations = iter([{"score": 1.0, "error": 2.0}, {"score": 3.0}])
    config = dataclasses.replace(CONFIG, steps=10, seeds=(0, 1))
    result = run(tmp_path / "run", config=config, evaluate=lambda params: next(evaluations))
    assert result.metrics == {"score": 2.0}

"""`tflane tables NAME --finished`: a table of the runs that are complete, when the time of a machine has ended."""

import json
import shutil

import pytest

from tests.ablations.test_tables import small, stopped_at_the_third
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.reuse import FILE, find_archives
from tflane_jax.ablations.table_plan import plan_table
from tflane_jax.ablations.table_run import run_table
from tflane_jax.cli import main
from tflane_jax.errors import UserError

pytestmark = pytest.mark.usefixtures("cheap")


def compute_on(monkeypatch, device):
    """Let this process believe that it computes on another device."""
    monkeypatch.setattr("tflane_jax.training.provenance._device", lambda *_: device)


def summary(out, name="paper.9"):
    return json.loads((out / name / "summary.json").read_text())


@pytest.fixture
def trained(tiny, tmp_path, monkeypatch):
    """The store of a table with three seeds, trained on a GPU."""
    compute_on(monkeypatch, "gpu: x")
    run_table(small(tiny), range(3), tmp_path)
    return tmp_path


@pytest.mark.slow
def test_all_runs_give_the_same_table_without_training(tiny, trained, monkeypatch, capsys):
    names = ("table.md", "effects.md", "summary.json", "comparison.json")
    before = {name: (trained / "paper.9" / name).read_bytes() for name in names}
    for name in names:
        (trained / "paper.9" / name).unlink()
    compute_on(monkeypatch, "cpu: x")
    capsys.readouterr()
    run_table(small(tiny), range(3), trained, finished=True)
    assert {name: (trained / "paper.9" / name).read_bytes() for name in names} == before
    assert "paper.9, a small table: 9 of 9 runs are finished\n" in capsys.readouterr().out
    assert summary(trained)["devices"] == ["gpu: x"]


@pytest.mark.slow
def test_runs_that_are_missing_are_named_and_the_others_count(tiny, trained, monkeypatch, capsys):
    """Row tfm has seeds 0 and 1 then, the others seed 0; seed 2 is of none, so that the table does not name it."""
    plan = plan_table(small(tiny), range(3), trained).jobs
    for job in (*(jobs[2] for jobs in plan.values()), plan["base"][1], plan["again"][1]):
        shutil.rmtree(job.folder)
    compute_on(monkeypatch, "cpu: x")
    capsys.readouterr()
    run_table(small(tiny), range(3), trained, finished=True)
    told = capsys.readouterr().out
    assert "4 of 6 runs are finished; not yet: base, seed 1; again, seed 1\n" in told
    assert "failed" not in told
    found = summary(trained)
    assert found["seeds"] == [0, 1]
    assert found["declared seeds"] == 8
    last = {row["model"]: row["seeds"] for row in found["rows"] if row["checkpoint"] == "last"}
    assert (last["tfm"], last["base"], last["again"]) == (2, 1, 1)


@pytest.mark.slow
def test_the_device_with_the_most_runs_is_taken(tiny, trained, monkeypatch):
    """Numbers of a CPU and of a GPU do not meet in a table."""
    compute_on(monkeypatch, "cpu: x")
    run_table(small(tiny), range(1), trained)
    run_table(small(tiny), range(3), trained, finished=True)
    assert summary(trained)["devices"] == ["gpu: x"]
    assert summary(trained)["seeds"] == [0, 1, 2]


@pytest.mark.parametrize(
    ("gpu", "cpu", "taken"),
    [
        (["base, seed 0", "again, seed 0"], ["tfm, seed 0"], "gpu: x"),
        (["base, seed 0", "base, seed 1", "again, seed 0"], ["base, seed 0", "tfm, seed 0"], None),
        (["base, seed 0", "tfm, seed 1", "again, seed 0"], ["base, seed 1", "tfm, seed 1"], None),
        (["base, seed 0", "tfm, seed 0", "again, seed 0"], ["base, seed 0", "tfm, seed 0"], "gpu: x"),
    ],
)
def test_pairs_that_test_a_claim_count_before_runs(tiny, tmp_path, monkeypatch, gpu, cpu, taken):
    """A table with more rows that no claim can compare says less."""
    complete = {"gpu: x": gpu, None: cpu}
    monkeypatch.setattr("tflane_jax.ablations.table_plan.worker_threads", lambda *_: {"cores": 1})
    monkeypatch.setattr("tflane_jax.ablations.table_plan.settings_in", lambda _: [{"cores": 1, "device": "gpu: x"}])
    monkeypatch.setattr(Job, "is_complete", lambda job: job.label in complete[job.threads.get("device")])
    jobs = plan_table(small(tiny), range(2), tmp_path, finished=True).jobs
    assert {job.threads.get("device") for of_row in jobs.values() for job in of_row} == {taken}
    for kind, device in (("cpu", None), ("gpu", "gpu: x")):
        jobs = plan_table(small(tiny), range(2), tmp_path, finished=True, device=kind).jobs
        assert {job.threads.get("device") for of_row in jobs.values() for job in of_row} == {device}
    with pytest.raises(UserError, match=r"no run of paper\.9 on a tpu is known"):
        plan_table(small(tiny), range(2), tmp_path, finished=True, device="tpu")


@pytest.mark.slow
def test_a_run_without_its_parameters_counts_but_is_not_drawn(tiny, trained, monkeypatch, capsys):
    """Scores are small and parameters large: from a far machine one may fetch the scores alone."""
    for job in plan_table(small(tiny), range(3), trained).jobs["base"]:
        shutil.rmtree(job.folder / "checkpoints" / "step_00000004" / "state")
    (trained / "paper.9" / "comparison.png").unlink()
    capsys.readouterr()
    run_table(small(tiny), range(3), trained, finished=True)
    assert "base is not drawn: the parameters in " in capsys.readouterr().out
    assert summary(trained)["seeds"] == [0, 1, 2]
    assert not (trained / "paper.9" / "comparison.png").exists()


def test_a_device_is_chosen_among_finished_runs_only(capsys):
    assert main(["tables", "gtn_lane.1", "--device", "gpu"]) == 2
    assert "--device is about runs that exist: add --finished" in capsys.readouterr().err


def test_no_run_is_an_error(tiny, tmp_path):
    with pytest.raises(UserError, match=r"no run of paper\.9 is finished in .*: leave out --finished to train them"):
        run_table(small(tiny), range(1), tmp_path, finished=True)
    assert list(tmp_path.glob("paper.9/*")) == []


@pytest.mark.parametrize("option", ["--jobs=2", "--cores=1", "--search"])
def test_options_that_train_are_refused(option, capsys):
    assert main(["tables", "gtn_lane.1", "--finished", option]) == 2
    assert "leave out --" in capsys.readouterr().err


def test_a_machine_that_goes_leaves_the_record_of_its_finished_runs(tiny, tmp_path, monkeypatch, capsys):
    """Of all that was written, one file of the table is left."""
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    begun = stopped_at_the_third(small(tiny), here, monkeypatch)
    (elsewhere / "paper.9").mkdir(parents=True)
    shutil.copy(here / "paper.9" / FILE, elsewhere / "paper.9")
    shutil.rmtree(here)
    archive = find_archives(elsewhere, ["paper.9"])["paper.9"]
    assert set(archive.runs) == {folder.name for folder in begun[:2]}
    planned = plan_table(small(tiny), range(2), tmp_path / "new", archive=archive).every()
    assert {job.folder.name for job in planned if job.is_complete()} == set(archive.runs)
    run_table(small(tiny), range(2), tmp_path / "new", archive=archive, finished=True)
    assert "2 of 3 runs are finished; not yet: again, seed 0\n" in capsys.readouterr().out

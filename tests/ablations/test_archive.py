"""Records of scores: a table from its record alone, or half from it."""

import json
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.ablations import test_tables
from tests.tiny_run import CONFIG, fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import workers
from tflane_jax.ablations.archive import read_archive, write_archive
from tflane_jax.ablations.declaration import Claim
from tflane_jax.ablations.paper.table import TableRow
from tflane_jax.ablations.published import record
from tflane_jax.ablations.reuse import FILE, InterimRecord, find_archives, unused
from tflane_jax.ablations.scores import is_measured
from tflane_jax.ablations.table_plan import plan_table
from tflane_jax.ablations.table_run import run_table
from tflane_jax.cli import main
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import SAMPLES
from tflane_jax.evaluation.results import Evaluation, SceneRatio, SceneSamples
from tflane_jax.tasks.lane_graph import LaneGraphTask

# Files of a table without provenance.
SAME = ("table.md", "table.json", "table.tex", "effects.md", "effects.json", "curves.png", "declaration.json")
OTHER_CODE = "f" * 64
RATES = {"again": 0.02, "faster": 0.03, "host": 0.1}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Return the file of a tiny configuration with ablations, which are read faster than settings of a row."""
    rates = "".join(
        f'    found["{name}"] = replace(get_config(), optim=OptimConfig(lr={rate}, warmup_steps=1))\n'
        for name, rate in RATES.items()
    )
    path = tmp_path_factory.mktemp("configs") / "tiny.py"
    path.write_text(f"{CONFIG.replace('return {', 'found = {')}{rates}    return found\n")
    return path


def small(tiny, **changes):
    rows = (TableRow("base", f"{tiny}:baseline"), TableRow("tfm", str(tiny)), TableRow("again", f"{tiny}:again"))
    return test_tables.small(tiny, **{"rows": rows, "secondary": "all/DET_l", **changes})


@pytest.fixture(scope="module", autouse=True)
def scored(cheap):
    """Score models by their parameters, with hits by scene, traffic, and the geometric topology."""

    def evaluate(task, params, data, config):
        size = float(sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(params)))
        size += len(config.traffic)
        hits = tuple(int(5 + 5 * np.sin(size * scene)) for scene in range(1, 7))
        found = {"DET_l": 1 / (1 + size), "recall": sum(hits) / 60, "TOP_ll": np.exp(-size) + len(config.topology)}
        drawn = tuple(np.random.default_rng(round(1e6 * found["DET_l"])).random(SAMPLES).round(5).tolist())
        ratios = {"all/recall": SceneRatio(hits, (10,) * 6)}
        samples = {name: SceneSamples((10,) * 6, drawn) for name in ("all/DET_l", "all/AP_l")}
        return Evaluation("a protocol", {"all": found}, ratios=ratios, samples=lambda: samples)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LaneGraphTask, "evaluate", evaluate)
        yield


@pytest.fixture(scope="module")
def made(tiny, scored, tmp_path_factory):
    """A table of two seeds that was trained and recorded: the folder of all tables, beside it `results`."""
    out = tmp_path_factory.mktemp("made") / "out"
    run_table(small(tiny), range(2), out)
    record([out / "paper.9" / "summary.json"], out.with_name("results"))
    return out


def recorded(results, table="paper.9"):
    return find_archives(results, [table])[table]


def summary(folder, name="paper.9"):
    """Return summary.json without provenance, and the commits in it."""
    content = json.loads((folder / name / "summary.json").read_text())
    commits = content.pop("commits")
    return content, commits


def forbid(monkeypatch, *functions):
    """Let the functions of `tflane_jax.ablations` fail."""

    def called(*_, **__):
        raise AssertionError("a recorded run is trained, measured or opened")

    for name in functions:
        monkeypatch.setattr(f"tflane_jax.ablations.{name}", called)


def trainings(monkeypatch):
    """Return the list to which the names of trained runs are added."""
    names, train_run = [], workers.train_run
    monkeypatch.setattr(workers, "train_run", lambda *a, **k: (names.append(a[1].name), train_run(*a, **k))[1])
    return names


def test_a_table_from_its_record_is_that_of_its_runs(tiny, made, tmp_path, monkeypatch, capsys):
    forbid(monkeypatch, "workers.train_run", "scores.open_run", "finished_runs.open_run")
    monkeypatch.setattr("tflane_jax.ablations.scores.code_digest", lambda: OTHER_CODE)
    monkeypatch.setattr("tflane_jax.ablations.table_plan.worker_threads", lambda *_: {"cores": 96})
    results = made.with_name("results")
    run_table(small(tiny), range(2), tmp_path, archive=recorded(results))
    told = capsys.readouterr().out
    assert "6 runs, 6 complete (6 of them recorded)\n" in told
    assert "not used" not in told
    for name in SAME:
        assert (tmp_path / "paper.9" / name).read_bytes() == (made / "paper.9" / name).read_bytes(), name
    effects = (tmp_path / "paper.9" / "effects.md").read_text()
    assert effects.count("95 % interval") == 1
    assert effects.count("points (95 %") == 4  # both claims, by a ratio and by a score that ranks detections
    for run in recorded(results).runs.values():
        kept = {name: set(found.samples.get("", ())) for name, found in run.measured.items() if found is not None}
        assert kept == {name: set() if "geometric" in name else {"all/DET_l"} for name in kept}
        ways = {name: len(found.ways) for name, found in run.measured.items() if found is not None}
        assert {number for name, number in ways.items() if "geometric" in name} == {1}  # not without traffic, too
        assert (ways["last"] == 3) == (run.row != "base")
    assert "all/TOP_ll, geometric" in (tmp_path / "paper.9" / "comparison.json").read_text()
    assert not (tmp_path / "paper.9" / "comparison.png").exists()
    (content, commits), (expected, own) = summary(tmp_path), summary(made)
    assert content == expected
    assert len(commits) == len(own) + 1
    assert commits[-1].startswith("measured by code of digest ")
    # What was taken from a record is recorded as it was, and recording it again changes nothing.
    scores = results / "scores" / "paper.9.json.gz"
    assert (tmp_path / "paper.9" / "scores.json.gz").read_bytes() == scores.read_bytes()
    before = scores.read_bytes()
    record([made / "paper.9" / "summary.json"], results)
    assert scores.read_bytes() == before


def test_the_record_of_a_table_in_training_keeps_the_runs_of_others(tiny, made, tmp_path):
    """Regression: it held the runs of the process that wrote last, or those of the last choice of seeds."""
    archive, path = recorded(made.with_name("results")), tmp_path / "paper.9" / FILE
    plan = plan_table(small(tiny), range(2), tmp_path, archive=archive).jobs
    jobs = {job.recorded.key: job for of_row in plan.values() for job in of_row}

    def process(keys):
        mine = {row: [job for job in of_row if job.recorded.key in keys] for row, of_row in plan.items()}
        return InterimRecord(path, "paper.9", archive.declaration, mine, ("all/recall",), ())

    first, *others = jobs
    one, other = process([first]), process(others)
    one.add(jobs[first])
    for key in others:
        other.add(jobs[key])
    one.add(jobs[first])
    assert read_archive(path).runs.keys() == jobs.keys()
    path.write_bytes(b"damaged")
    with pytest.raises(UserError, match=FILE):
        process([first])


def test_the_record_of_a_finished_table_keeps_the_runs_of_other_seeds(tiny, tmp_path):
    """Regression: it held those of the last choice of seeds."""
    for seed in (0, 1):
        run_table(small(tiny), [seed], tmp_path)
    found = read_archive(tmp_path / "paper.9" / FILE).runs.values()
    assert {run.seed for run in found} == {0, 1}


def test_a_table_of_fewer_seeds_does_not_replace_a_recorded_one(tiny, made, tmp_path, capsys):
    """Its runs enter the record; its tests would be of fewer runs than are recorded."""
    results = tmp_path / "results"
    shutil.copytree(made.with_name("results"), results)
    before = (results / "paper.9.json").read_bytes()
    path = run_table(small(tiny, seeds=3), [2], tmp_path / "other", archive=recorded(results))
    page = record([path.with_name("summary.json")], results)
    assert (results / "paper.9.json").read_bytes() == before
    assert {run.seed for run in recorded(results).runs.values()} == {0, 1, 2}
    assert "the runs of seeds 2 were added to the record; its table stays that of before" in capsys.readouterr().out
    assert "2 seeds" in page.read_text()


def test_a_table_half_from_its_record_is_that_of_all_runs(tiny, made, tmp_path, monkeypatch):
    whole = recorded(made.with_name("results"))
    first = replace(whole, runs={key: run for key, run in whole.runs.items() if run.seed == 0})
    write_archive(tmp_path / "results" / "scores" / "paper.9.json.gz", first)
    names = trainings(monkeypatch)
    path = run_table(small(tiny), range(2), tmp_path, archive=recorded(tmp_path / "results"))
    assert len(names) == 3
    for name in SAME:
        assert path.with_name(name).read_bytes() == (made / "paper.9" / name).read_bytes(), name
    assert path.with_name("comparison.png").exists()  # of the runs at hand
    record([path.with_name("summary.json")], tmp_path / "results")
    now = recorded(tmp_path / "results").runs
    assert {key: run.measured for key, run in now.items()} == {key: run.measured for key, run in whole.runs.items()}


@pytest.mark.parametrize("recorded_at", ["2000-01-01T00:00:00+00:00", "2999-01-01T00:00:00+00:00"])
def test_of_the_declarations_of_record_and_folder_the_earlier_holds(tiny, made, tmp_path, recorded_at):
    """Runs of one declaration may be trained in several folders, each of which declares it when it begins."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    own = json.loads((tmp_path / "paper.9" / "declaration.json").read_text())
    in_record = own | {"time": recorded_at, "begun": 7}
    archive = replace(recorded(made.with_name("results")), declaration=in_record)
    path = run_table(small(tiny), range(2), tmp_path, archive=archive)
    assert json.loads(path.with_name("declaration.json").read_text()) == min(own, in_record, key=lambda d: d["time"])
    told = "when 7 runs had begun already" in json.loads(path.with_name("summary.json").read_text())["declared"]
    assert told == recorded_at.startswith("2000")


def test_recorded_runs_of_another_configuration_are_trained(tiny, made, tmp_path, monkeypatch, capsys):
    *rows, _ = small(tiny).rows
    other = small(tiny, rows=(*rows, TableRow("again", f"{tiny}:faster")))
    names = trainings(monkeypatch)
    run_table(other, range(1), tmp_path, archive=recorded(made.with_name("results")))
    assert len(names) == 1
    told = capsys.readouterr().out
    assert "the recorded run of again, seed 0, is not used: optim.lr: 0.02 there, 0.03 here\n" in told
    assert told.count("not used") == 1
    # A claim that the record does not know is another declaration.
    other = small(tiny, claims=(Claim("again", "base"),))
    run_table(other, range(1), tmp_path / "claim", archive=recorded(made.with_name("results")))
    assert "the recorded declaration is another one" in capsys.readouterr().out
    assert "3 runs had begun already" in (tmp_path / "claim" / "paper.9" / "effects.md").read_text()
    # A score that was not measured then.
    archive = recorded(made.with_name("results"))
    every = [
        scores for run in archive.runs.values() for found in run.measured.values() for scores in found.ways.values()
    ]
    for scores in every:
        scores.pop("all/recall", None)  # two checkpoints may share their scores
    plan = plan_table(small(tiny), range(1), tmp_path, archive=archive)
    assert all(job.recorded is None for (job,) in plan.jobs.values())
    lines = unused(plan.jobs, archive, ["all/recall"])
    assert lines[1] == "the recorded run of tfm, seed 0, is not used: it has no all/recall"


def test_runs_of_a_cpu_and_of_a_gpu_do_not_meet(tiny, made, tmp_path, monkeypatch):
    archive = recorded(made.with_name("results"))
    monkeypatch.setattr("tflane_jax.ablations.table_plan.worker_threads", lambda *_: {"cores": 1, "device": "gpu: x"})
    every = plan_table(small(tiny), range(2), tmp_path, archive=archive).jobs
    assert all(job.recorded is not None for jobs in every.values() for job in jobs)
    more = plan_table(small(tiny), range(3), tmp_path, archive=archive).jobs
    assert all(job.recorded is None for jobs in more.values() for job in jobs)
    lines = unused(more, archive, ())
    assert len(lines) == 6
    assert lines[0].endswith("base, seed 0, is not used: runs of different devices do not meet in a table")


def test_runs_that_another_table_recorded_are_shared(tiny, made, tmp_path, monkeypatch, capsys):
    base, tfm, again = small(tiny).rows
    rows = (replace(base, name="baseline"), tfm, replace(again, config=f"{tiny}:faster"))
    other = small(tiny, name="paper.10", rows=rows, claims=(Claim("tfm", "baseline"),))
    names = trainings(monkeypatch)
    path = run_table(other, range(2), tmp_path, archive=recorded(made.with_name("results"), "paper.10"))
    assert len(names) == 2  # of the row that no table has
    assert "not used" not in capsys.readouterr().out
    scores, theirs = (read_archive(folder / "scores.json.gz") for folder in (path.parent, made / "paper.9"))
    mine = {(run.row, run.seed): run.measured for run in scores.runs.values()}
    assert {name for name, _ in mine} == {"baseline", "tfm", "again"}
    assert mine["baseline", 1] == next(r.measured for r in theirs.runs.values() if (r.row, r.seed) == ("base", 1))
    # A run at hand can be measured for this table, and is taken before.
    archive = recorded(made.with_name("results"), "paper.10")
    assert [job.recorded for job in plan_table(other, range(2), made, archive=archive).jobs["tfm"]] == [None, None]


@pytest.mark.slow
def test_a_recorded_row_needs_no_host(tiny, tmp_path, monkeypatch):
    rows = (TableRow("base", f"{tiny}:baseline", start="host"), TableRow("tfm", str(tiny)))
    hosts = (TableRow("host", f"{tiny}:host"),)
    table = small(tiny, rows=rows, hosts=hosts)
    run_table(table, range(1), tmp_path / "a")
    record([tmp_path / "a" / "paper.9" / "summary.json"], tmp_path / "results")
    archive = recorded(tmp_path / "results")
    assert not any(str(tmp_path) in json.dumps(run.config) for run in archive.runs.values())
    names = trainings(monkeypatch)
    run_table(table, range(1), tmp_path / "b", archive=archive)
    assert names == []
    assert summary(tmp_path / "a")[0] == summary(tmp_path / "b")[0]
    plan = plan_table(table, range(2), tmp_path / "b", archive=archive)
    assert [job.config.training.seeds for job in plan.host_jobs["host"]] == [(1,)]
    assert [job.recorded is None for jobs in plan.jobs.values() for job in jobs] == [False, True] * 2


@pytest.mark.parametrize("same", [True, False])
def test_rows_from_two_trainings_of_a_host_are_told(tiny, tmp_path, capsys, same):
    """On another kind of processor the same host becomes another one."""
    base, again = (
        TableRow(name, f"{tiny}:{of}", start="host") for name, of in (("base", "baseline"), ("again", "again"))
    )
    table = small(tiny, rows=(base,), claims=(Claim("base", "base"),), hosts=(TableRow("host", f"{tiny}:host"),))
    run_table(table, range(1), tmp_path / "a")
    archive = find_archives(tmp_path / "a", ["paper.9"])["paper.9"]
    if not same:
        ((key, run),) = archive.runs.items()
        archive = replace(archive, runs={key: replace(run, facts=replace(run.facts, origins=("of another machine",)))})
    capsys.readouterr()
    run_table(replace(table, rows=(base, again)), range(1), tmp_path / "b", archive=archive)
    assert "recorded runs of seed 0 start from an earlier training of host, the others from" in capsys.readouterr().out
    told = json.loads((tmp_path / "b" / "paper.9" / "summary.json").read_text())["mixed hosts"]
    mixed = "Rows of seed 0 do not all start from one known training of host: they may differ by their hosts."
    assert told == ([] if same else [mixed])
    record([tmp_path / "b" / "paper.9" / "summary.json"], tmp_path / "results")
    page = " ".join((tmp_path / "results.md").read_text().split())
    assert (mixed in page) is not same


def test_scores_by_an_earlier_state_of_the_code_may_stay(tiny, made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr("tflane_jax.ablations.scores.code_digest", lambda: OTHER_CODE)
    monkeypatch.setattr("tflane_jax.ablations.finished_runs.code_digest", lambda: OTHER_CODE)
    with monkeypatch.context() as patch:
        forbid(patch, "scores.open_run")
        run_table(small(tiny), range(2), tmp_path, scored_by="any code")
    assert summary(tmp_path)[1][-1].startswith("measured by code of digest ")
    assert summary(tmp_path)[0] == summary(made)[0]
    plan = plan_table(small(tiny), range(1), tmp_path)
    assert not any(is_measured(job) for (job,) in plan.jobs.values())
    assert all(is_measured(replace(job, scored_by="any code")) for (job,) in plan.jobs.values())


def test_the_command_takes_recorded_runs(tiny, made, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tflane_jax.commands.tables.find_table", lambda name: small(tiny, name=name))
    forbid(monkeypatch, "workers.train_run")
    arguments = ["tables", "paper.9", "--seeds", "2", "--out", str(tmp_path / "out"), "--from"]
    assert main([*arguments, str(made.with_name("results"))]) == 0
    assert "(6 of them recorded)" in capsys.readouterr().out
    for more, message in (
        (
            [str(tmp_path / "none")],
            "none is no folder: give that of results, such as docs/results, or of tables (--out)",
        ),
        ([str(made), "--quick"], "--quick runs are no results and never recorded"),
    ):
        assert main([*arguments, *more]) == 2
        assert message in capsys.readouterr().err
    assert recorded(made).runs == recorded(made.with_name("results")).runs  # of the tables' own folder
    recorded(made / "runs")
    assert "no run of paper.9 is recorded there" in capsys.readouterr().out
    shutil.copy(made.with_name("results") / "scores" / "paper.9.json.gz", tmp_path / "paper.10.json.gz")
    (tmp_path / "scores").mkdir()
    (tmp_path / "paper.10.json.gz").rename(tmp_path / "scores" / "paper.10.json.gz")
    with pytest.raises(UserError, match=r"paper\.10\.json\.gz is the record of paper\.9"):
        recorded(tmp_path, "paper.10")

"""Runs by identity: equal runs share a folder, wherever the store is."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from tflane_jax.ablations.facts import facts
from tflane_jax.ablations.jobs import Job, check_rows
from tflane_jax.ablations.store import remaining_seconds, run_key, runs_elsewhere, stored_jobs
from tflane_jax.config import RunConfig
from tflane_jax.config_io import to_json
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.training import provenance
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.run_folder import check_unchanged

THREADS = {"cores": 1}
CONFIG = RunConfig()


def changed(**settings):
    return replace(CONFIG, training=replace(CONFIG.training, **settings))


def test_rows_of_one_configuration_share_their_runs(tmp_path):
    plan = stored_jobs({"abla5": CONFIG, "abla7": CONFIG, "other": changed(steps=7)}, [3, 4], tmp_path, threads=THREADS)
    folders = {name: [job.folder for job in jobs] for name, jobs in plan.items()}
    assert folders["abla5"] == folders["abla7"]
    assert len({*folders["abla5"], *folders["other"]}) == 4
    assert [job.config.training.seeds for job in plan["abla5"]] == [(3,), (4,)]
    assert plan["abla7"][1].label == "abla7, seed 4"


def test_the_key_has_what_decides_the_numbers():
    base = run_key(CONFIG, THREADS)
    assert base == run_key(RunConfig(), {"cores": 1})
    others = [
        run_key(changed(steps=7), THREADS),
        run_key(changed(seeds=(1,)), THREADS),
        run_key(CONFIG, {"cores": 2}),
        run_key(CONFIG, THREADS, "abc"),
        run_key(CONFIG, THREADS, "abd"),
    ]
    assert len({base, *others}) == 6


def test_a_row_starts_from_the_run_of_its_own_seed_wherever_the_store_is():
    plans = []
    for store in (Path("here"), Path("there")):
        hosts = stored_jobs({"host": CONFIG}, [0, 1], store, threads=THREADS)
        row = changed(steps=5, init_from="somewhere/seed_{seed}")
        plans.append(stored_jobs({"row": row}, [0, 1], store, threads=THREADS, origins={"row": hosts["host"]}))
        starts = [job.config.training.init_from for job in plans[-1]["row"]]
        assert starts == [str(job.folder) for job in hosts["host"]]
    here, there = ([job.folder.name for job in plan["row"]] for plan in plans)
    assert here == there


def test_a_store_that_was_moved_holds_the_same_runs(tmp_path):
    def planned(store):
        hosts = stored_jobs({"host": CONFIG, "other": changed(steps=7)}, [0], store, threads=THREADS)
        row = changed(steps=5, init_from="somewhere")
        return stored_jobs({"row": row}, [0], store, threads=THREADS, origins={"row": hosts["host"]})["row"][0], hosts

    (there, _), (here, hosts) = planned(Path("elsewhere/runs")), planned(tmp_path)
    begun(replace(there, folder=here.folder), THREADS)
    assert here.difference() == ""
    assert check_unchanged(here.folder, to_json(here.config)) == []
    other = replace(here.config.training, init_from=str(hosts["other"][0].folder))
    moved = replace(here, config=replace(here.config, training=other))
    assert "training.init_from" in moved.difference()
    with pytest.raises(UserError, match=r"training\.init_from"):
        check_unchanged(here.folder, to_json(moved.config))


@pytest.mark.parametrize(
    ("recorded", "checkpoint", "expected"),
    [({}, None, (240.0, 2)), ({0: (12, 36.0)}, 10, (60.0 + 90.0, 0)), ({0: (12, 36.0)}, None, (90.0 + 90.0, 0))],
)
def test_remaining_time_is_measured_where_it_can_be(tmp_path, monkeypatch, recorded, checkpoint, expected):
    """A run goes on at its last checkpoint: what it recorded after that is trained again."""
    monkeypatch.setattr(Job, "is_complete", lambda self: False)
    monkeypatch.setattr(Job, "exists", lambda self: True)
    plan = stored_jobs({"row": changed(steps=30)}, [0, 1], tmp_path, threads=THREADS)
    for i, (step, seconds) in recorded.items():
        folder = plan["row"][i].folder
        folder.mkdir()
        (folder / "metrics.jsonl").write_text(json.dumps({"step": step, "split": "train", "seconds": seconds}) + "\n")
        if checkpoint is not None:
            Checkpoints(folder / "checkpoints").path(checkpoint).mkdir(parents=True)
    assert remaining_seconds(plan, {"row": 2.0}) == expected


def test_a_new_setting_with_its_default_finds_earlier_runs():
    @dataclass(frozen=True)
    class Part:
        size: int = 1

    @dataclass(frozen=True)
    class Config:
        training: TrainingConfig
        part: Part = Part()

    earlier = run_key(Config(TrainingConfig(steps=3), Part(2)), THREADS)

    @dataclass(frozen=True)
    class Part:
        size: int = 1
        new: tuple[int, ...] = (1, 2)

    @dataclass(frozen=True)
    class Config:
        training: TrainingConfig
        other: Part = field(default_factory=Part)
        part: Part = Part()

    assert run_key(Config(TrainingConfig(steps=3), part=Part(2)), THREADS) == earlier
    for changed in (Part(3), Part(), Part(2, (1,))):
        assert run_key(Config(TrainingConfig(steps=3), part=changed), THREADS) != earlier


def test_keys_are_those_of_earlier_versions():
    """Runs on disk are found by them."""
    assert run_key(CONFIG, THREADS) == "8cb75c728c1b62d8"
    assert run_key(CONFIG, THREADS, content="files") != run_key(CONFIG, THREADS)


def begun(job, threads, device="cpu: cpu x 1"):
    """Write what tells that a run began."""
    job.folder.mkdir(parents=True)
    (job.folder / "config.json").write_text(json.dumps(to_json(job.config)))
    (job.folder / "provenance.json").write_text(json.dumps([{"threads": threads, "device": device}]))


def test_runs_of_another_thread_setting_are_told_with_the_option_that_uses_them(tmp_path, monkeypatch):
    monkeypatch.setattr(Job, "is_complete", Job.exists)

    def planned(threads):
        return stored_jobs({"row": CONFIG}, [0, 1, 2], tmp_path, threads=threads)["row"]

    two = {"cores": 2, "OMP_NUM_THREADS": "3"}
    for threads, count in ((THREADS, 2), (two, 1)):
        for job in planned(threads)[:count]:
            begun(job, threads)
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "provenance.json").write_text('[{"threads": {}}]')
    told = sorted(runs_elsewhere(planned({"cores": 2}), tmp_path, planned))
    assert [line.partition(", but")[0] for line in told] == [
        "1 of these runs exist with cores 2, OMP_NUM_THREADS 3 (1 complete)",
        "2 of these runs exist with cores 1 (2 complete)",
    ]
    assert "environment" in told[0]
    assert told[1].endswith("add --cores 1 to use them")
    # Only what is missing here is told: one run of this setting is, and that one nobody has.
    assert runs_elsewhere(planned(THREADS), tmp_path, planned) == []


def test_a_run_of_an_accelerator_is_no_run_of_a_cpu(tmp_path, monkeypatch):
    gpu = "gpu: NVIDIA H100 x 1"
    (job,) = stored_jobs({"row": CONFIG}, [0], tmp_path, threads=THREADS)["row"]
    begun(job, THREADS)
    assert job.difference() == ""
    # Earlier versions gave it the same key, and recorded the device beside the threads.
    (job.folder / "provenance.json").write_text(json.dumps([{"threads": THREADS, "device": gpu}]))
    assert job.difference() == f"device: {gpu} there, None here"
    with pytest.raises(UserError, match=r"row: \S+ holds another run \(device: gpu: NVIDIA H100 x 1 there"):
        check_rows({"row": [job]})
    monkeypatch.setattr(provenance, "_device", lambda devices: gpu)
    setting = provenance.thread_setting(1)
    assert setting == {"cores": 1, "device": gpu} | {
        name: setting[name] for name in setting.keys() - {"cores", "device"}
    }
    (other,) = stored_jobs({"row": CONFIG}, [0], tmp_path, threads=setting)["row"]
    assert other.folder != job.folder
    assert Job(CONFIG, job.folder, {"cores": 1, "device": gpu}).difference() == ""


def test_a_run_of_changed_code_is_not_told_as_one_of_its_commit(tmp_path):
    job = Job(RunConfig(), tmp_path / "run", threads={"cores": 1})
    commits = [("a" * 40, False), ("b" * 40, True)]
    starts = [
        {"git": {"commit": commit, "uncommitted_changes": changed}, "device": "cpu: cpu x 1", "threads": {"cores": 1}}
        for commit, changed in commits
    ]
    write_json(job.folder / "provenance.json", [*starts, starts[0] | {"git": None}])
    assert facts(job).commits == ("aaaaaaaaa", "bbbbbbbbb with uncommitted changes")

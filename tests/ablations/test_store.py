"""Runs by identity: equal runs share a folder, wherever the store is."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.store import remaining_seconds, run_key, stored_jobs
from tflane_jax.config import RunConfig
from tflane_jax.training.loop import TrainingConfig

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


@pytest.mark.parametrize(("recorded", "expected"), [({}, (240.0, 2)), ({0: (10, 30.0)}, (60.0 + 90.0, 0))])
def test_remaining_time_is_measured_where_it_can_be(tmp_path, monkeypatch, recorded, expected):
    monkeypatch.setattr(Job, "is_complete", lambda self: False)
    monkeypatch.setattr(Job, "_exists", lambda self: True)
    plan = stored_jobs({"row": changed(steps=30)}, [0, 1], tmp_path, threads=THREADS)
    for i, (step, seconds) in recorded.items():
        folder = plan["row"][i].folder
        folder.mkdir()
        (folder / "metrics.jsonl").write_text(json.dumps({"step": step, "split": "train", "seconds": seconds}) + "\n")
    assert remaining_seconds(plan, 2.0) == expected


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

"""Whole tables in processes of their own: one that is killed and started again, and a shipped one by its command."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from tests.shared import ROOT
from tflane_jax.ablations.tables import TABLES
from tflane_jax.cli import main
from tflane_jax.training.run_folder import is_locked

pytestmark = pytest.mark.slow

STEPS = 120
CONFIG = f'''"""A tiny host with two learning rates."""

from dataclasses import replace

from tests.models.cases import BASELINE
from tflane_jax.config import EvaluationConfig, RunConfig, WorldData
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.simulate import WorldConfig


def get_config():
    return RunConfig(
        LaneGraphTask(BASELINE),
        WorldData(1, 1, 2, WorldConfig(keyframes=2)),
        OptimConfig(warmup_steps=0),
        TrainingConfig(steps={STEPS}, batch_size=1, log_every=10, eval_every={STEPS}, checkpoint_every=20),
        EvaluationConfig(pictures=0),
    )


def ablations():
    return {{"slow": replace(get_config(), optim=OptimConfig(lr=1e-5, warmup_steps=0))}}
'''
SCRIPT = """
import sys
from pathlib import Path

from tflane_jax.ablations.declaration import Claim
from tflane_jax.ablations.paper.table import PaperTable, Quoted, TableRow
from tflane_jax.ablations.table_run import run_table
from tflane_jax.training.runtime import configure_jax

if __name__ == "__main__":
    config, out = sys.argv[1:]
    table = PaperTable(
        name="paper.9",
        title="a tiny table",
        rows=(TableRow("slow", f"{config}:slow"), TableRow("fast", config)),
        claims=(Claim("fast", "slow"),),
        primary="all/recall",
        columns=("all/DET_l", "all/recall"),
        quoted=Quoted("no paper", ()),
        seeds=2,
    )
    configure_jax()
    run_table(table, range(2), Path(out), parallel=2)
"""


BEGUN, SAVED, COMPLETE = "runs/*/config.json", "runs/*/checkpoints/step_*", f"runs/*/checkpoints/step_{STEPS:08d}"


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Return a function that starts the tiny table, two trainings at a time, in a folder; its messages lie beside."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "tiny.py").write_text(CONFIG)
    (folder / "script.py").write_text(SCRIPT)
    settings = {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "TFLANE_CACHE": str(folder / "cache")}

    def started(out):
        command = [sys.executable, str(folder / "script.py"), str(folder / "tiny.py"), str(out)]
        with open(messages(out), "a") as file:
            return subprocess.Popen(command, env=os.environ | settings, stdout=file, stderr=file)

    return started


@pytest.fixture(scope="module")
def whole(start, tmp_path_factory):
    """Return the folder of the table that nothing stopped."""
    out = tmp_path_factory.mktemp("whole") / "tables"
    assert start(out).wait() == 0, messages(out).read_text()
    return out


def messages(out):
    return out.with_suffix(".txt")


@pytest.mark.parametrize("moment", [BEGUN, SAVED, COMPLETE], ids=["before a checkpoint", "after one", "after a run"])
def test_a_table_that_was_killed_ends_with_the_same_bytes(start, whole, tmp_path, moment):
    parts = tmp_path / "parts"
    killed = start(parts)
    while not list(parts.glob(moment)):
        assert killed.poll() is None, messages(parts).read_text()
        time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    begun = [path.parent for path in parts.glob(BEGUN)]
    while any(is_locked(run) for run in begun):  # until its workers have ended
        time.sleep(0.1)
    assert len(list(parts.glob(COMPLETE))) < 4

    again = start(parts)
    assert again.wait() == 0, messages(parts).read_text()
    for name in ("table.md", "table.json", "table.tex", "curves.png"):
        assert (parts / "paper.9" / name).read_bytes() == (whole / "paper.9" / name).read_bytes(), name
    # But for the time of the declaration, the tests are the same, too.
    effects = [(out / "paper.9" / "effects.md").read_text() for out in (whole, parts)]
    dates = [json.loads((out / "paper.9" / "declaration.json").read_text())["time"] for out in (whole, parts)]
    assert effects[0].replace(dates[0], "") == effects[1].replace(dates[1], "")


def test_a_shipped_table_runs_by_its_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    command = ["tables", "tf_lane.1", "--quick", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert "10 runs, 0 complete" in capsys.readouterr().out
    folder = tmp_path / "out" / "quick" / "tf_lane.1"
    text = (folder / "table.md").read_text()
    assert "SMOKE TEST" in text
    assert all(row.name in text for row in TABLES["tf_lane.1"].rows)
    for name in ("curves.png", "comparison.png"):
        assert (folder / name).stat().st_size > 10_000
    findings = json.loads((folder / "summary.json").read_text())["findings"]
    assert len(findings) == len(TABLES["tf_lane.1"].claims)
    assert all("hidden+traffic/recall" in each and "secondary measure all/mAP" in each for each in findings)
    assert main(command) == 0
    assert "10 runs, 10 complete" in capsys.readouterr().out
    assert (folder / "table.md").read_text() == text

"""The arithmetic of the benchmarks; no test asserts a time."""

import importlib
import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks import (
    collectives,
    loading,
    lstr_layers,
    masking_variants,
    metrics,
    paper_sizes,
)
from benchmarks.gpu import matching, side_by_side, steps
from benchmarks.timing import command_line, compile_jax, interleave, load_notice, markdown_table, summarise
from tests.shared import ROOT
from tflane_jax.ablations.paper.tf_lane import MASKING
from tflane_jax.config import WorldData, load_config
from tflane_jax.config_io import to_text
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.models.parameters import split_statistics
from tflane_jax.run_checks import check_run
from tflane_jax.runs import check_origin
from tflane_jax.training.schedule import make_optimizer


@pytest.mark.parametrize(
    "name", ["metrics", "marker_occlusion", "paper_sizes", "marker_scenes", "gpu.matching", "gpu.side_by_side"]
)
def test_options_of_the_benchmarks_have_one_name_and_one_default(name, monkeypatch):
    """Regression: --out was required in some, --rounds of one was --repeats of another."""
    module, seen = importlib.import_module(f"benchmarks.{name}"), []
    monkeypatch.setattr(module, "run", lambda *arguments, **others: seen.append(arguments))
    monkeypatch.setattr(sys, "argv", [name, *(["--tiny"] if name == "marker_scenes" else [])])
    module.main()
    monkeypatch.setattr(sys, "argv", [name, *sys.argv[1:], "--out", "elsewhere"])
    module.main()
    assert [arguments[0] for arguments in seen] == [Path("runs/bench"), Path("elsewhere")]


def test_every_benchmark_takes_its_common_options_from_one_place():
    shared = ('"--out"', '"--seconds"', '"--rounds"', '"--repeats"', '"--scenes"')
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        if path.name != "timing.py":
            text = path.read_text(encoding="utf-8")
            assert not [f"{path.name}: {option}" for option in shared if f"add_argument({option}" in text]
            assert "ArgumentParser(" not in text, path.name
    options = command_line("text", seconds=2.0, rounds=3).parse_args(["--rounds", "4"])
    assert vars(options) == {"out": Path("runs/bench"), "seconds": 2.0, "rounds": 4}
    assert vars(command_line(None, out=None, scenes=1).parse_args([])) == {"scenes": 1}


def test_ratio_is_taken_round_by_round():
    times = {"a": np.array([1.0, 10.0, 1.0]), "b": np.array([2.0, 20.0, 4.0])}
    rows = summarise(times, "a")
    assert rows["a"]["ratio"] == 1.0
    assert rows["b"]["ratio"] == 2.0
    assert rows["b"]["rounds"] == 3


def test_every_program_runs_in_every_round():
    calls = {"a": 0, "b": 0}

    def program(name):
        calls[name] += 1

    times = interleave({name: lambda name=name: program(name) for name in calls}, seconds=0.0, least_rounds=4)
    assert {len(values) for values in times.values()} == {4}
    assert min(calls.values()) >= 4


def test_speed_and_accuracy_of_masks_stand_in_one_table(tmp_path):
    variants = list(masking_variants.variants())
    timings = {"48": {name: {"median_ms": 2.0, "ratio": 1.5} for name in variants}}
    assert masking_variants.trained_scores(tmp_path / "none.json") == {}
    plain = masking_variants.speed_and_scores(timings, {}).splitlines()
    assert (plain[0].split(), len(plain)) == (["|", "masks", "|", "48", "queries", "|"], 2 + len(variants))
    rows = [
        {"model": row.name, "checkpoint": which, **dict.fromkeys(MASKING.columns, f"{i}{which}")}
        for i, row in enumerate(MASKING.rows)
        for which in ("last", "best")
    ]
    (tmp_path / "recorded.json").write_text(json.dumps({"rows": rows}))
    scores = masking_variants.trained_scores(tmp_path / "recorded.json")
    # The first row of the table has no traffic flow, and so no masks.
    assert {name: values["all/DET_l"] for name, values in scores.items()} == {
        name: f"{i}last" for i, name in enumerate(variants, 1)
    }
    table = masking_variants.speed_and_scores(timings, scores).splitlines()
    assert [cell.strip() for cell in table[2].split("|")[1:-1]] == [variants[0], "2.00 ms", "1last", "1last"]
    assert [cell.strip() for cell in table[3].split("|")[1:-1]] == [variants[1], "1.50", "2last", "2last"]
    if importlib.util.find_spec("matplotlib"):
        spread = {name: dict.fromkeys(masking_variants.SCORES, "45.3 ± 0.2") for name in variants[1:]}
        for shown in ({}, spread):
            path = masking_variants.save_picture(tmp_path / "masks.png", timings, shown)
            assert path.stat().st_size > 2000
    del scores[variants[1]]
    assert masking_variants.speed_and_scores(timings, scores).splitlines()[3].count(" - ") == 2


def test_compiled_program_sees_its_arguments():
    entry = compile_jax(lambda x, y: x @ y, np.eye(3, dtype=np.float32), np.full((3, 3), 2.0, np.float32))
    np.testing.assert_array_equal(entry.program(), np.full((3, 3), 2.0))
    assert entry.seconds > 0


@pytest.mark.parametrize(("stride", "k"), [(2, 3), (1, 4)])
def test_every_way_to_compute_a_convolution_gives_the_same_numbers(stride, k):
    """The benchmark compares them before it times them."""
    ways = lstr_layers.programs(lstr_layers.Layer("small", 6, 5, 3, 4, stride, k), 2)
    assert set(ways) == set(lstr_layers.PARTS)
    assert {lstr_layers.XLA, lstr_layers.FIRST} <= set(ways["forward"])
    assert (lstr_layers.IM2COL in ways["kernel gradient"]) == (k == 3)


def test_frames_of_the_metrics_hold_hits_and_misses(tmp_path):
    record = metrics.run(tmp_path, frames=1, rounds=1)
    assert len(record["results"]) == len(metrics.comparisons())
    assert (tmp_path / "metrics.md").read_text().count("\n| ") == len(record["results"])
    for comparison in metrics.comparisons():
        rng = np.random.default_rng(0)
        for make in comparison.metrics:
            accumulator = make()
            accumulator.update(*comparison.frame(rng, comparison.detections))
            result = accumulator.compute()
            score = next(result[name] for name in ("DET_l", "F_score", "AP_ls", "mAP", "Accuracy") if name in result)
            assert 0.2 < score < 1.0, comparison.name


@pytest.mark.slow
def test_matching_on_the_device_is_compared_with_the_callback(tmp_path):
    record = matching.run(tmp_path, tiny=True, seconds=0.0)
    assert record["problems"]["tiny"]["same"]
    assert "| tiny" in (tmp_path / "gpu_matching.md").read_text()


@pytest.mark.slow
def test_trainings_that_share_a_device_count_together(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", str(tmp_path))
    name = side_by_side.CONFIGS[0]
    record = side_by_side.run(tmp_path, [name], (1, 2), updates=2, fed=True)
    assert record["updates_per_s"][name].keys() == {"1", "2"}
    assert min(record["updates_per_s"][name].values()) > 0
    assert record["shared_by"] == "time slices"
    assert json.loads((tmp_path / "gpu_side_by_side_fed.json").read_text())["updates_per_s"] == record["updates_per_s"]


@pytest.mark.slow
@pytest.mark.parametrize("model", steps.CONFIGS)
def test_updates_on_an_accelerator_start(model, tmp_path):
    record = steps.run(tmp_path, [model], tiny=True)
    found = record["models"][model]
    assert found["finite"]
    assert found["gflop"] > 0
    assert found["update_s"] > 0


@pytest.mark.parametrize("model", steps.CONFIGS)
def test_every_part_of_a_paper_size_model_is_in_half_precision(model):
    text = to_text(steps.configuration(model, "bfloat16", remat=True, tiny=False))
    chosen = [line.rpartition(" = ")[2] for line in text.splitlines() if ".precision" in line]
    assert len(chosen) >= 3
    assert set(chosen) == {"'bfloat16'"}


def test_collectives_are_read_from_a_compiled_program():
    program = """
  %all-reduce.1 = (f32[3,4]{1,0}, /*index=1*/bf16[8]{0}) all-reduce(%a, %b), channel_id=1, to_apply=%add
  %fusion = f32[12]{0} fusion(%all-reduce.1), kind=kLoop, calls=%c
  ROOT %all-gather.2 = pred[16]{0} all-gather(%p), channel_id=2, dimensions={0}
  %reduce-scatter = f32[] reduce-scatter(%q), channel_id=3
  %all-reduce.7 = s32[1]{0} all-reduce(%r), channel_id=4"""
    found = {kind: each for kind, each in collectives.exchanges(program, 8).items() if each[0]}
    assert found == {"all-reduce": (2, 48 + 16 + 4), "all-gather": (1, 16), "reduce-scatter": (1, 8 * 4)}


def test_the_scaling_is_that_of_a_ring(monkeypatch):
    plan = SimpleNamespace(step_s=0.1, learned=10**9 / collectives.GIB, assumptions=("a", "b", "c", "d"))
    monkeypatch.setattr(collectives, "make_plan", lambda *args, **form: plan)
    rows, assumptions = collectives.estimate("gtn_lane/lstr", 1, (8, 16), kind="h100", utilisation=0.4)
    found = {(row["link"][:8], row["devices"], row["state"]): row for row in rows}
    assert len(found) == 8
    slow, shared = found["Ethernet", 16, "whole"], found["Ethernet", 16, "shared"]
    assert slow["exchange_s"] == pytest.approx(2 * 15 / 16 / 12.5)
    assert shared["exchange_s"] == pytest.approx(1.5 * slow["exchange_s"])
    assert slow["efficiency"] == pytest.approx(0.1 / (0.1 + 0.15))
    assert "250.0 million" in assumptions[0]
    assert collectives.estimate_table(rows).count("\n") == 9


@pytest.mark.slow
def test_an_update_is_planned_for_devices_that_a_cpu_plays(tmp_path):
    command = [sys.executable, "-m", "benchmarks.collectives", "--out", str(tmp_path), "--devices", "2"]
    command += ["--config", "gtn_lane/overfit", "--paper", "gtn_lane/overfit"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    whole, shared = json.loads((tmp_path / "collectives.json").read_text())["rows"]
    config = load_config("gtn_lane/overfit")
    params = jax.eval_shape(config.task.init, jax.random.key(0), config.task.shapes(config.data))
    learned, _ = split_statistics(params)
    # The row counts what fills up the vectors of the state as well.
    gradient = 4 * sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(learned))
    assert whole["parameters"] >= gradient
    assert whole["exchanges"]["all-reduce"][1] >= gradient
    assert whole["exchanges"]["all-gather"][0] == 0
    assert shared["exchanges"]["all-gather"][1] >= shared["parameters"]
    assert shared["arguments"] < 0.6 * whole["arguments"]
    assert "Estimate, not a measurement" in (tmp_path / "collectives.md").read_text()


def test_a_busy_machine_is_named():
    assert load_notice({"load": [1.9, 0.1, 0.1], "cores": 2}) == load_notice({}) == ""
    busy = {"load": [6.94, 0.1, 0.1], "cores": 2}
    for record in (busy, {"machine": busy, "results": []}):
        assert "load 6.9 on 2 cores" in load_notice(record)


def test_table_is_aligned():
    lines = markdown_table(["name", "ms"], [["a", "1.0"], ["longer", "12.0"]]).splitlines()
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("name", paper_sizes.CONFIGS)
def test_a_paper_size_is_trained_briefly_on_data_that_are_there(name, tmp_path):
    config = paper_sizes.measurable(name)
    short = apply_overrides(config, paper_sizes.settings(config, tmp_path))
    assert (short.training.steps, short.training.batch_size) == (paper_sizes.UPDATES, 1)
    make_optimizer(short.optim, short.training.steps)  # raises where the schedule does not fit
    check_origin(short)  # raises where layers would be frozen at random
    unfrozen = apply_overrides(config, ["--task.model.encoder.images.frozen_stages", "0"])
    assert short.task == unfrozen.task
    if isinstance(short.data, WorldData):  # the others' folders are not there
        check_run(short)


def test_loading_is_compared_with_the_update_for_each_example(monkeypatch):
    """Batches of 4: loading takes 2 s for two of them, the update 3 s for one."""
    task = SimpleNamespace(prepare=lambda data: None)
    case = loading.Case(SimpleNamespace(task=task, data=None), batch=4, batches=2)
    monkeypatch.setattr(loading, "forms", lambda case: {("memory", 0): np.arange(8.0)})
    monkeypatch.setattr(loading, "updates", lambda case, batch: (None, 5.0))
    monkeypatch.setattr(loading, "interleave", lambda *_: {"memory 0": np.full(3, 2.0), "update": np.full(3, 3.0)})
    (memory, update), found = (result := loading.measured(case, 0.0))["rows"], result["compile_s"]
    assert memory == {"examples": "memory", "workers": "0", "examples_per_s": 4.0, "ratio": 3.0}
    assert (update["examples_per_s"], update["ratio"], found) == (pytest.approx(4 / 3), 1.0, 5.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(loading.CASES))
def test_rates_of_loading_are_those_of_equal_batches(name, tmp_path, monkeypatch):
    rows = loading.run(tmp_path, [name], seconds=0.0, with_updates=False, tiny=True)["results"][name]["rows"]
    found = [(row["examples"], row["workers"]) for row in rows]
    in_memory = loading.WORKERS[:1] if name == "cameras" else loading.WORKERS  # nothing to augment
    assert found == [("memory", str(n)) for n in in_memory] + [("disk", str(n)) for n in loading.WORKERS]
    assert all(row["examples_per_s"] > 0 for row in rows)
    assert f"| {name}, disk" in (tmp_path / "loading.md").read_text()
    other_order = lambda arrays, config: jax.tree.map(lambda leaf: leaf[::-1], arrays)  # noqa: E731
    monkeypatch.setattr(loading, "in_workers", other_order)
    with pytest.raises(AssertionError, match="not equal"):
        loading.run(tmp_path, [name], seconds=0.0, with_updates=False, tiny=True)

"""The command line: train, resume, evaluate and predict on fake examples, and error messages."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from tests.fakes import POINTS
from tests.shared import ROOT
from tests.tiny_run import CONFIG, FEW_PICTURES, fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.cli import build_parser, main
from tflane_jax.evaluation.lane_groups import LANE_GROUPS
from tflane_jax.training.records import read_records


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("configs") / "tiny.py"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory, config):
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(["train", "--config", str(config), "--out", str(folder), "--training.seeds", "3"]) == 0
    return folder


def test_help_imports_nothing_slow():
    code = "import sys; from tflane_jax.cli import build_parser; build_parser().format_help(); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert not {"jax", "numpy", "flax", "tyro", "matplotlib", "tqdm"} & set(loaded.split())


def test_the_package_runs_as_the_program_does():
    started = {"cwd": ROOT, "capture_output": True, "text": True, "check": False}
    module = subprocess.run([sys.executable, "-m", "tflane_jax", "train", "--config", "nothing_like_it"], **started)
    assert module.returncode == 2
    assert module.stderr.startswith("tflane: ")
    assert "nothing_like_it" in module.stderr


def test_a_run_folder_holds_everything(trained):
    names = {path.name for path in trained.iterdir()}
    assert names == {
        "config.json",
        "config.txt",
        "provenance.json",
        "metrics.jsonl",
        "tensorboard",
        "checkpoints",
        "curves.png",
        "pictures",
        "run.lock",
    }
    assert sorted(p.name for p in (trained / "pictures").iterdir()) == ["step_00000002.png", "step_00000004.png"]
    assert "training.seeds = [3]\n" in (trained / "config.txt").read_text()
    validation = [r for r in read_records(trained / "metrics.jsonl") if r["split"] == "val"]
    assert [r["step"] for r in validation] == [2, 4]
    assert {"all/DET_l", "all/TOP_ll", "occluded/DET_l", "clear/DET_l"} < validation[0].keys()


def test_training_into_an_existing_run_needs_an_option(trained, config, capsys):
    before = sorted((trained / "checkpoints").rglob("*"))
    assert main(["train", "--config", str(config), "--out", str(trained)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"tflane: {trained} already holds a run")
    assert said.count("\n") == 1
    assert sorted((trained / "checkpoints").rglob("*")) == before


def test_resume_needs_only_the_folder(trained, capsys):
    assert main(["train", "--resume", "--out", str(trained)]) == 0
    assert "4 steps" in capsys.readouterr().out
    assert main(["train", "--resume", "--out", str(trained), "--optim.lr", "1"]) == 2
    assert "its own configuration" in capsys.readouterr().err


def test_evaluation_prints_and_writes_the_table(trained, capsys):
    assert main(["eval", str(trained), "--split", "val", "--checkpoint", "last"]) == 0
    said = capsys.readouterr().out
    assert "OpenLane-V2 centerline v2.1" in said
    assert "was chosen as the best" not in said
    written = json.loads((trained / "evaluations" / "procedural-val-step4.json").read_text())
    assert (written["meta"]["step"], written["meta"]["max_instances"]) == (4, None)
    assert "v2.1" in written["meta"]["protocol"]
    rows = {row["lanes of"]: row for row in written["rows"]}
    lanes = {group: row["lanes"] for group, row in rows.items()}
    assert [lanes[group] for group in ("all", "occluded", "clear")] == [10, 5, 5]
    assert {*lanes} - {"all", "occluded", "clear"} == {*LANE_GROUPS}
    recorded = [r for r in read_records(trained / "metrics.jsonl") if r["split"] == "val"][-1]
    assert rows["all"]["DET_l"] == recorded["all/DET_l"]
    assert (trained / "evaluations" / "procedural-val-step4.md").read_text().strip() in said


def test_traffic_flow_can_be_limited(trained, tmp_path, capsys):
    assert main(["eval", str(trained), "--max-instances", "0", "--out", str(tmp_path / "none")]) == 0
    assert json.loads((tmp_path / "none.json").read_text())["meta"]["max_instances"] == 0
    assert main(["eval", str(trained), "--max-instances", "5"]) == 2
    assert "outside 0 to 4" in capsys.readouterr().err


def test_evaluation_with_other_traffic(trained, capsys):
    for traffic, name in (("none", "none"), ("other-scene", "other_scene")):
        assert main(["eval", str(trained), "--checkpoint", "last", "--traffic", traffic]) == 0
        stem = trained / "evaluations" / f"procedural-test-step4-traffic_{name}"
        assert json.loads(stem.with_suffix(".json").read_text())["meta"]["traffic"] == traffic


def test_evaluation_with_geometric_topology_has_a_file_of_its_own(trained):
    assert main(["eval", str(trained), "--checkpoint", "last", "--topology", "geometric", "--errors"]) == 0
    errors = json.loads((trained / "evaluations/procedural-test-step4-topology_geometric-errors.json").read_text())
    assert [(row["of"], row["seed"]) for row in errors["rows"]] == [("true lanes", 3), ("detections", 3)]
    assert main(["eval", str(trained), "--checkpoint", "last"]) == 0
    for suffix, topology in (("", "learned"), ("-topology_geometric", "geometric")):
        path = trained / "evaluations" / f"procedural-test-step4{suffix}.json"
        assert json.loads(path.read_text())["meta"]["topology"] == topology


def test_evaluation_by_another_version_has_a_file_of_its_own(trained, capsys):
    """Regression: the table left scores of the second version out."""
    assert main(["eval", str(trained), "--checkpoint", "last", "--versions", "v2.1", "v1.0"]) == 0
    content = json.loads((trained / "evaluations/procedural-test-step4-v2.1_v1.0.json").read_text())
    assert "v1.0" in content["meta"]["protocol"]
    assert {"TOP_ll", "TOP_ll_v1.0"} <= content["rows"][0].keys()
    assert main(["eval", str(trained), "--map-measures", "iou"]) == 2
    assert "--map-measures are those of the lines of a vector map, and this model" in capsys.readouterr().err


def test_prediction_writes_arrays_json_and_pictures(trained, tmp_path):
    out = tmp_path / "predictions"
    assert main(["predict", str(trained), "--count", "2", "--out", str(out), "--threshold", "0"]) == 0
    assert {p.name for p in out.iterdir()} == {"predictions.npz", "truth.npz", "predictions.json", "pictures.png"}
    arrays, plain = np.load(out / "predictions.npz"), json.loads((out / "predictions.json").read_text())
    assert arrays["points"].shape == (2, 6, POINTS, 3)
    assert arrays["timestamp_ns"].tolist() == [10**18, 10**18 + 4]
    for i, frame in enumerate(plain["frames"]):
        assert (frame["scene"], frame["timestamp_ns"]) == (arrays["scene"][i], arrays["timestamp_ns"][i])
        assert [lane["score"] for lane in frame["lanes"]] == sorted(arrays["scores"][i].tolist(), reverse=True)
        for lane in frame["lanes"]:
            np.testing.assert_array_equal(np.float32(lane["points"]), arrays["points"][i, lane["query"]])
        for link in frame["successors"]:
            a, b = (frame["lanes"][link[end]]["query"] for end in ("from", "to"))
            assert link["score"] == arrays["successor"][i, a, b] >= 0.5
        light = frame["elements"][0]
        assert light["attribute"] == 2
        np.testing.assert_array_equal(np.float32(light["box"]), arrays["box"][i, light["query"]])
        governed = [frame["lanes"][pair["lane"]]["query"] for pair in frame["governs"] if pair["element"] == 0]
        assert sorted(governed) == [0, 1]


@pytest.mark.parametrize("version", ["v1.0", "v2.1"])
def test_a_whole_split_is_predicted_in_parts_and_scored(trained, tmp_path, monkeypatch, capsys, version):
    drawn = []
    monkeypatch.setattr("tflane_jax.commands.predict_lanes.MOST_DRAWN", 2)
    monkeypatch.setattr("tflane_jax.evaluation.predict._AT_ONCE", 2)
    monkeypatch.setattr(
        "tflane_jax.commands.predict_lanes.save_examples", lambda *_, titles, **__: drawn.extend(titles)
    )
    out = tmp_path / "predictions"
    assert main(["predict", str(trained), "--count", "1000000", "--out", str(out)]) == 0
    assert len(np.load(out / "predictions.npz")["points"]) == 5
    assert len(drawn) == 2
    files = [str(out / f"{name}.npz") for name in ("predictions", "truth")]
    assert main(["score", f"openlane-{version}-centerline", *files, "--out", str(tmp_path / "score")]) == 0
    scored = json.loads((tmp_path / "score.json").read_text())["rows"][0]
    assert main(["eval", str(trained), "--split", "val", "--out", str(tmp_path / "eval")]) == 0
    assert "was chosen as the best one by these examples" in capsys.readouterr().out
    evaluated = json.loads((tmp_path / "eval.json").read_text())["rows"][0]
    assert scored["frames"] == 5
    assert scored["DET_l"] == pytest.approx(evaluated["DET_l"])
    if version == "v2.1":  # what tflane eval measures
        assert scored["TOP_ll"] == pytest.approx(evaluated["TOP_ll"])


@pytest.mark.slow
def test_a_baseline_has_no_traffic_flow_to_limit(config, tmp_path, capsys):
    folder = tmp_path / "baseline"
    command = ["train", "--config", f"{config}:baseline", "--out", str(folder), "--training.steps", "2"]
    assert main([*command, *FEW_PICTURES]) == 0
    assert main(["eval", str(folder), "--traffic", "none"]) == 2
    assert "this model takes none" in capsys.readouterr().err
    assert main(["eval", str(folder), "--max-instances", "0"]) == 2
    assert "without traffic flow" in capsys.readouterr().err


@pytest.mark.slow
def test_several_seeds_are_evaluated_with_mean_and_deviation(config, tmp_path):
    folder = tmp_path / "seeds"
    arguments = ["--training.seeds", "0", "1", "--training.steps", "2", *FEW_PICTURES]
    assert main(["train", "--config", f"{config}:baseline", "--out", str(folder), *arguments]) == 0
    assert main(["eval", str(folder), "--out", str(tmp_path / "table")]) == 0
    rows = [r for r in json.loads((tmp_path / "table.json").read_text())["rows"] if r["lanes of"] == "all"]
    assert [row["seed"] for row in rows] == [0, 1, "mean", "std"]
    values = [row["DET_l"] for row in rows]
    np.testing.assert_allclose(values[2:], [np.mean(values[:2]), np.std(values[:2], ddof=1)])


def test_scores_that_cannot_be_printed_are_saved(trained, tmp_path, monkeypatch):
    def fail(*_):
        raise UnicodeEncodeError("ascii", "ü", 0, 1, "ordinal not in range(128)")

    monkeypatch.setattr("tflane_jax.commands.evaluate.print", fail, raising=False)
    with pytest.raises(UnicodeEncodeError):
        main(["eval", str(trained), "--out", str(tmp_path / "table")])
    assert json.loads((tmp_path / "table.json").read_text())["rows"]


def test_a_damaged_checkpoint_is_told_before_the_data_are_read(trained, tmp_path, monkeypatch, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    array = next(
        path for path in sorted((run / "checkpoints" / "step_00000004" / "state").rglob("*")) if path.is_file()
    )
    array.write_bytes(array.read_bytes()[:-1] + b"?")
    monkeypatch.setattr("tflane_jax.runs._train", None)
    assert main(["train", "--resume", "--out", str(run)]) == 2
    said = capsys.readouterr().err
    assert "step_00000004 is damaged" in said
    assert "the run can go on from step 2" in said


def test_where_scores_go_is_checked_before_the_evaluation(trained, tmp_path, monkeypatch, capsys):
    """Also where --out is left out: the table was printed, minutes later, and could not be saved."""
    run = shutil.copytree(trained, tmp_path / "run", ignore=shutil.ignore_patterns("evaluations"))
    (run / "evaluations").touch()
    monkeypatch.setattr("tflane_jax.commands.evaluate.evaluate_run", None)
    assert main(["eval", str(run)]) == 2
    assert f"{run / 'evaluations'} is no folder; choose another path" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train"], "say what to train"),
        (["train", "--config", "nowhere.py"], "config file nowhere.py does not exist"),
        (["train", "--resume"], "say which run to resume"),
        (["train", "--resume", "--out", "nowhere"], "nowhere holds no run"),
        (["train", "--resume", "--out", "RUN", "--training.steps", "9"], "another run with --training.init-from RUN"),
        (["train", "--config", "CONFIG", "--optim.learning_rate", "1"], "unknown setting --optim.learning_rate"),
        (["train", "--config", "CONFIG", "--optim.ll", "1"], "did you mean --optim.lr"),
        (["train", "--config", "CONFIG", "--optim.lr", "high"], "--optim.lr is 'high': it must be a number"),
        (["train", "--config", "CONFIG:no_such"], "has no ablation no_such, only baseline"),
        (["eval", "nowhere"], "nowhere does not exist: the first argument is a run folder"),
        (["eval", "RUN", "--checkpoint", "77"], "has no checkpoint of step 77, only [2, 4, 'last', 'best']"),
        (["eval", "RUN", "--data", "argoverse2"], "needs --root"),
        (["eval", "RUN", "--root", "logs"], "add --data argoverse2"),
        (["predict", "RUN", "--out", "RUN/config.json"], "config.json is no folder"),
        (["predict", "RUN", "--count", "0", "--out", "x"], "nothing to predict"),
        (["bench", "--out", "RUN/config.json"], "config.json is no folder"),
        (["data", "check", "nowhere"], "there is no nowhere: name a folder of Argoverse 2 logs"),
    ],
)
def test_errors_are_one_line_without_a_traceback(arguments, message, config, trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [a.replace("CONFIG", str(config)).replace("RUN", str(trained)) for a in arguments]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert message.replace("RUN", str(trained)) in said
    assert said.startswith("tflane: ")
    assert said.count("\n") == 1
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "arguments", [["evaluate"], ["eval", "run", "--splt", "val"], ["eval", "run", "--checkpoint", "x"]]
)
def test_unknown_arguments_exit_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_help_of_a_config_lists_its_settings(config, capsys):
    assert main(["train", "--config", str(config), "--help"]) == 0
    said = capsys.readouterr().out
    assert "--overwrite" in said
    assert re.search(r"^task\.model\.priors\.traffic_flow\.prior\.max_instances = 4  +# T_max", said, re.M)


def test_every_command_has_help(capsys):
    help_of = re.findall(r"^    (\w+) ", build_parser().format_help(), re.M)
    assert {"train", "eval", "predict", "data", "demo", "bench"} <= set(help_of)
    for command in help_of[1:]:
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code == 0
        assert capsys.readouterr().out.startswith(f"usage: tflane {command}")


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_prints_the_command_to_resume(config, tmp_path, capsys, monkeypatch):
    from tflane_jax.tasks import lane_graph

    def interrupting(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return evaluate(*arguments, **options)

    evaluate = lane_graph.evaluate_lanes
    monkeypatch.setattr(lane_graph, "evaluate_lanes", interrupting)
    folder = tmp_path / "stopped"
    assert main(["train", "--config", f"{config}:baseline", "--out", str(folder)]) == 130
    said = capsys.readouterr().err
    assert f"stopped by SIGINT after step 2; go on with: tflane train --resume --out {folder}" in said


@pytest.mark.slow  # tests/ablations/test_tables.py follows a table from training to page
def test_a_comparison_trains_and_tests_and_does_not_repeat_finished_runs(config, tmp_path, capsys):
    out = tmp_path / "comparison"
    command = ["compare", f"baseline={config}:baseline", f"+TFM={config}", "--seeds", "0", "1", "--out", str(out)]
    command += FEW_PICTURES
    assert main(command) == 0
    scores = json.loads((out / "scores.json").read_text())
    assert list(scores) == [
        "baseline",
        "+TFM",
        "+TFM, no traffic flow at inference",
        "+TFM, traffic of another scene",
    ]
    assert {len(values) for values in scores.values()} == {2}
    assert "+TFM" in (out / "table.md").read_text()
    assert "of 2" in (out / "paired.md").read_text()
    assert (out / "comparison.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "OpenLane-V2 centerline v2.1" in printed

    records = out / "tfm" / "seed_1" / "metrics.jsonl"
    before = records.stat().st_mtime_ns
    assert main(command) == 0
    assert records.stat().st_mtime_ns == before


def test_a_comparison_needs_different_names(config, tmp_path, capsys):
    assert main(["compare", str(config), str(config), "--out", str(tmp_path / "c")]) == 2
    assert "same name" in capsys.readouterr().err

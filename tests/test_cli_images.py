"""The commands for lane lines in one image, on tiny networks and few images."""

import json
import shutil
import sys

import jax
import numpy as np
import pytest

from tests.shared import shared_path
from tflane_jax.cli import main
from tflane_jax.files.tusimple import read_predictions, read_truth
from tflane_jax.metrics.tusimple import TuSimpleMetrics
from tflane_jax.world.render.weather import Sky

pytest.importorskip("cv2")

CONFIG = """
from tflane_jax.config import EvaluationConfig, FrontViewData, RunConfig
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig


def get_config():
    backbone = ResNetConfig((1, 1), (4, 8), (2, 2), stem_channels=4)
    return RunConfig(
        task=LaneShapeTask(LstrConfig(backbone, 8, decoder_layers=1, shrink=4)),
        data=FrontViewData(train=6, val=2, test=3),
        optim=OptimConfig(warmup_steps=1),
        training=TrainingConfig(steps=4, batch_size=2, log_every=1, eval_every=2, best_metric="all/Accuracy"),
        evaluation=EvaluationConfig(batch_size=2, pictures=1),
    )
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("configs") / "tiny.py"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory, config):
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TFLANE_CACHE", str(folder.parent / "cache"))
        assert main(["train", "--config", str(config), "--out", str(folder)]) == 0
        yield folder


def test_training_evaluates_by_tusimples_metric_and_draws(trained):
    records = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    validation = [record for record in records if record["split"] == "val"]
    assert [record["step"] for record in validation] == [2, 4]
    assert {"all/Accuracy", "all/FP", "all/FN", "all/loss"} < validation[0].keys()
    assert "batch_stats" not in json.dumps(records)
    assert len(list((trained / "pictures").glob("*.png"))) == 2
    assert (trained / "curves.png").is_file()


def test_prediction_without_data_or_photos_says_what_to_name(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["predict", str(trained), "--data", "tusimple", "--root", "nowhere", "--out", "x"]
    assert main(arguments) == 2
    assert "there is no folder nowhere: name that of the data with --root, or name photos" in capsys.readouterr().err


def test_evaluation_prints_a_table(trained, capsys):
    assert main(["eval", str(trained)]) == 0
    said = capsys.readouterr().out
    assert "TuSimple, time not measured" in said
    assert "| Accuracy |" in said.replace("  ", " ")
    rows = [line.split("|")[1].strip() for line in said.splitlines() if line.startswith("|")]
    assert "all" in rows
    assert {kind.value for kind in Sky} & set(rows), f"a row for each kind of weather: {rows}"
    assert main(["eval", str(trained), "--max-instances", "3"]) == 2
    assert main(["eval", str(trained), "--data", "argoverse2", "--root", "x"]) == 2
    assert "are no images" in capsys.readouterr().err


@pytest.mark.slow
def test_resume_is_bit_identical(trained, config, tmp_path):
    from tflane_jax.runs import open_run

    part = tmp_path / "part"
    assert main(["train", "--config", str(config), "--out", str(part)]) == 0
    shutil.rmtree(part / "checkpoints" / "step_00000004")
    assert main(["train", "--resume", "--out", str(part)]) == 0
    again, whole = (open_run(folder, "last").params[0] for folder in (part, trained))
    jax.tree.map(np.testing.assert_array_equal, again, whole)


def test_predictions_are_written_in_tusimple_format(trained, tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr("tflane_jax.plots.images.draw_lanes", lambda ax, lanes: drawn.append(len(lanes)))
    out = tmp_path / "predictions"
    assert main(["predict", str(trained), "--count", "2", "--threshold", "0", "--out", str(out)]) == 0
    truth, found = read_truth(out / "truth.json"), read_predictions(out / "predictions.json")
    assert drawn == [len(lanes.x) for lanes in found.values()] == [7, 7]
    assert truth.keys() == found.keys()
    metrics = TuSimpleMetrics()
    for name, lanes in truth.items():
        metrics.update(found[name], lanes)
    assert metrics.compute()["frames"] == 2
    assert (out / "pictures.png").is_file()
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["predict", str(trained), "--count", "1", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "no pictures, which need matplotlib: " in said.err
    assert said.out.endswith(f"written to {out}: predictions.json, truth.json\n")
    assert {path.name for path in out.iterdir()} == {"predictions.json", "truth.json"}


@pytest.mark.slow
def test_photos_of_any_size(trained, tmp_path, capsys):
    import cv2

    rng = np.random.default_rng(0)
    for name, size in (("wide", (90, 400)), ("high", (300, 200)), ("dot", (1, 1))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), rng.integers(0, 256, (*size, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((60, 80, 3), np.uint8))
    video = cv2.VideoWriter(str(tmp_path / "drive.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (160, 90))
    for _ in range(2):
        video.write(np.tile(np.linspace(40, 200, 160).astype(np.uint8)[:, None], (90, 1, 3)))
    video.release()
    out = tmp_path / "out"
    command = ["predict", str(trained), str(tmp_path), "--out", str(out)]
    assert main([*command, "--horizon", "30", "--threshold", "0"]) == 2  # the dot has no row 30
    assert "the horizon, row 30, is below a photo 1 pixels high" in capsys.readouterr().err
    # Photos may also stand behind options.
    assert main(["predict", str(trained), "--threshold", "1.5", "--out", str(out), str(tmp_path)]) == 2
    assert "--threshold 1.5: it must be a score from 0 to 1" in capsys.readouterr().err
    assert main(command) == 0
    assert "black.png: the photo is empty" in capsys.readouterr().err
    record = json.loads((out / "predictions.json").read_text())
    black, *photos = record["photos"]
    assert (black["lanes"], record["threshold"]) == ([], 0.5)
    (clip,) = record["videos"]
    assert (clip["width"], clip["height"], clip["rate"]) == (160, 90, 10)
    assert clip["video"] is None or (out / clip["video"]).is_file()
    assert [(photo["width"], photo["height"]) for photo in photos] == [(1, 1), (200, 300), (400, 90)]
    for photo in record["photos"]:
        assert (out / photo["picture"]).is_file()
        for lane in photo["lanes"]:
            assert 0 <= lane["score"] <= 1
            points = np.array(lane["points"])
            assert ((points >= 0) & (points <= [photo["width"], photo["height"]])).all()
    assert main(["predict", str(trained), str(tmp_path / "drive.mp4"), "--horizon", "30", "--out", str(out)]) == 0
    (clip,) = json.loads((out / "predictions.json").read_text())["videos"]
    assert clip["video"] == "drive-lanes.mp4"
    assert len(clip["frames"]) == 2
    assert (out / "drive-lanes.mp4").stat().st_size > 0
    assert main(["predict", str(trained), str(tmp_path / "nothing.jpg"), "--out", str(out)]) == 2
    assert "nothing.jpg" in capsys.readouterr().err


@pytest.mark.slow
def test_export_writes_a_program_and_its_latencies(trained, tmp_path, capsys):
    assert main(["export", str(trained), "--out", str(tmp_path / "m.stablehlo")]) == 0
    assert "the model's numbers" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.json", "m.md", "m.stablehlo"]


@pytest.mark.slow
def test_a_comparison_quotes_table_1(trained, config, tmp_path):
    out = tmp_path / "table1"
    command = ["compare", f"a={config}", f"b={config}", "--seeds", "0", "--out", str(out)]
    assert main([*command, "--training.eval-every", "4"]) == 0
    table = (out / "table.md").read_text()
    for name in ("SCNN", "PINet", "FastDraw", "GTN paper"):
        row = next(line for line in table.splitlines() if f"| {name} " in line)
        assert "quoted" in row
    assert table.count("this run") == 2
    assert (out / "comparison.png").is_file()


def test_pictures_of_the_data(trained, config, tmp_path, capsys):
    assert main(["data", "show", "--config", str(config), "--count", "1", "--out", str(tmp_path / "v.png")]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"v.png", "v-augmented.png"}
    assert "lane lines" in capsys.readouterr().out


def test_weights_need_a_configuration(trained, capsys):
    assert main(["eval", str(trained), "--weights", "weights.npz"]) == 2
    assert "add --config FILE" in capsys.readouterr().err


@pytest.mark.golden
@pytest.mark.slow
def test_published_weights_on_the_real_frames(tmp_path, capsys):
    """The original's accuracy 0.96562, FP 0.0 and FN 0.025, and its points within half a pixel."""
    lstr = ["--config", "gtn_lane/lstr", "--weights", str(shared_path("data/lstr/LSTR_500000.npz"))]
    # The frames at hand are of the training set.
    frames = ["--root", str(shared_path("data/tusimple/LaneDetection")), "--split", "train"]
    assert main(["eval", *lstr, *frames, "--out", str(tmp_path / "score")]) == 0
    rows = json.loads((tmp_path / "score.json").read_text())["rows"]
    assert rows[0]["Accuracy"] == pytest.approx(0.96562, abs=5e-6)
    assert rows[0]["FP"] == 0.0
    assert rows[0]["FN"] == pytest.approx(0.025, abs=1e-9)

    run = tmp_path / "converted"
    assert main(["convert", *lstr, "--out", str(run)]) == 0
    assert "186 tensors" in capsys.readouterr().out
    assert main(["eval", str(run), *frames, "--out", str(tmp_path / "again")]) == 0
    again = json.loads((tmp_path / "again.json").read_text())["rows"]
    assert {k: again[0][k] for k in ("Accuracy", "FP", "FN")} == {k: rows[0][k] for k in ("Accuracy", "FP", "FN")}

"""`tflane predict` for a model of the lines of a vector map."""

import json
import re
import sys
from argparse import Namespace

import numpy as np
import pytest

from tests.plots.test_map_lines import labelled, prediction
from tests.slow import with_slow
from tflane_jax.commands import predict_lanes
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError, install
from tflane_jax.runs import Run
from tflane_jax.scene import Prediction, stack_examples

pytest.importorskip("matplotlib")

ARRAYS = ("predictions.npz", "truth.npz", "predictions.json")


def fixed(monkeypatch, out, example=None):
    """Let the command predict the same lines in one example; return its arguments."""
    example = labelled() if example is None else example
    source, lines = RunConfig().data.source("val"), prediction("without")

    class Dataset:
        def __len__(self):
            return 1

        def info(self, index):
            return Namespace(source="fake", scene=f"scene {index}", timestamp_ns=10**9)

    answer = stack_examples([example]), Prediction(lines=stack_examples([lines]))
    monkeypatch.setattr(predict_lanes, "source_for", lambda *_: source)
    monkeypatch.setattr(predict_lanes.sources, "open_dataset", lambda *_: Dataset())
    monkeypatch.setattr(predict_lanes, "predict_examples", lambda *_: answer)
    options = Namespace(count=1, out=out, threshold=0.5, max_instances=None, cameras=False)
    return Run("run", RunConfig(), 1, ({},)), options


@pytest.mark.parametrize("truth", with_slow(["labelled", "derived"], quick=["labelled"]))
def test_prediction_of_lines(tmp_path, monkeypatch, capsys, truth):
    example, out = labelled(), tmp_path / "predictions"
    example = example if truth == "labelled" else example.replace(map_lines=None)
    run, options = fixed(monkeypatch, out, example)
    options.threshold = 1.0
    assert predict_lanes.predict(run, options) == 0
    assert re.match(
        r"1 frame, 0 lanes with a score of at least 1 \(best 0\.\d+: choose a lower --threshold to see it\); written",
        capsys.readouterr().out,
    )
    options.threshold = 0.5
    assert predict_lanes.predict(run, options) == 0

    assert capsys.readouterr().out.startswith("1 frame, 4 lanes with a score of at least 0.5; written to ")
    arrays = np.load(out / "predictions.npz")
    assert set(arrays) == {"points", "scores", "category", "scene", "timestamp_ns"}
    assert arrays["points"].shape == (1, 6, 5, 2)
    assert arrays["category"][0, :4].tolist() == [0, 1, 2, 3]
    frame = json.loads((out / "predictions.json").read_text())["frames"][0]
    assert [lane["category"] for lane in frame["lanes"]] == [0, 1, 2, 3]
    assert "successors" not in frame
    assert (out / "truth.npz").is_file() == (truth == "labelled")
    if truth == "labelled":
        known = np.load(out / "truth.npz")
        np.testing.assert_array_equal(known["category"][0], example.map_lines.category)
        np.testing.assert_array_equal(known["valid"][0], example.map_lines.valid)
    assert (out / "pictures.png").is_file()
    assert (out / "cameras.png").is_file()


@pytest.fixture
def older(tmp_path):
    """Return a folder with what an earlier prediction wrote."""
    out = tmp_path / "older"
    out.mkdir()
    for name in (*ARRAYS, "pictures.png", "cameras.png"):
        (out / name).write_text("older")
    return out


def test_without_matplotlib_all_but_pictures_is_written(older, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert predict_lanes.predict(*fixed(monkeypatch, older)) == 0
    said = capsys.readouterr()
    assert said.err == f"no pictures, which need matplotlib: {install('plot')}\n"
    assert said.out.endswith(f"written to {older}: {', '.join(ARRAYS)}\n")
    assert sorted(path.name for path in older.iterdir()) == sorted(ARRAYS)
    assert np.load(older / "truth.npz")


def test_a_disk_that_fills_up_leaves_no_older_files_beside_new_ones(older, monkeypatch):
    def full(*_):
        raise UserError("No space left on device")

    monkeypatch.setattr(predict_lanes, "write_json", full)
    with pytest.raises(UserError, match="No space"):
        predict_lanes.predict(*fixed(monkeypatch, older))
    assert sorted(path.name for path in older.iterdir()) == ["predictions.npz", "truth.npz"]
    monkeypatch.setattr(predict_lanes, "write_npz", full)
    (older / "pictures.png").touch()
    with pytest.raises(UserError, match="No space"):  # nothing is written, and nothing deleted
        predict_lanes.predict(*fixed(monkeypatch, older))
    assert (older / "pictures.png").exists()

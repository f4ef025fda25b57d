"""`tflane predict` for a model of the lines of a vector map."""

import json
import re
from argparse import Namespace

import numpy as np
import pytest

from tests.plots.test_map_lines import labelled, prediction
from tests.slow import with_slow
from tflane_jax.commands import predict_lanes
from tflane_jax.config import RunConfig
from tflane_jax.runs import Run
from tflane_jax.scene import Prediction, stack_examples

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("truth", with_slow(["labelled", "derived"], quick=["labelled"]))
def test_prediction_of_lines(tmp_path, monkeypatch, capsys, truth):
    example, out = labelled(), tmp_path / "predictions"
    example = example if truth == "labelled" else example.replace(map_lines=None)
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
    options = Namespace(count=1, out=out, threshold=1.0, max_instances=None, cameras=False)
    assert predict_lanes.predict(Run("run", RunConfig(), 1, ({},)), options) == 0
    assert re.match(
        r"1 frame, 0 lanes with a score of at least 1 \(best 0\.\d+: choose a lower --threshold to see it\); written",
        capsys.readouterr().out,
    )
    options.threshold = 0.5
    assert predict_lanes.predict(Run("run", RunConfig(), 1, ({},)), options) == 0

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

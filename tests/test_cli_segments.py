"""`tflane predict` for a model of lane segments."""

import json
from argparse import Namespace

import numpy as np
import pytest

from tests.fakes import POINTS, FakeConfig, FakeDataset, fake_example, fake_segments, fake_views
from tflane_jax.commands import predict_lanes
from tflane_jax.config import EvaluationConfig, RunConfig
from tflane_jax.datasets.procedural import SimulatedDataset
from tflane_jax.errors import UserError
from tflane_jax.evaluation.geometric_topology import edge_confidences, geometric_edges
from tflane_jax.runs import Run
from tflane_jax.scene import Prediction, stack_examples

pytest.importorskip("matplotlib")


def test_prediction_of_segments_adds_boundaries_and_types(tmp_path, monkeypatch):
    dataset, segments, out = FakeDataset(FakeConfig(2)), fake_segments(), tmp_path / "predictions"
    source = RunConfig().data.source("val")
    answer = stack_examples([dataset.example(0)]), Prediction(segments=stack_examples([segments]))
    monkeypatch.setattr(predict_lanes, "source_for", lambda *_: source)
    monkeypatch.setattr(predict_lanes.sources, "open_dataset", lambda *_: dataset)
    monkeypatch.setattr(predict_lanes, "predict_examples", lambda *_: answer)
    options = Namespace(count=1, out=out, threshold=0.5, max_instances=None, cameras=False)
    assert predict_lanes.predict(Run("run", RunConfig(), 1, ({},)), options) == 0

    arrays, truth = np.load(out / "predictions.npz"), np.load(out / "truth.npz")
    assert arrays["category"].tolist() == [[0, 0, 1, 0, 0, 0]]
    assert (arrays["left_type"][0, :2].tolist(), arrays["right_type"][0, :2].tolist()) == ([1, 2], [0, 1])
    np.testing.assert_array_equal(arrays["left"][0], segments.left)
    assert truth["left"].shape == (1, 3, POINTS, 3)  # the segments of the example, not its centerlines
    lanes = json.loads((out / "predictions.json").read_text())["frames"][0]["lanes"]
    assert [lane["category"] for lane in lanes] == [0, 0, 1]
    np.testing.assert_array_equal(np.float32(lanes[0]["right"]), segments.right[lanes[0]["query"]])
    assert (out / "pictures.png").is_file()
    assert not (out / "cameras.png").exists()

    options.cameras = True
    monkeypatch.setattr(predict_lanes.sources, "make_dataset", lambda *_: dataset)
    with pytest.raises(UserError, match="--cameras renders scenes of the built-in world, and fake has none"):
        predict_lanes.predict(Run("run", RunConfig(), 1, ({},)), options)


def test_predictions_are_those_that_are_evaluated(tmp_path, monkeypatch, capsys):
    """Regression: edges of `evaluation.topology` "geometric" were the learned ones, traffic "none" was not taken."""
    dataset, segments = FakeDataset(FakeConfig(2)), fake_segments()
    seen = []

    def predict_examples(task, params, dataset, indices):
        seen.append(stack_examples([dataset.example(index) for index in indices]))
        return seen[-1], Prediction(segments=stack_examples([segments]))

    monkeypatch.setattr(predict_lanes, "source_for", lambda *_: RunConfig().data.source("val"))
    monkeypatch.setattr(predict_lanes.sources, "open_dataset", lambda *_: dataset)
    monkeypatch.setattr(predict_lanes, "predict_examples", predict_examples)
    found = {}
    for topology in ("learned", "geometric"):
        options = Namespace(count=1, out=tmp_path / topology, threshold=0.5, max_instances=None, cameras=False)
        config = RunConfig(evaluation=EvaluationConfig(topology=topology, traffic="none"))
        assert predict_lanes.predict(Run("run", config, 1, ({},)), options) == 0
        assert "evaluation.traffic is none, also in the pictures" in capsys.readouterr().out
        assert not seen[-1].traffic_flow.valid.any()
        found[topology] = np.load(tmp_path / topology / "predictions.npz")["successor"][0]
    points, logits = np.asarray(segments.points), np.asarray(segments.successor_logits)
    np.testing.assert_allclose(found["geometric"], edge_confidences(points, logits, "geometric"), rtol=1e-6)
    np.testing.assert_allclose(found["geometric"] - found["learned"], geometric_edges(points), atol=1e-6)


@pytest.mark.slow
def test_images_of_the_world_are_rendered_for_the_picture(tmp_path, monkeypatch):
    class World(SimulatedDataset):
        """Scenes whose examples have images if they are asked for."""

        source = "world"

        info = FakeDataset.info

        def example(self, index):
            cameras = None if self.config.example.cameras is None else fake_views(index)
            return fake_example(index).replace(cameras=cameras)

    source = RunConfig().data.source("val")
    answer = stack_examples([World(source).example(0)]), Prediction(segments=stack_examples([fake_segments()]))
    monkeypatch.setattr(predict_lanes, "source_for", lambda *_: source)
    for function in ("open_dataset", "make_dataset"):
        monkeypatch.setattr(predict_lanes.sources, function, World)
    monkeypatch.setattr(predict_lanes, "predict_examples", lambda *_: answer)
    options = Namespace(count=1, out=tmp_path, threshold=0.5, max_instances=None, cameras=True)
    assert predict_lanes.predict(Run("run", RunConfig(), 1, ({},)), options) == 0
    assert (tmp_path / "cameras.png").is_file()

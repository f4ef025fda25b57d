"""The scene's padded containers as inputs of the centerline metrics."""

import dataclasses
import re
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from tests.shared import ROOT
from tflane_jax.evaluation.centerlines import detections_of_centerlines, truth_of_centerlines
from tflane_jax.metrics import CenterlineMetrics
from tflane_jax.scene import CenterlinePrediction, ElementPrediction, LaneGraph, Prediction, TrafficElements


def make_graph(garbage):
    lanes = LaneGraph.empty(5, 11)
    valid = np.array([True, False, True, False, True])
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (5, 11, 3)).astype(np.float32)
    both = valid[:, None] & valid[None]
    elements = TrafficElements.empty(3, 5)
    return (
        dataclasses.replace(
            lanes,
            points=np.where(valid[:, None, None], points, garbage),
            visibility=np.where(valid, np.float32(0.25), garbage),
            successor=np.where(both, rng.random((5, 5)) < 0.4, np.isnan(garbage)),
            valid=valid,
        ),
        dataclasses.replace(
            elements,
            valid=np.array([False, True, False]),
            attribute=np.array([99, 3, 99]),
            lane=rng.random((5, 3)) < 0.5,
        ),
    )


def make_prediction():
    rng = np.random.default_rng(1)
    return CenterlinePrediction(
        points=rng.uniform(-20, 20, (4, 11, 3)).astype(np.float32),
        logits=np.array([[-1.0], [3.0], [0.5], [-200.0]], np.float32),
        successor_logits=rng.normal(size=(4, 4)).astype(np.float32),
    )


def test_truth_holds_the_valid_lanes_only():
    lanes, elements = make_graph(np.nan)
    truth = truth_of_centerlines(lanes, elements)
    np.testing.assert_array_equal(truth.points, lanes.points[[0, 2, 4]])
    np.testing.assert_array_equal(truth.successor[1, 2], lanes.successor[2, 4])
    np.testing.assert_array_equal(truth.visibility, [0.25] * 3)
    assert truth.elements is not None
    np.testing.assert_array_equal(truth.elements.attributes, [3])
    np.testing.assert_array_equal(truth.elements.lane[:, 0], elements.lane[[0, 2, 4], 1])
    assert np.shape(truth_of_centerlines(LaneGraph.empty(4, 11)).points) == (0, 11, 3)


def test_padding_changes_no_metric():
    def result(garbage):
        metrics = CenterlineMetrics()
        metrics.update(detections_of_centerlines(make_prediction()), truth_of_centerlines(make_graph(garbage)[0]))
        return metrics.compute()

    assert result(np.nan) == result(np.float32(0.0))


def test_detections_are_sorted_by_score_with_their_topology():
    prediction = make_prediction()
    detections = detections_of_centerlines(prediction)
    np.testing.assert_allclose(detections.scores, 1 / (1 + np.exp([-3.0, -0.5, 1.0, 200.0])), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(detections.points, prediction.points[[1, 2, 0, 3]])
    expected = 1 / (1 + np.exp(-prediction.successor_logits[1, 3]))
    np.testing.assert_allclose(detections.successor[0, 3], expected, rtol=1e-6)


def test_elements_are_sorted_by_score_with_their_lanes():
    rng = np.random.default_rng(2)
    logits = np.full((3, 13), -5.0, np.float32)
    logits[[0, 1, 2], [4, 2, 12]] = -1.0, 2.0, 0.5
    elements = ElementPrediction(
        rng.uniform(0, 100, (3, 2, 2)).astype(np.float32), logits, rng.normal(size=(4, 3)).astype(np.float32)
    )
    found = detections_of_centerlines(make_prediction(), elements).elements
    assert found is not None
    np.testing.assert_array_equal(found.attributes, [2, 12, 4])
    np.testing.assert_array_equal(found.boxes, elements.box[[1, 2, 0]])
    # Lanes are in the order of the detections too: best first, 1, 2, 0, 3.
    np.testing.assert_allclose(found.lane[2, 1], 1 / (1 + np.exp(-elements.lane_logits[0, 2])), rtol=1e-6)


def test_perfect_elements_get_the_full_score():
    lanes, elements = make_graph(np.float32(0.0))
    box = np.array([[[1, 2], [3, 4]], [[10, 20], [30, 45]], [[5, 6], [7, 8]]], np.float32)
    elements = dataclasses.replace(elements, box=box, lane=np.eye(5, 3, dtype=bool)[:, [1, 0, 2]])
    certain = np.full((5, 1), 9.0, np.float32)
    predicted = CenterlinePrediction(
        lanes.points, np.where(lanes.valid[:, None], certain, -9.0), _sure(lanes.successor)
    )
    attribute = np.where(np.arange(13) == 3, 9.0, -9.0)[None].astype(np.float32)
    said = ElementPrediction(box[1:2], attribute, _sure(elements.lane[:, 1:2]))
    metrics = CenterlineMetrics()
    metrics.update(detections_of_centerlines(predicted, said), truth_of_centerlines(lanes, elements))
    result = metrics.compute()
    assert result["DET_t"] == 1.0
    assert result["TOP_lt"] == 1.0


def _sure(edges):
    return np.where(edges, 9.0, -9.0).astype(np.float32)


def test_device_arrays_are_accepted():
    prediction = make_prediction()
    on_device = CenterlinePrediction(
        *(jnp.asarray(leaf) for leaf in (prediction.points, prediction.logits, prediction.successor_logits))
    )
    np.testing.assert_array_equal(
        detections_of_centerlines(on_device).points, detections_of_centerlines(prediction).points
    )


def test_the_example_of_the_page_scores_frames(capsys):
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/metrics.md").read_text("utf-8"), re.DOTALL | re.M)
    (code,) = [block for block in blocks if "detections_of_centerlines" in block]
    frames = [(Prediction(centerlines=make_prediction()), SimpleNamespace(lanes=make_graph(0.0)[0]))]
    exec(compile(code, "metrics.md", "exec"), {"frames": frames})
    assert "DET_l" in capsys.readouterr().out

"""From the scene's padded containers to what the metrics compare."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from tflane_jax.metrics import CenterlineMetrics, detections_from_prediction, truth_from_example
from tflane_jax.scene import LaneGraph, LanePrediction, TrafficElements


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
    return LanePrediction(
        points=rng.uniform(-20, 20, (4, 11, 3)).astype(np.float32),
        logits=np.array([[-1.0], [3.0], [0.5], [-200.0]], np.float32),
        successor_logits=rng.normal(size=(4, 4)).astype(np.float32),
    )


def test_truth_holds_the_valid_lanes_only():
    lanes, elements = make_graph(np.nan)
    truth = truth_from_example(lanes, elements)
    np.testing.assert_array_equal(truth.points, lanes.points[[0, 2, 4]])
    np.testing.assert_array_equal(truth.successor[1, 2], lanes.successor[2, 4])
    np.testing.assert_array_equal(truth.visibility, [0.25] * 3)
    assert truth.elements is not None
    np.testing.assert_array_equal(truth.elements.attributes, [3])
    np.testing.assert_array_equal(truth.elements.lane[:, 0], elements.lane[[0, 2, 4], 1])
    assert np.shape(truth_from_example(LaneGraph.empty(4, 11)).points) == (0, 11, 3)


def test_padding_changes_no_metric():
    def result(garbage):
        metrics = CenterlineMetrics()
        metrics.update(detections_from_prediction(make_prediction()), truth_from_example(make_graph(garbage)[0]))
        return metrics.compute()

    assert result(np.nan) == result(np.float32(0.0))


def test_detections_come_best_first_with_their_topology():
    prediction = make_prediction()
    detections = detections_from_prediction(prediction)
    np.testing.assert_allclose(detections.scores, 1 / (1 + np.exp([-3.0, -0.5, 1.0, 200.0])), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(detections.points, prediction.points[[1, 2, 0, 3]])
    expected = 1 / (1 + np.exp(-prediction.successor_logits[1, 3]))
    np.testing.assert_allclose(detections.successor[0, 3], expected, rtol=1e-6)


def test_device_arrays_are_taken_too():
    prediction = make_prediction()
    on_device = LanePrediction(*(jnp.asarray(leaf) for leaf in (
        prediction.points, prediction.logits, prediction.successor_logits)))  # fmt: skip
    np.testing.assert_array_equal(detections_from_prediction(on_device).points,
                                  detections_from_prediction(prediction).points)  # fmt: skip

"""Why lanes are not found: hand-made lanes and detections, and the number of found lanes against the metric's."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.evaluation.test_found_lanes import frame
from tflane_jax.evaluation.found_lanes import best_threshold, lane_confidences
from tflane_jax.evaluation.lane_errors import OUTCOMES, Frame, count_errors, covered_fraction, frame_of, lane_errors
from tflane_jax.metrics.centerline_matching import nearest_lanes
from tflane_jax.scene import CenterlinePrediction, LaneGraph, Prediction, SegmentPrediction


def line(start, end, y=0.0, points=11):
    """Return a lane along x."""
    x = np.linspace(start, end, points)
    return np.stack([x, np.full(points, y), np.zeros(points)], -1)


def lanes(*rows):
    return np.stack(rows) if rows else np.zeros((0, 11, 3))


def scene(truth, detected, scores):
    truth, detected = lanes(*truth), lanes(*detected)
    return Frame(truth, detected, np.array(scores, float), *nearest_lanes(truth, detected))


def numbers(counts):
    return [counts[outcome] for outcome in OUTCOMES]


def test_a_lane_that_is_cut_elsewhere_is_seen_and_not_found():
    cut = scene([line(0, 20), line(20, 40)], [line(0, 40), line(0, 20, y=20.0)], [0.9, 0.9])
    known = scene([line(0, 20)], [line(0, 20)], [0.5])  # gives a threshold at which all count
    errors = count_errors([cut, known])
    assert errors.threshold == 0.5
    assert numbers(errors.lanes) == [1, 0, 2, 0, 0]
    assert numbers(errors.detections) == [1, 0, 1, 0, 1]


@pytest.mark.parametrize(
    ("end", "outcome"), [(38.0, "wrong extent"), (30.0, "in part"), (21.0, "in part"), (12.0, "missed")]
)
def test_the_covered_length_decides(end, outcome):
    """Detections reach WITHIN farther than they go."""
    frames = [scene([line(0, 40)], [line(-10, end)], [0.9]), scene([line(0, 20)], [line(0, 20)], [0.5])]
    assert count_errors(frames).lanes == dict.fromkeys(OUTCOMES, 0) | {"found": 1, outcome: 1}


def test_a_second_detection_of_a_lane_finds_it_again_whatever_the_order():
    detected, scores = [line(0, 20), line(0, 20, y=0.5), line(0, 20, y=-0.5)], [0.6, 0.9, 0.6]
    for order in ([0, 1, 2], [2, 1, 0]):
        one = scene([line(0, 20)], [detected[i] for i in order], [scores[i] for i in order])
        single = [scene([line(0, 20)], [line(0, 20)], [0.6]) for _ in range(3)]
        errors = count_errors([one, *single])
        assert (errors.threshold, numbers(errors.lanes)) == (0.6, [4, 0, 0, 0, 0])
        assert numbers(errors.detections) == [4, 2, 0, 0, 0]


def test_oncoming_and_crossing_lanes_cover_nothing():
    here = lanes(line(0, 20))
    across = np.stack([np.full(11, 10.0), np.linspace(-20, 20, 11), np.zeros(11)], -1)[None]
    assert covered_fraction(here, here[:, ::-1]) == [0.0]
    assert covered_fraction(here, across) == [0.0]
    assert covered_fraction(here, here + np.array([0.0, 1.9, 50.0])) == [1.0]  # heights do not count
    assert covered_fraction(here, here + np.array([0.0, 2.1, 0.0])) == [0.0]


def test_lines_without_length_and_empty_frames():
    point = np.ones((1, 11, 3))
    assert covered_fraction(point, point) == covered_fraction(lanes(line(0, 3)), point) == [0.0]
    assert covered_fraction(point, lanes(line(0, 3))) == [0.0]  # beside it, but in no direction
    assert covered_fraction(lanes(), point).shape == (0,)
    errors = count_errors([scene([], [line(0, 9)], [0.9]), scene([line(0, 9)], [], [])])
    assert np.isinf(errors.threshold)
    assert (numbers(errors.lanes), numbers(errors.detections)) == ([0, 0, 0, 0, 1], [0] * 5)
    assert numbers(count_errors([]).lanes) == [0] * 5


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), turn=st.floats(-3.0, 3.0), shift=st.floats(-30.0, 30.0))
def test_every_line_has_one_outcome_in_any_frame_of_reference(seed, turn, shift):
    truth, detected, scores = frame(seed)
    errors = count_errors([Frame(truth, detected, scores, *nearest_lanes(truth, detected))])
    assert sum(errors.lanes.values()) == len(truth)
    assert sum(errors.detections.values()) == (scores >= errors.threshold).sum()
    assert errors.lanes["found"] == errors.detections["found"]
    assert errors.lanes["duplicate"] == 0
    confidences = lane_confidences(truth, detected, scores)
    assert errors.threshold == best_threshold([confidences], [scores])
    assert errors.lanes["found"] == (confidences >= errors.threshold).sum()
    turned = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    moved = [lines @ turned.T + [shift, -shift, 0.0] for lines in (truth, detected)]
    np.testing.assert_allclose(covered_fraction(*moved), covered_fraction(truth, detected), atol=1e-12)


def padded(truth, rows=4, padding=np.nan):
    graph = LaneGraph.empty(rows, truth.shape[1])
    for name in ("points", "left", "right"):
        getattr(graph, name)[:] = padding
        getattr(graph, name)[: len(truth)] = truth
    graph.valid[: len(truth)] = True
    return graph


def test_padding_and_crossings_count_nowhere():
    truth = lanes(line(0, 20), line(0, 20, y=8.0))
    one = frame_of(padded(truth), CenterlinePrediction(truth[:1], np.array([[4.0]])))
    assert numbers(count_errors([one]).lanes) == [1, 0, 0, 0, 1]
    logits = np.array([[3.0, -9.0], [-9.0, 3.0]])
    boundary = np.zeros((2, 3))
    found = SegmentPrediction(truth, truth, truth, logits, boundary, boundary)
    errors = count_errors([frame_of(padded(truth), found)])
    assert (numbers(errors.lanes), numbers(errors.detections)) == ([1, 0, 0, 0, 1], [1, 0, 0, 0, 0])


class _Predicts:
    """Predicts the first lane of the truth, and half of the second."""

    streams = False

    def predict(self, params, example):
        half = example.lanes.points.at[1].set(example.lanes.points[1] * 0.5 + example.lanes.points[1][:1] * 0.5)
        return Prediction(centerlines=CenterlinePrediction(half[:2], jax.numpy.array([[4.0], [3.0]])))


def test_a_model_on_a_data_set():
    from tests.fakes import fake_example
    from tflane_jax.scene import stack_examples

    lane = padded(lanes(line(0, 20), line(0, 20, y=9.0)), rows=3, padding=0.0)
    examples = stack_examples([fake_example(seed).replace(lanes=lane) for seed in range(3)])
    errors = lane_errors(_Predicts(), {}, examples, batch_size=2)
    assert numbers(errors.lanes) == [3, 0, 0, 0, 3]

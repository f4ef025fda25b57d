"""A prediction as plain values."""

import numpy as np
import pytest
from scipy.special import expit

from tests.fakes import fake_segments
from tflane_jax.scene import Prediction
from tflane_jax.tasks.answers import answer_arrays, best_first, lane_records


def records(segments, threshold):
    prediction = Prediction(segments=segments)
    arrays = answer_arrays(prediction)
    return lane_records(arrays, best_first(arrays["scores"], threshold))


def test_a_crossing_is_told_from_lanes():
    segments = fake_segments()
    logits = segments.logits.copy()
    logits[1, 0] = 3.0
    found = records(segments.replace(logits=logits), 0.3)
    assert [lane["query"] for lane in found] == [1, 0, 2]
    assert [lane["category"] for lane in found] == [0, 0, 1]
    assert [lane["score"] for lane in found] == pytest.approx(expit([3.0, 2.0, 2.0]))
    np.testing.assert_array_equal(found[2]["left"], segments.left[2])
    assert found[0].keys() == {"query", "score", "points", "left", "right", "category", "left_type", "right_type"}


@pytest.mark.parametrize(("threshold", "count"), [(0.0, 6), (1.0, 0)])
def test_the_threshold_holds_for_all_or_none(threshold, count):
    assert len(records(fake_segments(), threshold)) == count

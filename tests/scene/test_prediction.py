"""Scores of predictions."""

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.scene import (
    AreaPrediction,
    CenterlinePrediction,
    CurvePrediction,
    ElementPrediction,
    LinePrediction,
    Prediction,
    SegmentPrediction,
)

POINTS = np.zeros((2, 4, 3, 3), np.float32)
LOGITS = np.random.default_rng(0).normal(size=(2, 4, 2)).astype(np.float32)


@pytest.mark.parametrize(
    "prediction",
    [
        CenterlinePrediction(POINTS, LOGITS),
        SegmentPrediction(POINTS, POINTS, POINTS, LOGITS),
        AreaPrediction(POINTS, LOGITS),
        LinePrediction(POINTS, LOGITS),
        ElementPrediction(np.zeros((2, 4, 2, 2), np.float32), LOGITS),
    ],
)
def test_the_score_is_the_confidence_of_the_best_class(prediction):
    np.testing.assert_allclose(prediction.scores, (1 / (1 + np.exp(-LOGITS))).max(-1), rtol=1e-6)


def test_the_score_of_a_curve_is_the_probability_of_a_lane():
    logits = np.exp(LOGITS)
    found = CurvePrediction(LOGITS, np.zeros((2, 4, 8), np.float32)).scores
    np.testing.assert_allclose(found, logits[..., 1] / logits.sum(-1), rtol=1e-5)


def test_the_lanes_are_segments_before_centerlines_before_lines():
    lines, centerlines = LinePrediction(POINTS, LOGITS), CenterlinePrediction(POINTS, LOGITS)
    segments = SegmentPrediction(POINTS, POINTS, POINTS, LOGITS)
    assert Prediction(lines=lines).lanes is lines
    assert Prediction(lines=lines, centerlines=centerlines).lanes is centerlines
    assert Prediction(lines=lines, centerlines=centerlines, segments=segments).lanes is segments
    with pytest.raises(UserError, match="predicts no lanes around the vehicle"):
        _ = Prediction().lanes

"""Scores of predictions."""

import numpy as np
import pytest

from tflane_jax.scene import (
    AreaPrediction,
    CenterlinePrediction,
    CurvePrediction,
    ElementPrediction,
    LinePrediction,
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

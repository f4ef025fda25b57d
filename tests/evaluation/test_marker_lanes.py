"""The lanes of markers as a prediction: exactly the lanes that enter Eq. (3), each with its trust for a score."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.models.cases import BASELINE
from tests.models.test_marker_fusion import CONFIG, observed, seeing
from tflane_jax.errors import UserError
from tflane_jax.evaluation.marker_lanes import MarkerLanes
from tflane_jax.evaluation.predict import predictions
from tflane_jax.models.marker_fusion import as_fused
from tflane_jax.scene import stack_examples

HOST = replace(BASELINE, priors=replace(BASELINE.priors, markers=CONFIG))


def test_lanes_are_those_that_enter_eq_3_and_scores_their_trust():
    alone = MarkerLanes(replace(HOST, priors=replace(HOST.priors, markers=replace(CONFIG, memory=None))))
    example = seeing(observed(lanes=2))
    lanes = as_fused(CONFIG.build(HOST.spec).observe(example, None)[0], CONFIG)
    found = alone.predict(None, example).centerlines
    valid = np.asarray(lanes.valid)
    assert valid.sum() == 2
    np.testing.assert_array_equal(found.points[valid, :, :2], lanes.points[valid])
    np.testing.assert_allclose(found.scores[valid], (lanes.weight * lanes.gate)[valid], rtol=1e-5)
    np.testing.assert_allclose(found.scores[~valid], 0.0, atol=2e-6)
    assert not alone.streams
    assert MarkerLanes(HOST).streams
    assert not MarkerLanes(HOST, remembers=False).streams


def test_remembered_lanes_stay_and_padding_may_hold_anything():
    frames = [seeing(observed(lanes=2)), replace(seeing(observed(valid=False, garbage=np.nan)), has_previous=np.True_)]
    ((_, answers),) = predictions(MarkerLanes(HOST), {}, stack_examples(frames), 2)
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], answers.centerlines) for i in range(2))
    assert np.isfinite(second.points).all()
    assert (np.sort(second.scores)[-2:] < np.sort(first.scores)[-2:]).all()
    np.testing.assert_allclose(np.sort(second.scores)[-2:], 0.5 * np.sort(first.scores)[-2:], rtol=1e-4)


def test_a_host_without_markers_is_refused():
    with pytest.raises(UserError, match="no marker prior"):
        MarkerLanes(BASELINE)

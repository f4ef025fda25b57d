"""`resample_lines` is `resample` of many lines in one pass."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry.polylines import resample, resample_lines


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), lines=st.integers(1, 8), count=st.integers(2, 12))
def test_equals_one_at_a_time(seed, lines, count):
    rng = np.random.default_rng(seed)
    # Rounded coordinates give repeated vertices, lines of length zero and joints where two lines meet.
    ragged = [np.round(rng.uniform(-2, 2, (rng.integers(1, 7), 3))) for _ in range(lines)]
    expected = np.stack([resample(line, count) for line in ragged])
    np.testing.assert_allclose(resample_lines(ragged, count), expected, atol=1e-9)


def test_many_float32_lines_are_as_exact_as_one():
    lines = np.random.default_rng(0).uniform(0, 100, (3000, 2, 2)).astype(np.float32)
    expected = np.stack([resample(line.astype(np.float64), 5) for line in lines[-10:]])
    np.testing.assert_allclose(resample_lines(list(lines), 5)[-10:], expected, atol=1e-5)


def test_no_lines_and_an_empty_line():
    assert resample_lines([], 5).shape == (0, 5, 3)
    with pytest.raises(ValueError, match="without points"):
        resample_lines([np.ones((2, 3)), np.zeros((0, 3))], 5)

"""Initial values against PyTorch's rule."""

import jax
import numpy as np
import pytest

from tflane_jax.layers.initial import uniform_by_fan_in


@pytest.mark.parametrize("fan_in", [1, 4, 576])
def test_values_are_uniform_within_one_over_the_root_of_the_inputs(fan_in):
    found = np.asarray(uniform_by_fan_in(fan_in)(jax.random.key(0), (40, 50))) * fan_in**0.5
    assert np.abs(found).max() <= 1.0
    assert found.dtype == np.float32
    counts, _ = np.histogram(found, 4, (-1, 1))
    np.testing.assert_allclose(counts, 500, atol=90)  # four standard deviations and a half

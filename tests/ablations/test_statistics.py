"""Paired differences: against scipy's formula written out, and at the edges."""

import math

import numpy as np
import pytest
from scipy import stats

from tflane_jax.ablations.statistics import paired_difference


def test_against_the_formula():
    a, b = np.array([3.0, 4.0, 6.0, 5.0]), np.array([2.0, 4.5, 4.0, 3.0])
    got = paired_difference(a, b)
    d = a - b
    t = d.mean() / (d.std(ddof=1) / math.sqrt(4))
    assert got.mean == pytest.approx(d.mean())
    assert got.std == pytest.approx(d.std(ddof=1))
    assert got.p_value == pytest.approx(2 * stats.t.sf(abs(t), 3))
    assert (got.better, got.seeds) == (3, 4)


def test_swapping_changes_the_sign_only():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 6))
    one, other = paired_difference(a, b), paired_difference(b, a)
    assert one.mean == pytest.approx(-other.mean)
    assert one.p_value == pytest.approx(other.p_value)


def test_one_seed_has_no_test():
    got = paired_difference([1.0], [0.5])
    assert got.mean == 0.5
    assert math.isnan(got.std)
    assert math.isnan(got.p_value)


def test_equal_numbers_say_nothing():
    assert paired_difference([1.0, 2.0], [1.0, 2.0]).p_value == 1.0
    assert paired_difference([2.0, 3.0], [1.0, 2.0]).p_value == 0.0


@pytest.mark.parametrize(("a", "b"), [([], []), ([1.0], [1.0, 2.0])])
def test_nothing_to_pair(a, b):
    with pytest.raises(ValueError, match="as many numbers"):
        paired_difference(a, b)

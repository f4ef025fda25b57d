"""Paired differences against scipy's formula written out, Holm's correction, bootstrap samples against loops."""

import math

import numpy as np
import pytest
from scipy import stats

from tflane_jax.ablations.statistics import (
    bias_corrected,
    holm,
    interval,
    nothing_drawn,
    paired_difference,
    resampled_ratio,
)
from tflane_jax.evaluation.by_scene import scene_weights


def test_against_the_formula():
    a, b = np.array([3.0, 4.0, 6.0, 5.0]), np.array([2.0, 4.5, 4.0, 3.0])
    got = paired_difference(a, b)
    d = a - b
    t = d.mean() / (d.std(ddof=1) / math.sqrt(4))
    assert got.mean == pytest.approx(d.mean())
    assert got.std == pytest.approx(d.std(ddof=1))
    assert got.p_value == pytest.approx(2 * stats.t.sf(abs(t), 3))
    assert (got.better, got.seeds) == (3, 4)
    assert got.interval() == pytest.approx(stats.t.interval(0.95, 3, d.mean(), d.std(ddof=1) / 2))
    low, high = got.interval(1 - got.p_value)  # at the level of p, it ends at 0
    assert min(abs(low), abs(high)) == pytest.approx(0.0, abs=1e-9)


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
    assert all(map(math.isnan, got.interval()))


def test_differences_without_spread():
    assert paired_difference([1.0, 2.0], [1.0, 2.0]).p_value == 1.0
    assert paired_difference([2.0, 3.0], [1.0, 2.0]).p_value == 0.5  # two coins that fall alike
    assert all(map(math.isnan, paired_difference([2.0, 3.0], [1.0, 2.0]).interval()))
    assert paired_difference([1.0, 2.0], [1.0, 2.0]).interval() == (0.0, 0.0)
    # Equal shares of few lanes, which differ by the rounding of their subtraction.
    same = paired_difference([0.5, 0.8, 0.3], [0.4, 0.7, 0.2])
    assert (same.mean, same.std, same.p_value, same.better) == (pytest.approx(0.1), 0.0, 0.25, 3)
    none = paired_difference([0.1 + 0.2, 0.4, 0.5], [0.3, 0.4, 0.5])
    assert (none.std, none.p_value, none.better) == (0.0, 1.0, 0)


@pytest.mark.parametrize(("a", "b"), [([], []), ([1.0], [1.0, 2.0])])
def test_empty_or_unequal_numbers_cannot_be_paired(a, b):
    with pytest.raises(ValueError, match="as many numbers"):
        paired_difference(a, b)


def test_holm_by_hand():
    # Holm's own arithmetic: 4 x 0.01, 3 x 0.02, then 2 x 0.02 and 1 x 0.05, each at least as large as the one before.
    assert holm([0.02, 0.05, 0.01, 0.02]) == pytest.approx([0.06, 0.06, 0.04, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([0.03]) == [0.03]
    assert holm([]) == []


def test_holm_rejects_what_the_step_down_procedure_rejects():
    rng = np.random.default_rng(3)
    for _ in range(200):
        p = rng.choice([0.001, 0.01, 0.02, 0.03, 0.04, 0.2, 0.9], size=rng.integers(1, 8))
        left, rejected = list(np.argsort(p, kind="stable")), set()
        while left and p[left[0]] <= 0.05 / len(left):
            rejected.add(int(left.pop(0)))
        assert {i for i, q in enumerate(holm(p)) if q <= 0.05} == rejected


def test_missing_tests_do_not_count_in_the_correction():
    corrected = holm([0.01, math.nan, 0.04])
    assert math.isnan(corrected[1])
    assert [corrected[0], corrected[2]] == pytest.approx([0.02, 0.04])


def test_resampled_ratios_against_a_loop_over_drawn_scenes():
    rng = np.random.default_rng(0)
    lanes = rng.integers(0, 9, 12)
    found = np.stack([rng.binomial(lanes, fraction) for fraction in (0.3, 0.5, 0.6)])
    weights = scene_weights(12, 50, seed=3)
    expected = []
    for times in weights:
        drawn = [scene for scene, count in enumerate(times) for _ in range(count)]
        assert len(drawn) == 12
        expected.append(np.mean([seed[drawn].sum() / lanes[drawn].sum() for seed in found]))
    np.testing.assert_allclose(resampled_ratio(found, lanes, weights), expected)
    # Every scene once: the ratio itself.
    whole = resampled_ratio(found, lanes, np.ones((1, 12), int))
    np.testing.assert_allclose(whole, found.sum() / 3 / lanes.sum())


def test_samples_without_anything_to_count_say_nothing():
    """Regression: recall 0 and, by the official convention, DET_l 1 counted as draws of the score."""
    lanes, none = np.array([3, 0, 0, 1, 0]), np.zeros(5, int)
    weights = scene_weights(5, 400)
    empty = nothing_drawn(lanes, weights)
    assert 15 < empty.sum() < 50  # (3/5)^5 of them
    samples = resampled_ratio(np.array([[2, 0, 0, 1, 0]]), lanes, weights)
    assert np.isnan(samples).tolist() == empty.tolist()
    assert interval(samples) == pytest.approx((2 / 3, 1.0))
    # All that tells how little one scene says.
    assert interval(resampled_ratio(np.array([[2, 0, 0, 0, 0]]), np.array([3, 0, 0, 0, 0]), weights))[0] == 0.0
    assert not nothing_drawn(none, weights).any()
    assert not resampled_ratio(none[None], none, weights).any()
    assert all(map(math.isnan, interval(np.full(3, np.nan))))


def test_the_interval_of_a_mean_has_the_width_that_theory_gives():
    rng = np.random.default_rng(1)
    values = rng.integers(0, 100, 400)
    samples = resampled_ratio(values[None], np.ones(400, int), scene_weights(400, 10_000))
    low, high = interval(samples)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)
    assert low < values.mean() < high
    np.testing.assert_array_equal(scene_weights(5, 3), scene_weights(5, 3))


@pytest.mark.parametrize("shift", [0.0, 0.1, -0.15])
def test_the_corrected_interval_moves_by_twice_the_bias(shift):
    """Of normal samples with mean m and standard deviation s, z_0 = (value - m) / s: it is 2 value - m -+ 1.96 s."""
    samples = 0.2 * stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000) + shift
    expected = -shift + np.array([-1.0, 1.0]) * 1.96 * 0.2
    np.testing.assert_allclose(bias_corrected(np.append(samples, np.nan), 0.0), expected, atol=2e-3)
    if shift == 0.0:
        np.testing.assert_allclose(bias_corrected(samples, 0.0), interval(samples), atol=1e-4)


@pytest.mark.parametrize("samples", [[], [math.nan], [1.0, 2.0], [-1.0]])
def test_samples_on_one_side_of_the_value_have_no_corrected_interval(samples):
    assert all(map(math.isnan, bias_corrected(np.array(samples), 0.0)))


def test_samples_that_equal_the_value_count_half():
    assert bias_corrected(np.zeros(5), 0.0) == (0.0, 0.0)


def test_samples_without_anything_to_count_give_zero():
    ratio = resampled_ratio(np.array([[3, 0]]), np.array([4, 0]), np.array([[0, 2], [2, 0]]))
    np.testing.assert_allclose(ratio, [0.0, 0.75])


@pytest.mark.parametrize(("looks", "expected"), [((8,), 0.05), ((4, 8), 0.09), ((2, 4, 8), 0.13)])
def test_looks_before_the_last_seed_add_false_findings(looks, expected):
    """The rates of docs/comparisons.md, for rows that do not differ."""
    differences = np.random.default_rng(0).normal(size=(20_000, 8))
    found = [stats.ttest_1samp(differences[:, :seeds], 0.0, axis=1).pvalue < 0.05 for seeds in looks]
    assert np.mean(np.any(found, axis=0)) == pytest.approx(expected, abs=0.005)

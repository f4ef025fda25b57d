"""Paired tests over seeds, the correction of p-values for several tests, and bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

_ROUNDING = 1e-12  # of scores: 0.5 - 0.4 and 0.8 - 0.7 differ by 1e-16


@dataclass(frozen=True)
class PairedDifference:
    """Treatment minus control, seed by seed.

    Attributes:
        mean: of the differences.
        std: of the differences, with n - 1; NaN for a single seed.
        p_value: of the two-sided paired t-test for no difference; of the sign test if all seeds differ by the same
            number; NaN for a single seed.
        better: number of seeds in which the treatment is above the control.
        seeds: number of seeds.
    """

    mean: float
    std: float
    p_value: float
    better: int
    seeds: int

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the t interval of the mean difference over seeds.

        NaN for a single seed, and where all seeds differ by the same number, other than 0.
        """
        from scipy.stats import t

        if self.std == 0.0 and abs(self.mean) > _ROUNDING:
            return math.nan, math.nan
        half = float(t.ppf((1 + level) / 2, self.seeds - 1)) * self.std / math.sqrt(self.seeds)
        return self.mean - half, self.mean + half


def paired_difference(treatment: Float[np.ndarray, " s"], control: Float[np.ndarray, " s"]) -> PairedDifference:
    """Return the difference between treatment and control; entry i of both comes from the same seed.

    Raises ValueError for unequal lengths or empty input.
    """
    from scipy.stats import ttest_rel

    treatment, control = np.asarray(treatment, float), np.asarray(control, float)
    if treatment.shape != control.shape or treatment.ndim != 1 or len(treatment) == 0:
        raise ValueError(f"need as many numbers of both, got {treatment.shape} and {control.shape}")
    difference = treatment - control
    n, mean = len(difference), float(difference.mean())
    if n == 1:
        std = p_value = math.nan
    elif np.ptp(difference) <= _ROUNDING:
        # The t statistic is 0 / 0 for equal numbers and infinite for a constant shift, which scores of counts can
        # have by chance: the sign test judges it.
        std, p_value = 0.0, 1.0 if abs(mean) <= _ROUNDING else 2.0 ** (1 - n)
    else:
        std, p_value = float(difference.std(ddof=1)), float(ttest_rel(treatment, control).pvalue)
    return PairedDifference(mean, std, p_value, int((difference > _ROUNDING).sum()), n)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for several tests by Holm's step-down procedure (Holm 1979).

    With the m p-values in ascending order, p_(i) becomes max_{j <= i} min(1, (m - j + 1) p_(j)), i and j from 1. The
    probability of any false rejection at level a is then at most a, whatever the dependence between the tests.

    Args:
        p_values: NaN, a test that could not be made, stays NaN and does not count in m.
    """
    values = np.asarray(p_values, float)
    tested = np.flatnonzero(~np.isnan(values))
    order = tested[np.argsort(values[tested], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    corrected = np.full(values.shape, math.nan)
    corrected[order] = np.maximum.accumulate(np.minimum(factors * values[order], 1.0))
    return corrected.tolist()


def resampled_ratio(
    numerators: Float[np.ndarray, "s c"], denominator: Int[np.ndarray, " c"], weights: Int[np.ndarray, "b c"]
) -> Float[np.ndarray, " b"]:
    """Return a ratio of sums over scenes, such as recall, in each bootstrap sample; the mean over seeds.

    Args:
        numerators: of each seed and scene.
        denominator: of each scene; the same for all seeds.
        weights: how often each scene is drawn, see `evaluation.by_scene`.

    Returns:
        Ratios; NaN where `nothing_drawn`, 0 where no scene has anything to count.
    """
    total = weights @ np.asarray(denominator)
    ratios = weights @ np.asarray(numerators).mean(0) / np.maximum(total, 1)
    return np.where(nothing_drawn(denominator, weights), np.nan, ratios)


def nothing_drawn(counted: ArrayLike, weights: Int[np.ndarray, "b c"]) -> Bool[np.ndarray, " b"]:
    """Return which bootstrap samples hold none of what is counted in the scenes, although several scenes have it.

    What a score is by convention where there is nothing to find, 0 or 1, would say nothing about its uncertainty. Where
    a single scene has it, such samples stay: the others are all alike, and would make one scene look certain.

    Args:
        counted: of each scene, such as its number of lanes of a group.
        weights: how often each scene is drawn.
    """
    counted = np.asarray(counted)
    return (weights @ counted == 0) & (np.count_nonzero(counted) > 1)


def interval(samples: Float[np.ndarray, " b"], level: float = 0.95) -> tuple[float, float]:
    """Return the percentile interval of bootstrap samples; those that are NaN do not count. NaN without any."""
    samples = samples[~np.isnan(samples)]
    if len(samples) == 0:
        return math.nan, math.nan
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def bias_corrected(samples: Float[np.ndarray, " b"], value: float, level: float = 0.95) -> tuple[float, float]:
    """Return the bias-corrected percentile interval of bootstrap samples (Efron 1981).

    Its ends are the quantiles at Phi(2 z_0 + z) with z = -+Phi^-1((1 + level) / 2), where Phi(z_0) is the fraction of
    samples below the value: one half without bias, which gives the percentile interval. NaN where all samples lie on
    one side of the value; samples that are NaN do not count.

    Args:
        samples: of a statistic.
        value: the statistic itself.
    """
    from scipy.stats import norm

    samples = samples[~np.isnan(samples)]
    below = (np.mean(samples < value) + np.mean(samples <= value)) / 2 if len(samples) else 0.0
    if not 0 < below < 1:
        return math.nan, math.nan
    ends = norm.cdf(2 * norm.ppf(below) + norm.ppf([(1 - level) / 2, (1 + level) / 2]))
    low, high = np.quantile(samples, ends)
    return float(low), float(high)

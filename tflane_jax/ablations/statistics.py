"""What a difference over a few seeds is worth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class PairedDifference:
    """Treatment less control, seed by seed.

    Attributes:
        mean: of the differences.
        std: of the differences, n - 1; NaN for a single seed.
        p_value: two-sided paired t-test of "no difference"; NaN for a single seed.
        better: in how many seeds the treatment is above the control.
        seeds: how many there are.
    """

    mean: float
    std: float
    p_value: float
    better: int
    seeds: int


def paired_difference(treatment: Float[np.ndarray, " s"], control: Float[np.ndarray, " s"]) -> PairedDifference:
    """Return how treatment and control differ; entry i of both comes from the same seed.

    Raises ValueError for unequal lengths or none at all.
    """
    from scipy.stats import ttest_rel

    treatment, control = np.asarray(treatment, float), np.asarray(control, float)
    if treatment.shape != control.shape or treatment.ndim != 1 or len(treatment) == 0:
        raise ValueError(f"need as many numbers of both, got {treatment.shape} and {control.shape}")
    difference = treatment - control
    n, mean = len(difference), float(difference.mean())
    if n == 1:
        std = p_value = math.nan
    elif np.ptp(difference) == 0.0:
        # The t statistic is 0 / 0 or infinite: equal numbers say nothing, a constant shift says all.
        std, p_value = 0.0, 1.0 if mean == 0.0 else 0.0
    else:
        std, p_value = float(difference.std(ddof=1)), float(ttest_rel(treatment, control).pvalue)
    return PairedDifference(mean, std, p_value, int((difference > 0).sum()), n)

"""Intervals over scenes: the bootstrap samples that all runs share, and where there are none."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.ablations.effect_cases import DIFFERENCE, PRIMARY, SEEDS
from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.ablations.effects import effects
from tflane_jax.ablations.findings import sentence
from tflane_jax.ablations.recorded import Measured
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.statistics import nothing_drawn
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import scene_weights
from tflane_jax.evaluation.results import SceneRatio, SceneSamples


def ranked(values, *, ways=("",), lanes=(9, 9, 9)):
    """Return a measurement of a score in four samples, and of a ratio over the same scenes."""
    sample, ratio = SceneSamples(lanes, tuple(values)), SceneRatio((3, 0, 6), lanes)
    scores = {"all/mAP": float(np.mean(values)), "all/recall": 1 / 3}
    kept = {way: {"all/mAP": sample} for way in ways}
    return Measured(
        1, "a protocol", dict.fromkeys(ways, scores), {way: {"all/recall": ratio} for way in ways}, "", kept
    )


def of_pairs(*pairs):
    """Return results of a baseline and a treatment, seed by seed."""
    found = Results(("baseline", "+TFM"), tuple(range(len(pairs))), {})
    for seed, pair in enumerate(pairs):
        for model, measurement in zip(found.models, pair, strict=True):
            found.add("", "last", model, seed, measurement)
    return found


def test_ranked_scores_are_compared_in_the_samples_that_all_runs_share():
    rng = np.random.default_rng(0)
    before, gain = rng.uniform(0.2, 0.8, (4, 400)), rng.normal(0.05, 0.01, (4, 400))
    found = of_pairs(*((ranked(b), ranked(b + g)) for b, g in zip(before, gain, strict=True)))
    (effect,) = effects(found, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")
    # The rows differ by far more between samples than from each other in one.
    low, high = np.quantile(gain.mean(0), [0.025, 0.975])
    assert (effect.low, effect.high) == (pytest.approx(low), pytest.approx(high))
    assert 0 < effect.low < effect.difference < effect.high
    assert effect.finding == "shown"
    assert "95 %" in sentence([effect])
    assert "seeds alone" not in sentence([effect])


def test_the_correction_for_bias_is_about_the_score_of_all_scenes():
    gain = np.random.default_rng(0).normal(0.05, 0.01, 400)
    found = of_pairs(*((ranked(0 * gain), ranked(gain + 1e-4 * seed)) for seed in range(4)))
    for seed, scores in found.rows("", "last")["+TFM"].items():
        scores["all/mAP"] = 0.04 + 1e-4 * seed  # samples are 0.01 too high on average
    (effect,) = effects(found, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")
    assert effect.bias_corrected == (
        pytest.approx(effect.low - 0.02, abs=3e-3),
        pytest.approx(effect.high - 0.02, abs=3e-3),
    )


def test_an_effect_that_some_samples_lack_is_not_shown():
    gain = np.linspace(-0.01, 0.05, 400)
    found = of_pairs(*((ranked(0.3 + 0 * gain), ranked(0.3 + gain + 1e-4 * seed)) for seed in range(4)))
    (effect,) = effects(found, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")
    assert effect.p_holm < 0.01
    assert (effect.low < 0, effect.finding) == (True, "not shown")


def test_a_ratio_and_a_ranked_score_are_drawn_alike():
    values = 0.2 + 0.001 * np.arange(400)
    found = of_pairs((ranked(values), ranked(values + 0.1)), (ranked(values), ranked(values + 0.3)))
    declaration = Declaration("all/mAP", (Claim("+TFM"),), "all/recall")
    effect = effects(found, declaration, "", "last")[-1]
    assert effect.measure == DIFFERENCE
    assert (effect.low, effect.high) == (pytest.approx(0.2), pytest.approx(0.2))  # recall is the same in every sample


def test_samples_without_lanes_of_the_group_are_no_draws():
    lanes = (9, 0, 0, 9)
    empty = nothing_drawn(lanes, scene_weights(4, 400))  # by convention both rows have 1 there
    found = of_pairs([ranked(np.where(empty, 1.0, value), lanes=lanes) for value in (0.4, 0.6)])
    (effect,) = effects(found, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")
    assert (effect.low, effect.high) == (pytest.approx(0.2), pytest.approx(0.2))


def test_a_row_measured_by_an_earlier_program_takes_the_interval_away():
    values = 0.3 + 0.001 * np.arange(400)
    old = replace(ranked(values + 0.1), samples={})
    found = of_pairs((ranked(values), ranked(values + 0.1)), (ranked(values), old))
    (effect,) = effects(found, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")
    assert math.isnan(effect.low)
    assert "decided by seeds alone" in sentence([effect])


@pytest.mark.parametrize("change", [{"lanes": (9, 9, 8)}, {"values": (0.5,) * 300}])
def test_samples_of_other_scenes_are_refused(change):
    values = (0.5,) * 400
    found = of_pairs((ranked(values), ranked(**({"values": values} | change))))
    with pytest.raises(UserError, match="not measured on the same lanes"):
        effects(found, Declaration("all/mAP", (Claim("+TFM"),)), "", "last")


def test_one_scene_has_no_interval():
    """Regression: all samples are alike, and their interval without width was taken for certainty."""
    found = Results(("baseline", "+TFM"), SEEDS, {})
    for seed in SEEDS:
        for model, hits in (("baseline", 10), ("+TFM", 14 + seed % 2)):
            ratio = {"": {PRIMARY: SceneRatio((hits,), (40,))}}
            found.add("", "last", model, seed, Measured(1, "a protocol", {"": {PRIMARY: hits / 40}}, ratio))
    (effect,) = effects(found, Declaration(PRIMARY, (Claim("+TFM"),)), "", "last")
    assert math.isnan(effect.low)
    assert "decided by seeds alone" in sentence([effect])

"""Results made by hand, whose effects are known."""

import numpy as np

from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.ablations.recorded import Measured
from tflane_jax.ablations.results import Results
from tflane_jax.evaluation.results import SceneRatio

SCENES, SEEDS = 40, (0, 1, 2, 3)
PRIMARY, CONTROL = "hidden+traffic/recall", "hidden-traffic/recall"
NEGATIVE, DIFFERENCE = f"negative control {CONTROL}", "difference of the two"
DECLARED = Declaration(PRIMARY, (Claim("+TFM"),), CONTROL)
LANES = {name: np.random.default_rng([7, i]).integers(0, 20, SCENES) for i, name in enumerate((PRIMARY, CONTROL))}


def measured(seed, **ways):
    """Return a measurement whose recall is about that given for each way: (primary, control)."""
    scores, ratios = {}, {}
    for way, recalls in ways.items():
        rng = np.random.default_rng([seed, *(round(1000 * recall) for recall in recalls)])
        way = "" if way == "own" else way
        scores[way], ratios[way] = {}, {}
        for name, recall in zip((PRIMARY, CONTROL), recalls, strict=True):
            found, lanes = rng.binomial(LANES[name], recall), LANES[name]
            ratios[way][name] = SceneRatio(tuple(found.tolist()), tuple(lanes.tolist()))
            scores[way][name] = found.sum() / lanes.sum()
        scores[way]["all/AP_l"] = 0.5 + 0.01 * rng.random()
    return Measured(4, "a protocol", scores, ratios)


def made_results():
    """The treatment finds more lanes with traffic, and as many without; taking the traffic away undoes it."""
    found = Results(("baseline", "+TFM", "matched"), SEEDS, {})
    for which in ("last", "best"):
        for seed in SEEDS:
            found.add("", which, "baseline", seed, measured(seed, own=(0.3, 0.3)))
            found.add("", which, "+TFM", seed, measured(seed, own=(0.6, 0.3), none=(0.2, 0.3)))
            found.add("", which, "matched", seed, measured(seed, own=(0.31, 0.3), none=(0.9, 0.9)))
    return found

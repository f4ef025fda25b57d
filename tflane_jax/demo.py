"""`tflane demo`: a small comparison on the built-in world, for two cores and ten minutes.

The small host of docs/small_models.md is trained twice on the preset `street`, on BEV evidence alone and with traffic
flow. Both are evaluated on unseen scenes. One training of each is no evidence: the papers' tables (`tflane tables`)
have several seeds, controls and tests.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from tflane_jax.ablations.compare import compare
from tflane_jax.ablations.declaration import Claim, Declaration
from tflane_jax.ablations.effects import Effect, effects
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import OWN_TEST
from tflane_jax.config import EvaluationConfig, RunConfig, WorldData, load_config
from tflane_jax.evaluation.interventions import NO_TRAFFIC
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.plots.tables import format_table
from tflane_jax.training.loop import TrainingConfig

STEPS = 1500
EXPERIMENT = "tflane tables tf_lane.2 --jobs 2"
_INTRODUCTION = """\
Lanes around a vehicle on the built-in world, preset `street`, learned twice:
  baseline  from what the sensor shows (BEV evidence)
  +traffic  also from the tracks of other road users, in the queries (TF-Lane's module) and in the BEV features
The scenes are made first; then both trainings run side by side."""
_BASELINE, _TREATMENT = "baseline", "+traffic"
_BLIND = f"{_TREATMENT}, {NO_TRAFFIC}"
_COLUMNS = {_BASELINE: _BASELINE, _TREATMENT: _TREATMENT, _BLIND: "+traffic, none at inference"}
_DECLARED = Declaration("hidden+traffic/recall", (Claim(_TREATMENT),), "hidden-traffic/recall")
_LANES = {
    "all/recall": "all",
    _DECLARED.primary: "hidden, vehicles drove along them",
    _DECLARED.negative_control: "hidden, no vehicle came near",
}


def configs() -> dict[str, RunConfig]:
    """Return the demo's two configurations: shipped ones with fewer scenes and steps."""
    return {
        _BASELINE: _short(load_config("tf_lane/toponet:street")),
        _TREATMENT: _short(load_config("tf_lane/toponet_tfm:street_bev")),
    }


def _short(config: RunConfig) -> RunConfig:
    return replace(
        config,
        data=WorldData.street(train=500, val=10, test=60),
        training=TrainingConfig(steps=STEPS, batch_size=4, log_every=25, eval_every=STEPS, checkpoint_every=500),
        evaluation=EvaluationConfig(pictures=0),
    )


def main(out: Path) -> int:
    """Run the demo into a folder; finished runs in it are used."""
    print(_INTRODUCTION)
    compare(configs(), (0,), out, parallel=2, summary=summary)
    print(f"\nWhere the two differ, with the lanes that only one of them finds: {out / 'comparison.png'}")
    print(f"With eight seeds and controls, hours on two cores (docs/tf_lane_results.md has them):\n\n{EXPERIMENT}")
    return 0


def summary(results: Results) -> str:
    """Return the table of the demo and what it shows, from the models' last step on the test split."""
    table, ratios = results.rows(OWN_TEST, "last"), results.ratios[OWN_TEST, "last"]
    (seed,) = results.seeds
    rows = []
    for score, lanes in _LANES.items():
        number = sum(ratios[_BASELINE][seed][score].denominator) // len(LANE_THRESHOLDS)
        found = {name: 100.0 * table[row][seed][score] for row, name in _COLUMNS.items()}
        rows.append({"true lanes": lanes, "number": number} | found)
    scenes = len(ratios[_BASELINE][seed]["all/recall"].denominator)
    within = ", ".join(f"{threshold:g}" for threshold in LANE_THRESHOLDS)
    title = (
        f"Percent of the true lanes that each model finds on {scenes} unseen scenes (recall, mean over {within} m).\n"
        "Hidden: along more than half of the lane, the sensor shows neither of its borders."
    )
    gain, control = (_effect(results, _BASELINE, measure) for measure in ("primary", "control"))
    use = _effect(results, _BLIND, "primary")
    lines = [
        f"Of the hidden lanes that vehicles drove along, {_TREATMENT} finds {_points(gain)} than the baseline",
        f"(95 % interval over scenes: {_interval(gain)}), and {_points(use)} than itself without traffic at inference.",
        f"Where no vehicle came near (the control), {_points(control)} than the baseline ({_interval(control)}).",
        "This is one training of each, an example and no evidence: another seed changes these numbers by some points.",
    ]
    return "\n".join(["", format_table(rows, title=title, digits=1), "", *lines])


def _effect(results: Results, row: str, measure: Literal["primary", "control"]) -> Effect:
    """Return what the treatment gains over another row, in the primary measure or in the negative control."""
    primary, control, _ = (effect for effect in effects(results, _DECLARED, OWN_TEST, "last") if effect.row == row)
    return primary if measure == "primary" else control


def _points(effect: Effect) -> str:
    return f"{abs(100 * effect.difference):.1f} points {'more' if effect.difference >= 0 else 'less'}"


def _interval(effect: Effect) -> str:
    return f"{100 * effect.low:+.1f} to {100 * effect.high:+.1f}"

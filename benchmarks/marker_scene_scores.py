"""Tables of `marker_scenes`: scores of each model, and what the boards change, with intervals over scenes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.timing import markdown_table
from tflane_jax.ablations.statistics import interval, resampled_ratio
from tflane_jax.evaluation.by_scene import scene_weights
from tflane_jax.evaluation.lane_graph import Sightings
from tflane_jax.evaluation.results import SceneRatio

SCORES = ("recall", "DET_l", "TOP_ll")
SAMPLES = 10_000


def scores_table(scores: Mapping[str, Mapping[str, Mapping[str, float]]], count: Mapping[str, int]) -> str:
    """Return a row for each group of frames and model, in percent; groups without frames are left out.

    Args:
        scores: by model, group and name.
        count: of the frames of each group.
    """
    groups = {"all": sum(count.values())} | {group: n for group, n in count.items() if n}
    rows = [
        [group, str(n), name, *(f"{100 * of_model[group][score]:.1f}" for score in SCORES)]
        for group, n in groups.items()
        for name, of_model in scores.items()
    ]
    return markdown_table(["frames", "number", "model", *SCORES], rows)


def differences(ratios: Mapping[str, Mapping[str, SceneRatio]], model: str) -> list[dict[str, str | int | float]]:
    """Return how much the recall of a model is above that of each other one, by group of frames.

    The intervals are of paired bootstraps over scenes; groups without lanes are left out.

    Args:
        ratios: by model, then by "group/score", as of `LaneGraphMetrics.ratios`.
        model: whose recall is compared.
    """
    found: list[dict[str, str | int | float]] = []
    for group in ("all", *Sightings.groups):
        own = ratios[model].get(f"{group}/recall")
        if own is None or not sum(own.denominator):
            continue
        lanes = np.array(own.denominator)
        weights = scene_weights(len(lanes), SAMPLES)
        for name in ratios.keys() - {model}:
            other = ratios[name][f"{group}/recall"]
            more = np.subtract(own.numerator, other.numerator, dtype=float)
            low, high = interval(resampled_ratio(more[None], lanes, weights))
            numbers = {"scenes": int((lanes > 0).sum()), "difference": float(more.sum() / lanes.sum())}
            found.append({"frames": group, "against": name} | numbers | {"low": low, "high": high})
    return found


def differences_table(found: list[dict[str, str | int | float]]) -> str:
    """Return `differences` as a table, in points of recall."""
    rows = [
        [str(row["frames"]), str(row["scenes"]), str(row["against"])]
        + [f"{100 * float(row[name]):+.1f}" for name in ("difference", "low", "high")]
        for row in found
    ]
    return markdown_table(["frames", "scenes", "recall with boards, against", "points", "95 % from", "to"], rows)

"""How `tflane eval` measures where its options say otherwise than the run."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.models.host import HostConfig
from tflane_jax.runs import Run

Needs = tuple[Callable[[HostConfig], bool], str]

_CHOICES: dict[str, Needs] = {
    "traffic": (
        lambda host: host.priors.traffic_flow is not None,
        "changes the traffic flow that a model sees, and this model takes none",
    ),
    "topology": (
        lambda host: not {"centerlines", "segments"}.isdisjoint(host.predicts),
        "is about which lane follows which, and this model does not predict it",
    ),
    "versions": (
        lambda host: "centerlines" in host.predicts,
        "are those of OpenLane-V2's metrics of centerlines, and this model predicts none",
    ),
    "map_measures": (
        lambda host: "lines" in host.predicts,
        "are those of the lines of a vector map, and this model predicts none",
    ),
}
"""By the setting of `EvaluationConfig`, which is also the name of the option: what it needs, and else the message."""


def with_chosen_evaluation(run: Run, options: argparse.Namespace) -> Run:
    """Return the run measured as the options say; raise UserError for one that does not concern its model."""
    chosen: dict[str, Any] = {}
    for name, (concerns, message) in _CHOICES.items():
        if (value := getattr(options, name)) is None:
            continue
        model = getattr(run.config.task, "model", None)
        if not isinstance(model, HostConfig) or not concerns(model):
            raise UserError(f"--{name.replace('_', '-')} {message}")
        chosen[name] = tuple(dict.fromkeys(value)) if isinstance(value, list) else value
    return replace(run, config=replace(run.config, evaluation=replace(run.config.evaluation, **chosen)))


def evaluation_suffix(evaluation: EvaluationConfig, own: EvaluationConfig) -> str:
    """Return the end of the name of files with scores, so that tables that differ do not replace one another.

    Args:
        evaluation: as measured.
        own: of the run, before the options.
    """
    plain, suffix = EvaluationConfig(), ""
    for name in ("traffic", "topology"):
        if (value := getattr(evaluation, name)) != getattr(plain, name):
            suffix += f"-{name}_{value.replace('-', '_')}"
    for name in ("versions", "map_measures"):
        if (values := getattr(evaluation, name)) != getattr(own, name):
            suffix += f"-{'_'.join(values)}"
    return suffix

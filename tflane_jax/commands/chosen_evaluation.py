"""How `tflane eval` measures where its options say otherwise than the run."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.models.host import HostConfig
from tflane_jax.runs import Run


@dataclass(frozen=True)
class _Option:
    """An option of `tflane eval` that only some models have a use for.

    Attributes:
        concerns: whether it has an effect on a model.
        refusal: what to say to other models; the name of the option stands before it.
    """

    concerns: Callable[[HostConfig], bool]
    refusal: str


_OPTIONS: dict[str, _Option] = {
    "traffic": _Option(
        lambda host: host.priors.traffic_flow is not None,
        "changes the traffic flow that a model sees, and this model takes none",
    ),
    "topology": _Option(
        lambda host: not {"centerlines", "segments"}.isdisjoint(host.predicts),
        "is about which lane follows which, and this model does not predict it",
    ),
    "versions": _Option(
        lambda host: "centerlines" in host.predicts,
        "are those of OpenLane-V2's metrics of centerlines, and this model predicts none",
    ),
    "map_measures": _Option(
        lambda host: "lines" in host.predicts,
        "are those of the lines of a vector map, and this model predicts none",
    ),
}
"""By the setting of `EvaluationConfig` that the option of the same name sets."""


def with_chosen_evaluation(run: Run, options: argparse.Namespace) -> Run:
    """Return the run measured as the options say; raise UserError for one that does not concern its model."""
    chosen: dict[str, Any] = {}
    for name, option in _OPTIONS.items():
        if (value := getattr(options, name)) is None:
            continue
        model = getattr(run.config.task, "model", None)
        if not isinstance(model, HostConfig) or not option.concerns(model):
            raise UserError(f"--{name.replace('_', '-')} {option.refusal}")
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

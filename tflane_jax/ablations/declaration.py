"""What a comparison tests, written down in its folder before the runs.

The file is never changed. A comparison with another declaration needs another folder; one that was declared when runs
existed already says so in its report.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.config import RunConfig
from tflane_jax.config_io import first_difference
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.files.fields import load_json
from tflane_jax.training.provenance import provenance

FILE = "declaration.json"


@dataclass(frozen=True)
class Claim:
    """A row is better than another one in the primary measure.

    Attributes:
        treatment: row whose effect is tested: a model, or "model, intervention".
        control: row that it is compared with; None for every other model, and the interventions on the treatment.
        text: what a paper claims, in words; "" for none.
    """

    treatment: str
    control: str | None = None
    text: str = ""


@dataclass(frozen=True)
class Declaration:
    """What is tested: claims about rows, on one score.

    Attributes:
        primary: the score ("group/name") that decides.
        claims: what is claimed; Holm's correction is over all of them.
        negative_control: score on which no treatment should change anything; None for none.
        alpha: significance level of the corrected tests.
    """

    primary: str
    claims: tuple[Claim, ...]
    negative_control: str | None = None
    alpha: float = 0.05

    @property
    def scores(self) -> tuple[str, ...]:
        """The scores that are tested."""
        return (self.primary,) if self.negative_control is None else (self.primary, self.negative_control)


@dataclass(frozen=True)
class Declared:
    """A declaration as the comparison's folder records it.

    Attributes:
        declaration: what is tested.
        seeds: that were declared; the comparison may have fewer so far.
        time: when it was written, ISO 8601.
        begun: number of runs that existed in the folder at that time.
    """

    declaration: Declaration
    seeds: tuple[int, ...]
    time: str
    begun: int

    def sentence(self) -> str:
        """Return what was declared, and when."""
        what = f"primary measure {self.declaration.primary}"
        if self.declaration.negative_control is not None:
            what += f", negative control {self.declaration.negative_control}"
        when = "before any run" if self.begun == 0 else f"when {self.begun} runs had begun already"
        treatments = ", ".join(dict.fromkeys(claim.treatment for claim in self.declaration.claims))
        return (
            f"Declared {when} ({self.time}): {what}, treatment {treatments}, "
            f"level {self.declaration.alpha:g}, {len(self.seeds)} seeds."
        )


def check(declaration: Declaration, configs: Mapping[str, RunConfig]) -> None:
    """Raise UserError for a score that is not measured, or a claim about rows that there are not."""
    for claim in declaration.claims:
        _check_claim(claim, list(configs))
    for name, config in configs.items():
        known = config.task.score_names(config.data, config.evaluation)
        for score in declaration.scores:
            if score not in known:
                listed = ", ".join(sorted(score for score in known if "@" not in score))
                raise UserError(f"{name} is not measured by {score}, only by {listed}")
    if declaration.primary == declaration.negative_control:
        raise UserError(f"{declaration.primary} cannot be primary measure and negative control")
    if not 0.0 < declaration.alpha < 1.0:
        raise UserError(f"--alpha {declaration.alpha:g} is no significance level between 0 and 1")


def _check_claim(claim: Claim, models: Sequence[str]) -> None:
    control, *others = models
    if claim.control is None and claim.treatment not in others:
        names = ", ".join(others) or "none"
        raise UserError(
            f"--treatment {claim.treatment} is compared with the other configurations, the first of which "
            f"({control}) is the control: choose one of the others ({names})"
        )
    for row in (claim.treatment, claim.control):
        # An intervention, "model, intervention", is known only when its model was evaluated.
        if row is not None and not any(row == model or row.startswith(f"{model}, ") for model in models):
            raise UserError(f"a claim is about {row}, which is none of the models ({', '.join(models)})")


def declare(declaration: Declaration, plan: Mapping[str, Sequence[Job]], seeds: Sequence[int], out: Path) -> Declared:
    """Write the declaration into the comparison's folder, unless it is there already, and return it.

    Raises:
        UserError: the folder holds another declaration, or one of other models or without some of the seeds.
    """
    claims = [asdict(claim) for claim in declaration.claims]
    path, wanted = out / FILE, asdict(declaration) | {"claims": claims, "models": list(plan)}
    found: dict[str, Any] = {}
    if path.exists():
        found = _read(path)
    if not found:
        source = provenance()
        begun = sum(job.start() == "resume" for planned in plan.values() for job in planned)
        found = wanted | {"seeds": list(seeds), "begun": begun} | {name: source[name] for name in ("time", "git")}
        out.mkdir(parents=True, exist_ok=True)
        write_json(path, found)
    declared = Declared(declaration, tuple(found["seeds"]), found["time"], found["begun"])
    difference = first_difference({name: found[name] for name in wanted}, wanted)
    if not difference and (more := sorted(set(seeds) - set(declared.seeds))):
        difference = f"seed {more[0]} was not declared"
    if difference:
        raise UserError(f"{path} holds another declaration ({difference}): choose another folder with --out")
    return declared


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a declaration file; raises UserError that names it where something is missing."""
    remedy = "restore it, or choose another folder with --out"
    try:
        found = _current_form(dict(load_json(path)))
    except (TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: it holds no declaration; {remedy}") from error
    names = [field.name for field in dataclasses.fields(Declaration)]
    kinds = {"seeds": list, "time": str, "begun": int, "models": list} | dict.fromkeys(names, object)
    if wrong := [name for name, kind in kinds.items() if name not in found or not isinstance(found[name], kind)]:
        raise UserError(f"{path} is damaged ({wrong[0]}); {remedy}")
    return found


def _current_form(found: dict[str, Any]) -> dict[str, Any]:
    """Return a declaration file's content with claims; files of an earlier form name one treatment."""
    if "treatment" in found:
        found["claims"] = [asdict(Claim(found.pop("treatment")))]
    return found

"""What a comparison tests, written down in its folder before the runs.

The file is never changed, except that an equal, earlier one of the table's record takes its place. It holds the
configuration of every row, so that a comparison of other ones needs another folder, as does one with another
declaration. One that was declared when runs existed already says so in its report.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.config import RunConfig
from tflane_jax.config_io import first_difference, to_json
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.files.fields import load_json
from tflane_jax.files.wording import counted
from tflane_jax.runs import current_form
from tflane_jax.training.provenance import provenance

FILE = "declaration.json"

# What files of earlier versions lack.
_SECONDARY, _CONFIGURATIONS = "secondary", "configurations"


@dataclass(frozen=True)
class Reported:
    """A difference that a paper reports, of its own data.

    Attributes:
        difference: treatment minus control, points.
        measure: the paper's name of it, such as "DET_l".
        decimals: that the paper prints.
    """

    difference: float
    measure: str
    decimals: int = 1

    def __str__(self) -> str:
        return f"{self.difference:+.{self.decimals}f} {self.measure}"


@dataclass(frozen=True)
class Claim:
    """A row is better than another one in the primary measure.

    Attributes:
        treatment: row whose effect is tested: a model, or "model, intervention".
        control: row that it is compared with; None for every other model, and the interventions on the treatment.
        text: what a paper claims, in words; "" for none.
        paper: what it reports, which the words quote; () for no number.
    """

    treatment: str
    control: str | None = None
    text: str = ""
    paper: tuple[Reported, ...] = ()


@dataclass(frozen=True)
class Declaration:
    """What is tested: claims about rows, on one score.

    Attributes:
        primary: the score ("group/name") that decides.
        claims: what is claimed; Holm's correction is over all of them.
        negative_control: score on which no treatment should change anything; None for none.
        alpha: significance level of the corrected tests.
        secondary: score that is tested as well, corrected apart from the primary one; None for none.
    """

    primary: str
    claims: tuple[Claim, ...]
    negative_control: str | None = None
    alpha: float = 0.05
    secondary: str | None = None

    @property
    def scores(self) -> tuple[str, ...]:
        """The scores that are tested."""
        return tuple(score for score in (self.primary, self.secondary, self.negative_control) if score is not None)


@dataclass(frozen=True)
class Declared:
    """A declaration as the comparison's folder records it.

    Attributes:
        declaration: what is tested.
        seeds: that were declared; the comparison may have fewer so far.
        time: when it was written, ISO 8601.
        begun: number of runs that existed in the folder at that time.
        logs: recorded logs that were declared; the comparison may have fewer so far.
        missing: what a file of an earlier version does not hold, of "secondary" and "configurations".
    """

    declaration: Declaration
    seeds: tuple[int, ...]
    time: str
    begun: int
    logs: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def sentence(self) -> str:
        """Return what was declared, and when."""
        what = f"primary measure {self.declaration.primary}"
        if self.declaration.secondary is not None:
            late = " (added later, not declared)" if _SECONDARY in self.missing else ""
            what += f", secondary measure {self.declaration.secondary}{late}"
        if self.declaration.negative_control is not None:
            what += f", negative control {self.declaration.negative_control}"
        when = "before any run" if self.begun == 0 else f"when {counted(self.begun, 'run')} had begun already"
        names = dict.fromkeys(claim.treatment for claim in self.declaration.claims)
        treatments = ", ".join(f'"{name}"' if "," in name else name for name in names)
        what += f", treatment {treatments}" if names else ", no claim"
        text = f"Declared {when} ({self.time}): {what}, level {self.declaration.alpha:g}, "
        text += f"{counted(len(self.seeds), 'seed')}."
        if _CONFIGURATIONS in self.missing:
            text += " This declaration of an earlier version holds no configurations: those of the rows may be later."
        return text

    def interim(self, seeds: Sequence[int], logs: Sequence[str] = ()) -> str:
        """Return a sentence for a comparison of fewer seeds or logs than were declared; "" for one of all."""
        parts = []
        if set(seeds) != set(self.seeds):
            parts.append(f"{len(seeds)} of {len(self.seeds)} declared seeds ({', '.join(map(str, seeds))})")
        if set(logs) != set(self.logs):
            parts.append(f"{len(logs)} of {len(self.logs)} declared logs ({', '.join(logs)})")
        return f"**Interim**: {' and '.join(parts)}." if parts else ""


def check(declaration: Declaration, configs: Mapping[str, RunConfig]) -> None:
    """Raise UserError for a score that is not measured, or a claim about a missing row."""
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
    if declaration.secondary in (declaration.primary, declaration.negative_control) and declaration.secondary:
        raise UserError(f"{declaration.secondary} cannot be the secondary measure: it is tested already")
    if not 0.0 < declaration.alpha < 1.0:
        raise UserError(f"--alpha {declaration.alpha:g} is no significance level between 0 and 1")


def model_of_row(row: str, models: Iterable[str]) -> str:
    """Return the model that a row "model" or "model, intervention" is about; "" if it is none of `models`."""
    return max((model for model in models if row == model or row.startswith(f"{model}, ")), key=len, default="")


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
        if row is not None and not model_of_row(row, models):
            raise UserError(f"a claim is about {row}, which is none of the models ({', '.join(models)})")


def declare(
    declaration: Declaration,
    plan: Mapping[str, Sequence[Job]],
    configs: Mapping[str, RunConfig],
    seeds: Sequence[int],
    out: Path,
    *,
    logs: Sequence[str] = (),
    content: Mapping[str, str] | None = None,
) -> Declared:
    """Write the declaration into the comparison's folder, unless it is there already, and return it.

    Args:
        declaration: what is tested.
        plan: the trainings of each row.
        configs: of the rows, and of what they start from, by name; the seeds in them do not matter.
        seeds: of the comparison; fewer than were declared are an interim look.
        out: folder of the comparison.
        logs: recorded logs that it is about, fewer as for seeds.
        content: what the runs depend on beyond their configurations, by name: hashes of files, the number of folds.

    Raises:
        UserError: the folder holds another declaration, or one of other models or configurations, or without some of
            the seeds or logs.
    """
    path = out / FILE
    wanted = asdict(declaration) | {"claims": _tested(declaration.claims), "models": list(plan)}
    rows, files = {name: _identity(config) for name, config in configs.items()}, dict(content or {})
    if path.exists():
        found = _read(path)
    else:
        source = provenance()
        begun = sum(job.start() == "resume" for planned in plan.values() for job in planned)
        found = wanted | {"claims": [asdict(claim) for claim in declaration.claims], "seeds": list(seeds)}
        found |= {"begun": begun} | {name: source[name] for name in ("time", "git")}
        found |= {"logs": sorted(logs), "content": files, _CONFIGURATIONS: rows}
        write_json(path, found)
    missing = tuple(name for name in (_SECONDARY, _CONFIGURATIONS) if name not in found)
    known = tuple(found.get("logs", sorted(logs)))  # earlier versions wrote down no logs
    declared = Declared(declaration, tuple(found["seeds"]), found["time"], found["begun"], known, missing)
    then = {name: found.get(name, wanted[name]) for name in wanted} | {"claims": _tested(_claims(found))}
    difference = first_difference(then, wanted)
    if _CONFIGURATIONS in found:
        difference = difference or _other_rows(found, rows, files)
    if more := sorted(set(seeds) - set(declared.seeds)):
        difference = difference or f"seed {more[0]} was not declared"
    if new := sorted(set(logs) - set(declared.logs)):
        difference = difference or f"log {new[0]} was not declared"
    if difference:
        raise UserError(f"{path} holds another declaration ({difference}): choose another folder with --out")
    return declared


def _identity(config: RunConfig) -> dict[str, Any]:
    """Return a configuration as plain JSON, without seeds."""
    return to_json(replace(config, training=replace(config.training, seeds=())))


def _tested(claims: Sequence[Claim]) -> list[dict[str, Any]]:
    """Return what claims test, as plain JSON; their words may be corrected later."""
    return [{"treatment": claim.treatment, "control": claim.control} for claim in claims]


def _claims(found: Mapping[str, Any]) -> list[Claim]:
    return [Claim(claim["treatment"], claim["control"]) for claim in found["claims"]]


def _other_rows(found: Mapping[str, Any], rows: Mapping[str, Any], files: Mapping[str, str]) -> str:
    """Return which row has another configuration than was declared, or which files are others; "" for none."""
    declared = found[_CONFIGURATIONS]
    if changed := declared.keys() ^ rows.keys():
        return f"{min(changed)} is {'declared' if min(changed) in declared else 'planned'} only"
    for name, here in rows.items():
        if (there := declared[name]) == here:
            continue
        try:
            there, _ = current_form(there)
        except UserError as error:
            return f"{name}: {error}"
        if difference := first_difference(there, here):
            return f"{name}: {difference}"
    changed = first_difference(found["content"], dict(files))
    return f"content of {changed}" if changed else ""


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a declaration file; raises UserError that names it where something is missing."""
    remedy = "restore it, or choose another folder with --out"
    try:
        found = _current_form(dict(load_json(path)))
    except (TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: it holds no declaration; {remedy}") from error
    names = [field.name for field in dataclasses.fields(Declaration) if field.name != _SECONDARY]
    kinds = {"seeds": list, "time": str, "begun": int, "models": list} | dict.fromkeys(names, object) | {"claims": list}
    if _CONFIGURATIONS in found:
        kinds |= {_CONFIGURATIONS: dict, "content": dict, "logs": list}
    if wrong := [name for name, kind in kinds.items() if name not in found or not isinstance(found[name], kind)]:
        raise UserError(f"{path} is damaged ({wrong[0]}); {remedy}")
    for claim in found["claims"]:
        if not isinstance(claim, dict) or not claim.keys() >= {"treatment", "control"}:
            raise UserError(f"{path} is damaged (claims); {remedy}")
    if not all(type(seed) is int for seed in found["seeds"]):
        raise UserError(f"{path} is damaged (seeds); {remedy}")
    if not found["time"].isprintable():
        raise UserError(f"{path} is damaged (time); {remedy}")
    if not all(isinstance(config, dict) for config in found.get(_CONFIGURATIONS, {}).values()):
        raise UserError(f"{path} is damaged ({_CONFIGURATIONS}); {remedy}")
    return found


def _current_form(found: dict[str, Any]) -> dict[str, Any]:
    """Return a declaration file's content with claims; files of an earlier form name one treatment."""
    if "treatment" in found:
        found["claims"] = [asdict(Claim(found.pop("treatment")))]
    return found

"""The trainings of a comparison: folders, identities, and whether a folder already holds the wanted run.

A run is identified by its whole resolved configuration, with exactly one seed, and by the thread setting of the process
that trains it (`training.provenance.thread_setting`), because results depend on both. A run that starts from another
one (`training.init_from`) also depends on that run's checkpoint, and every run on the files of its training data.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from tflane_jax.ablations.recorded import RecordedRun
from tflane_jax.config import RunConfig
from tflane_jax.config_io import first_difference, to_json
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.files.wording import counted
from tflane_jax.run_checks import check_rate_factors, check_run
from tflane_jax.runs import check_origin, current_form
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.fine_tuning import origin_folders, origins
from tflane_jax.training.provenance import read_provenance, thread_setting, threads_of
from tflane_jax.training.run_folder import Start, read_config, with_same_origin

Tests = Mapping[str, Sequence[str]]
"""Test sets by name: settings of the data, `--data.name value`, that differ from the configuration's test split."""

ScoredBy = Literal["this code", "any code"]
"""State of the code whose scores count where they are kept beside a run; others are measured again."""


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        config: with exactly one seed.
        folder: of the run.
        threads: thread setting of the process that trains it.
        tests: test sets to evaluate it on, beside the configuration's own test split.
        retrain: whether a run of another configuration in the folder is deleted.
        label: name for people.
        further: evaluations of the last checkpoint beside the configuration's own.
        content: hash of files that the run depends on beyond its configuration; "" for none.
        scored_by: which kept scores count.
        recorded: the run in a record of scores, which takes the place of the folder; None for none.
    """

    config: RunConfig
    folder: Path
    threads: Mapping[str, Any] = field(default_factory=thread_setting)
    tests: Tests = field(default_factory=dict)
    retrain: bool = False
    label: str = ""
    further: tuple[EvaluationConfig, ...] = ()
    content: str = ""
    scored_by: ScoredBy = "this code"
    recorded: RecordedRun | None = None

    @property
    def seed(self) -> int:
        """The seed of the training."""
        (seed,) = self.config.training.seeds
        return seed

    @property
    def log(self) -> Path:
        """File for messages: everything that a worker process prints, or the error of a training in this process."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def place(self) -> Path:
        """Absolute path of the folder; runs that start from this one name it."""
        return self.folder.resolve()

    @property
    def starts_from(self) -> list[Path]:
        """Absolute folders of the runs that this one starts from."""
        start, seeds = self.config.training.init_from, self.config.training.seeds
        return [] if start is None else [folder.resolve() for folder in origin_folders(start, seeds)]

    @property
    def key(self) -> str:
        """Hash of everything that identifies the run."""
        text = json.dumps([to_json(self.config), dict(self.threads), *filter(None, [self.content])], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def difference(self) -> str:
        """Return how the run in the folder differs from this one; "" if it does not, or the folder holds none."""
        if not self.exists():
            return ""
        try:
            saved, _ = current_form(read_config(self.folder))
        except UserError as error:
            return str(error)
        wanted = to_json(self.config)
        if difference := first_difference(with_same_origin(saved, wanted, self.folder), wanted):
            return difference
        # A run that was started before these were recorded is taken as it is.
        for start in read_provenance(self.folder):
            if difference := first_difference(threads_of(start) or dict(self.threads), dict(self.threads)):
                return difference
            if difference := self._other_origin(start.get("init_from", [])):
                return difference
        return self._other_files()

    def _other_origin(self, recorded: Sequence[Mapping[str, Any]]) -> str:
        """Return which run of training.init_from is not the recorded one any more; "" if it is, or is gone."""
        if not recorded:
            return ""
        training = self.config.training
        try:
            now = origins(training.init_from or "", training.seeds)
        except UserError:
            return ""
        changed = [new["run"] for old, new in zip(recorded, now, strict=True) if old["content"] != new["content"]]
        return f"training.init_from: {changed[0]} was trained anew since" if changed else ""

    def _other_files(self) -> str:
        """Return that files of the training data have changed since; "" if they have not, or nothing tells."""
        checkpoints, split = Checkpoints(self.folder / "checkpoints"), self.config.data.source("train")
        # Files are gone, or the checkpoint is damaged: reported when the run is used.
        with contextlib.suppress(UserError):
            for step in checkpoints.steps()[-1:]:
                trained_on = checkpoints.manifest(step).progress.get("content")  # earlier versions wrote down none
                if trained_on and trained_on != source_of(split).content(split):
                    return "the files of its training data have changed since"
        return ""

    def start(self) -> Start:
        """Return how the training has to start."""
        if self.recorded is not None:
            return "resume"
        if not self.exists():
            return "new"
        return "overwrite" if self.retrain and self.difference() else "resume"

    def is_complete(self) -> bool:
        """Return whether nothing is left to train: the run is recorded, or at hand."""
        return self.recorded is not None or self.is_at_hand()

    def is_at_hand(self) -> bool:
        """Return whether the folder holds this very run with the checkpoint of its last step, and its evaluation."""
        checkpoints, last = Checkpoints(self.folder / "checkpoints"), self.config.training.steps
        if not self.exists() or checkpoints.steps()[-1:] != [last] or self.difference():
            return False
        with contextlib.suppress(UserError):  # a damaged checkpoint is reported when the run is used
            return not checkpoints.manifest(last).progress.get("due")
        return True

    def exists(self) -> bool:
        """Return whether the folder holds a run."""
        return (self.folder / "config.json").is_file()

    def step(self) -> int:
        """Return the last step in the run's records, 0 without records; for progress bars."""
        if self.recorded is not None:
            return self.config.training.steps
        with contextlib.suppress(OSError, IndexError, ValueError, KeyError, TypeError, RecursionError):
            lines = (self.folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
            return min(int(json.loads(lines[-1])["step"]), self.config.training.steps)
        return 0

    def resumes_at(self) -> int:
        """Return the step at which training goes on: that of the last checkpoint; records may be ahead of it."""
        if self.is_complete():
            return self.config.training.steps
        if not self.exists() or self.start() == "overwrite":
            return 0
        return min([0, *Checkpoints(self.folder / "checkpoints").steps()][-1], self.config.training.steps)


@dataclass(frozen=True)
class Failure:
    """A training or evaluation that failed, and why."""

    job: Job
    reason: str

    def __str__(self) -> str:
        return f"training {self.job.folder} failed: its messages are in {self.job.log} ({self.reason})"


def check_rows(plan: Mapping[str, Sequence[Job]]) -> None:
    """Raise UserError, naming the rows, where a training that is not complete must fail; call it before the first one.

    A row may start from the runs of another one, which do not exist yet.
    """
    wrong, places = [], {job.place for jobs in plan.values() for job in jobs}
    for name, jobs in plan.items():
        if waiting := [job for job in jobs if not job.is_complete()]:
            job = waiting[0]
            try:
                check_run(job.config)
                check_rate_factors(job.config)
                _check_same(waiting)
                if job.start() != "resume" and not places & set(job.starts_from):
                    check_origin(job.config)
            except UserError as error:
                wrong.append(f"{name}: {error}")
    if len(wrong) == 1:
        raise UserError(wrong[0])
    if wrong:
        raise UserError("\n  ".join([f"{len(wrong)} of {len(plan)} rows cannot be trained:", *wrong]))


def _check_same(jobs: Sequence[Job]) -> None:
    """Raise UserError for the first of these jobs whose folder holds another run, which it cannot resume."""
    for job in jobs:
        if job.start() == "resume" and (difference := job.difference()):
            raise UserError(f"{job.folder} holds another run ({difference}): choose another folder with --out")


def plan_jobs(
    configs: Mapping[str, RunConfig],
    seeds: Sequence[int],
    out: Path,
    *,
    threads: Mapping[str, Any],
    tests: Tests,
    retrain: bool = False,
) -> dict[str, list[Job]]:
    """Return the trainings of each configuration, one for each seed.

    Raises:
        UserError: a folder holds a run of another configuration or thread setting, and `retrain` is False.
    """
    plan = {}
    for name, folder in file_names(configs).items():
        plan[name] = []
        for seed in seeds:
            config = replace(configs[name], training=replace(configs[name].training, seeds=(seed,)))
            plan[name].append(
                Job(config, out / folder / f"seed_{seed}", threads, tests, retrain, f"{name}, seed {seed}")
            )
    differences = [(job, text) for planned in plan.values() for job in planned if (text := job.difference())]
    if differences and not retrain:
        job, text = differences[0]
        others = counted(len(differences) - 1, "other folder")
        more = f" (beside {others} of this kind)" if len(differences) > 1 else ""
        hint = "; --test evaluates finished runs on other data" if text.startswith("data.test") else ""
        raise UserError(
            f"{job.folder} holds a run of another configuration ({text}){more}: choose another folder with --out, or "
            f"train such runs anew with --retrain, which deletes them{hint}"
        )
    return plan


_LONGEST = 100  # letters of a name: with what is appended to it, file systems take 255 bytes


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Return a name for files for each name: lower case, letters, digits and underscores.

    Names that would get the same one, or none, also get a hash of the name, and so do long ones, which are cut.
    """
    names = list(names)
    plain = {name: "".join(c if c.isalnum() else "_" for c in name.lower()).strip("_")[:_LONGEST] for name in names}
    unique = {}
    for name, slug in plain.items():
        alone = slug and list(plain.values()).count(slug) == 1 and len(name) <= _LONGEST
        mark = hashlib.sha256(name.encode()).hexdigest()[:8]
        unique[name] = slug if alone else f"{slug or 'run'}-{mark}"
    return unique

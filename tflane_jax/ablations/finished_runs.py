"""Train planned runs, and score, draw and record those that finished, for comparisons and tables of papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.ablations.facts import facts
from tflane_jax.ablations.held_out import load_test_data
from tflane_jax.ablations.jobs import Failure, Job
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import CHECKPOINTS, OWN_TEST, code_digest, evaluations, measure, with_test_set
from tflane_jax.ablations.workers import noted, train_all
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.own_modules import own_code
from tflane_jax.plots.figure import can_draw
from tflane_jax.progress import progress_bar
from tflane_jax.runs import open_run
from tflane_jax.tasks import Model
from tflane_jax.training.provenance import read_provenance


def train_and_evaluate(
    plan: Mapping[str, Sequence[Job]], order: Sequence[Job], results: Results, parallel: int
) -> tuple[dict[str, list[Job]], list[Failure]]:
    """Train what is missing, and add the scores of all runs, and why models failed, to the results.

    Args:
        plan: trainings of each model.
        order: of these trainings, and of those that they start from.
        results: without scores; changed.
        parallel: trainings at a time.

    Returns:
        The runs that were trained and evaluated, and the failures of the others.
    """
    return evaluate_and_note(plan, train_all(order, parallel), results)


def evaluate_and_note(
    plan: Mapping[str, Sequence[Job]], failures: Sequence[Failure], results: Results
) -> tuple[dict[str, list[Job]], list[Failure]]:
    """Add to the results the scores of the runs that did not fail, and for other models why their first run failed.

    Returns:
        The runs that have scores, by model, and all failures: those given, then those of the evaluation.
    """
    failures = [*failures, *evaluate_runs(without_failures(plan, failures), results)]
    results.failed.update(reasons(plan, failures))
    return without_failures(plan, failures), failures


def without_failures(plan: Mapping[str, Sequence[Job]], failures: Sequence[Failure]) -> dict[str, list[Job]]:
    """Return the trainings that did not fail."""
    failed = {failure.job.folder for failure in failures}
    return {name: [job for job in planned if job.folder not in failed] for name, planned in plan.items()}


def reasons(plan: Mapping[str, Sequence[Job]], failures: Sequence[Failure]) -> dict[str, str]:
    """Return why the first training of each model that failed did, in one line."""
    first = {failure.job.folder: failure.reason.partition("\n")[0] for failure in reversed(failures)}
    found = {name: [first[job.folder] for job in jobs if job.folder in first] for name, jobs in plan.items()}
    return {name: of_model[0] for name, of_model in found.items() if of_model}


def evaluate_runs(trained: Mapping[str, Sequence[Job]], results: Results) -> list[Failure]:
    """Add the scores of all finished runs to the results, test set by test set; return the runs that failed."""
    failures: list[Failure] = []
    pairs = [(name, job) for name, done in trained.items() for job in done]
    for test in (OWN_TEST, *results.tests):
        for name, job in progress_bar(pairs, desc=f"evaluate {test or 'test split'}", unit="run"):
            if any(failure.job is job for failure in failures):
                continue
            with noted(job, failures):
                seed = job.seed
                config = with_test_set(job.config, results.tests.get(test, ()))
                for which in CHECKPOINTS:
                    if (measured := measure(job, config, which)) is not None:
                        results.add(test, which, name, seed, measured)
    return failures


def first_models(trained: Mapping[str, Sequence[Job]], results: Results) -> dict[str, Model]:
    """Return the model of each row's first seed at its last checkpoint, for pictures.

    A recorded run whose folder is not at hand is left out; one whose parameters cannot be read, with a line.
    """
    models = {}
    for name, done in trained.items():
        job = next((job for job in done if job.recorded is None or job.is_at_hand()), None)
        if results.has(name) and job is not None:
            try:
                run = open_run(job.folder, "last")
            except UserError:
                print(f"{name} is not drawn: the parameters in {job.folder / 'checkpoints'} are missing or damaged")
                continue
            models[name] = Model(run.config.task, run.params[0], run.config.evaluation.batch_size)
    return models


def draw_models(first: RunConfig, models: Mapping[str, Model], pair: Sequence[str], path: Path) -> list[Path]:
    """Draw test frames in which the first two models differ, those of `pair` first; without matplotlib, say so.

    Returns:
        The picture, if it was drawn.
    """
    if not can_draw():
        return []
    ordered = {name: models[name] for name in sorted(models, key=lambda name: name not in pair)}
    return [first.task.draw_comparison(ordered, first.data.source("test"), load_test_data(first), path)]


def save_plan(plan: Mapping[str, Sequence[Job]], failures: Sequence[Failure], results: Results, out: Path) -> Path:
    """Write what was compared: identity and folder of every run, commits of the code, failures, scores by seed."""
    content: dict[str, Any] = {
        "seeds": list(results.seeds),
        "tests": {name: list(settings) for name, settings in results.tests.items()},
        "runs": {
            name: [{"folder": str(job.folder), "key": job.key, "threads": dict(job.threads)} for job in planned]
            for name, planned in plan.items()
        },
        "commits": {name: list(commits(jobs)) for name, jobs in without_failures(plan, failures).items()},
        "failed": [str(failure) for failure in failures],
        "scores": results.by_seed(),
    }
    return write_json(out / "comparison.json", content)


def commits(jobs: Sequence[Job]) -> tuple[str, ...]:
    """Return by which commits runs were trained, in order."""
    return tuple(sorted({commit for job in jobs for commit in facts(job).commits}))


def code_notices(trained: Mapping[str, Sequence[Job]]) -> list[str]:
    """Return notices about the code that trained runs: several commits, and own modules that were edited since."""
    notices, found = [], {name: commits(jobs) for name, jobs in trained.items()}
    if len({commit for each in found.values() for commit in each}) > 1:
        listed = "; ".join(f"{name}: {', '.join(each)}" for name, each in found.items() if each)
        notices.append(
            f"the runs were trained by different states of the code ({listed}): differences of scores may be theirs"
        )
    if edited := [str(job.folder) for jobs in trained.values() for job in jobs if _was_edited(job)]:
        more = f" and {len(edited) - 1} more" if len(edited) > 1 else ""
        notices.append(
            f"own modules were edited since they trained {edited[0]}{more}: delete these folders to train them anew"
        )
    return notices


def _was_edited(job: Job) -> bool:
    """Return whether a run's own modules have other code than when it was trained, as far as that was recorded."""
    now = own_code(job.config)
    return job.recorded is None and any(start.get("own_modules", now) != now for start in read_provenance(job.folder))


def summary_of(failures: Sequence[Failure], count: int) -> str:
    """Return what failed, for the error at the end."""
    lines = [f"{len(failures)} of {count} trainings failed; the same command tries them again:"]
    return "\n  ".join([*lines, *map(str, failures)])


def measured_elsewhere(runs: Sequence[Job]) -> list[str]:
    """Return a phrase that names the digests of other code by which runs were measured; [] for none.

    The code of a recorded run is always named.
    """
    found = [(job, measure(job, config, which)) for job in runs for config, which in evaluations(job)]
    codes = {
        measured.code[:9]
        for job, measured in found
        if measured is not None and (job.recorded is not None or measured.code != code_digest())
    }
    digests = "digest" if len(codes) == 1 else "digests"
    return [f"measured by code of {digests} {' and '.join(sorted(codes))}"] if codes else []

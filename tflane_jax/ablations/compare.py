"""Train several configurations with several seeds, evaluate them in the same way, and test their differences.

Each training is a run folder, `<out>/<name>/seed_<n>`. The same command resumes a comparison that was stopped, and each
run can be evaluated or drawn by itself.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.ablations.declaration import Declaration, check, declare
from tflane_jax.ablations.effects import judged_claims
from tflane_jax.ablations.findings import save_effects
from tflane_jax.ablations.jobs import Failure, Job, Tests, check_rows, plan_jobs
from tflane_jax.ablations.report import save_report, suffixes
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import CHECKPOINTS, OWN_TEST, measure, with_test_set
from tflane_jax.ablations.workers import noted, train_all, worker_threads
from tflane_jax.accelerators import leave_to_workers
from tflane_jax.config import RunConfig
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.progress import progress_bar
from tflane_jax.runs import load_test_data, open_run
from tflane_jax.tasks import Model


def compare(
    configs: Mapping[str, RunConfig],
    seeds: Sequence[int],
    out: Path,
    *,
    jobs: int = 1,
    tests: Tests | None = None,
    retrain: bool = False,
    declaration: Declaration | None = None,
    summary: Callable[[Results], str] | None = None,
) -> Path:
    """Train what is not trained yet, evaluate on the test sets, print and save tables and pictures.

    Every run is evaluated at its last step, which is the primary result because no selection favours a model, and at
    its best one by `training.best_metric` on the validation split. A model with interventions (without traffic flow at
    inference, with that of another scene) gets a row for each, evaluated from the same runs. A training that fails does
    not stop the others: the tables hold the complete runs, and paired tests the seeds that both rows have.

    Args:
        configs: by the name that the table shows; the first one is the control.
        seeds: of training; each configuration is trained with each.
        out: folder for everything.
        jobs: trainings at a time, each on as many cores as the others.
        tests: further test sets by name: settings, `--data.name value`, that differ from the own test split.
        retrain: whether runs of other configurations in the folders are deleted and trained anew.
        declaration: what is tested. It is written to `declaration.json` before the trainings, and the report gets a
            table of these tests alone, `effects.md`. The picture shows where the first claim's treatment and the
            control differ; without a declaration, where the first two configurations do.
        summary: returns the text to print if no training failed; None prints all tables. The files are the same.

    Returns:
        The Markdown file with the table of the configurations' own test split.

    Raises:
        UserError: the configurations do not test on the same examples; a folder holds a run of another configuration,
            or another declaration; a row's settings must fail, before any is trained; or trainings failed, after the
            tables of the others were written.
    """
    if jobs > 1:
        leave_to_workers()
    tests = dict(tests or {})
    _check_tests(configs, tests)
    if declaration is not None:
        check(declaration, configs)
    plan = plan_jobs(configs, seeds, out, threads=worker_threads(jobs), tests=tests, retrain=retrain)
    check_rows(plan)
    declared = None if declaration is None else declare(declaration, plan, configs, seeds, out)
    # Seed by seed, so that a comparison stopped early has pairs.
    every = [plan[name][i] for i in range(len(seeds)) for name in plan]
    failures = train_all(every, jobs)

    results = Results(tuple(configs), tuple(seeds), tests)
    trained = without_failures(plan, failures)
    failures += evaluate_runs(trained, results)
    trained = without_failures(plan, failures)
    results.failed.update(reasons(plan, failures))
    written = [save_plan(plan, failures, results, out)]
    if not results.scores:
        raise UserError(summary_of(failures, len(every)))
    first, models = next(iter(configs.values())), first_models(trained, results)
    remarks = {name: model.task.remarks(model.params) for name, model in models.items()}
    pair = list(configs)[:2] if declaration is None else [next(iter(configs)), declaration.claims[0].treatment]
    written += draw_models(first, models, pair, out / "comparison.png")
    with contextlib.nullcontext() if summary is None else contextlib.redirect_stdout(io.StringIO()):
        tables = save_report(results, first.task, remarks, out)
        if declared is not None:
            for test, suffix in suffixes(results).items():
                tested = judged_claims(results, declared.declaration, test, first.task.errors)
                tables.append(save_effects(results, declared, test, tested, out / f"effects{suffix}"))
        print("\nwritten:", *tables, *written, sep="\n  ")
    if failures:
        raise UserError(summary_of(failures, len(every)))
    if summary is not None:
        print(summary(results))
    return tables[0]


def _check_tests(configs: Mapping[str, RunConfig], tests: Tests) -> None:
    if OWN_TEST in tests:
        raise UserError("a test set needs a name")
    for name, settings in ({OWN_TEST: ()} | dict(tests)).items():
        sources = [with_test_set(config, settings).data.source("test") for config in configs.values()]
        if any(source != sources[0] for source in sources):
            what = f"test set {name}" if name else "data.test"
            raise UserError(f"the configurations have different test data ({what}): their numbers cannot be compared")


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
                (seed,) = job.config.training.seeds
                config = with_test_set(job.config, results.tests.get(test, ()))
                for which in CHECKPOINTS:
                    if (measured := measure(job, config, which)) is not None:
                        results.add(test, which, name, seed, measured)
    return failures


def first_models(trained: Mapping[str, Sequence[Job]], results: Results) -> dict[str, Model]:
    """Return the model of each row's first seed at its last checkpoint; no recorded run whose folder is not at hand."""
    models = {}
    for name, done in trained.items():
        job = next((job for job in done if job.recorded is None or job.is_at_hand()), None)
        if results.has(name) and job is not None:
            run = open_run(job.folder, "last")
            models[name] = Model(run.config.task, run.params[0])
    return models


def draw_models(first: RunConfig, models: Mapping[str, Model], pair: Sequence[str], path: Path) -> list[Path]:
    """Draw test frames in which the first two models differ, those of `pair` first; nothing without matplotlib.

    Returns:
        The picture, if it was drawn.
    """
    if importlib.util.find_spec("matplotlib") is None:
        return []
    ordered = {name: models[name] for name in sorted(models, key=lambda name: name not in pair)}
    return [first.task.draw_comparison(ordered, first.data.source("test"), load_test_data(first), path)]


def save_plan(plan: Mapping[str, Sequence[Job]], failures: Sequence[Failure], results: Results, out: Path) -> Path:
    """Write what was compared: identity and folder of every run, failures, scores by seed."""
    content: dict[str, Any] = {
        "seeds": list(results.seeds),
        "tests": {name: list(settings) for name, settings in results.tests.items()},
        "runs": {
            name: [{"folder": str(job.folder), "key": job.key, "threads": dict(job.threads)} for job in planned]
            for name, planned in plan.items()
        },
        "failed": [str(failure) for failure in failures],
        "scores": results.by_seed(),
    }
    out.mkdir(parents=True, exist_ok=True)
    return write_json(out / "comparison.json", content)


def summary_of(failures: Sequence[Failure], count: int) -> str:
    """Return what failed, for the error at the end."""
    lines = [f"{len(failures)} of {count} trainings failed; the same command tries them again:"]
    return "\n  ".join([*lines, *map(str, failures)])

"""Train several configurations with several seeds, evaluate them in the same way, and test their differences.

Each training is a run folder, `<out>/<name>/seed_<n>`. The same command resumes a comparison that was stopped, and each
run can be evaluated or drawn by itself.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tflane_jax.ablations.declaration import Declaration, check, declare
from tflane_jax.ablations.effects import judged_claims
from tflane_jax.ablations.findings import save_effects
from tflane_jax.ablations.finished_runs import (
    code_notices,
    draw_models,
    first_models,
    save_plan,
    summary_of,
    train_and_evaluate,
)
from tflane_jax.ablations.jobs import Tests, check_rows, plan_jobs
from tflane_jax.ablations.report import save_report, suffixes
from tflane_jax.ablations.results import OWN_SPLIT, Results
from tflane_jax.ablations.scores import OWN_TEST, with_test_set
from tflane_jax.ablations.workers import worker_threads
from tflane_jax.config import RunConfig
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.evaluation.interventions import INTERVENTIONS
from tflane_jax.training.notices import print_notices


def compare(
    configs: Mapping[str, RunConfig],
    seeds: Sequence[int],
    out: Path,
    *,
    parallel: int = 1,
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
        parallel: trainings at a time, each on as many cores as the others.
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
    tests = dict(tests or {})
    _check_names(configs)
    _check_tests(configs, tests)
    print_notices(_chosen_on_test(configs))
    if declaration is not None:
        check(declaration, configs)
    plan = plan_jobs(configs, seeds, out, threads=worker_threads(parallel), tests=tests, retrain=retrain)
    check_rows(plan)
    declared = None if declaration is None else declare(declaration, plan, configs, seeds, out)
    # Seed by seed, so that a comparison stopped early has pairs.
    every = [plan[name][i] for i in range(len(seeds)) for name in plan]
    results = Results(tuple(configs), tuple(seeds), tests)
    trained, failures = train_and_evaluate(plan, every, results, parallel)
    written = [save_plan(plan, failures, results, out)]
    if not results.scores:
        raise UserError(summary_of(failures, len(every)))
    print_notices(code_notices(trained))
    first, models = next(iter(configs.values())), first_models(trained, results)
    remarks = {name: model.task.remarks(model.params) for name, model in models.items()}
    pair = list(configs)[:2] if declaration is None else [next(iter(configs)), declaration.claims[0].treatment]
    with contextlib.nullcontext() if summary is None else contextlib.redirect_stdout(io.StringIO()):
        tables = save_report(results, first.task, remarks, out)
        if declared is not None:
            for test, suffix in suffixes(results).items():
                tested = judged_claims(results, declared.declaration, test, first.task.errors)
                source = source_of(with_test_set(first, tests.get(test, ())).data.source("test"))
                stem = out / f"effects{suffix}"
                tables.append(save_effects(results, declared, test, tested, stem, no_drives=source.no_drives))
        try:
            written += draw_models(first, models, pair, out / "comparison.png")
        except UserError as error:  # the tables stand without it
            print(f"tflane: no picture of the models: {error}", file=sys.stderr)
        print("\nwritten:", *tables, *written, sep="\n  ")
    if failures:
        raise UserError(summary_of(failures, len(every)))
    if summary is not None:
        print(summary(results))
    return tables[0]


def _check_names(configs: Mapping[str, RunConfig]) -> None:
    """Raise UserError for a configuration with the name of a row that is measured of another one."""
    for model, way in itertools.product(configs, INTERVENTIONS):
        if (name := f"{model}, {way}") in configs:
            raise UserError(f"{name!r} is the name of an intervention on {model}: give the configuration another one")


def _chosen_on_test(configs: Mapping[str, RunConfig]) -> list[str]:
    """Return the notice for rows whose best checkpoint is chosen by the examples that they are tested on."""
    names = [name for name, config in configs.items() if config.chosen_by(config.data.source("test"))]
    reason = "the best checkpoint is chosen by the test examples, because validation and test are the same"
    effect = "its scores are too good by chance, those of the last one are not"
    return [f"{', '.join(names)}: {reason}; {effect}"] if names else []


def _check_tests(configs: Mapping[str, RunConfig], tests: Tests) -> None:
    if OWN_TEST in tests:
        raise UserError("a test set needs a name")
    if OWN_SPLIT in tests:
        raise UserError(
            f"a test set cannot be named {OWN_SPLIT}, the name of the configurations' own split: choose another"
        )
    own = next(iter(configs.values())).data.source("test")
    for name, settings in ({OWN_TEST: ()} | dict(tests)).items():
        sources = [with_test_set(config, settings).data.source("test") for config in configs.values()]
        if settings and sources[0] == own:
            raise UserError(f"test set {name} is the configurations' own test split: {' '.join(settings)} changes none")
        if any(source != sources[0] for source in sources):
            what = f"test set {name}" if name else "data.test"
            raise UserError(f"the configurations have different test data ({what}): their numbers cannot be compared")

"""Does a model find lanes on logs whose map it has never seen? Each recorded log is left out of training once.

Every model is trained on the built-in world: on generated roads (of the preset `real-like`; as controls, of `city`, and
of `real-like` with right-hand traffic alone), on the maps of the other logs, or on both. It is tested on the key frames
of the log that was left out, with that log's recorded tracks as traffic flow: as they are, without them, and with the
tracks of another log. Models that see no map are trained once and tested on every log. With folds, several logs are
left out of one training, which needs fewer of them.

<out>/runs/KEY              the runs; the same command resumes what was stopped
<out>/declaration.json      claims and primary measure, written before the trainings
<out>/carry_over.md, .json  scores of each model, mean and spread over the logs
<out>/logs.md, .json        the same for each log
<out>/effects.md, .json     the claims, by tests paired over the logs
<out>/LOG.png               test frames of a log: truth and the predictions of two models
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.ablations.carry_over_plan import (
    ROWS,
    Plan,
    Settings,
    model_configs,
    on_log,
    plan_without_trainings,
    with_trainings,
)
from tflane_jax.ablations.comparison import Scores, compact
from tflane_jax.ablations.declaration import Claim, Declaration, Declared, check, declare, model_of_row
from tflane_jax.ablations.finished_runs import draw_models, summary_of
from tflane_jax.ablations.jobs import Failure, Job, check_rows
from tflane_jax.ablations.scores import measure
from tflane_jax.ablations.statistics import holm, paired_difference
from tflane_jax.ablations.store import remaining_seconds, runs_elsewhere
from tflane_jax.ablations.workers import noted, train_all, worker_threads
from tflane_jax.errors import UserError
from tflane_jax.evaluation.interventions import NO_TRAFFIC
from tflane_jax.files.wording import counted
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.tables import PERCENT, POINTS, format_table, save_table
from tflane_jax.progress import progress_bar
from tflane_jax.runs import open_run
from tflane_jax.tasks import Model

OTHER = "traffic of another log"
PRIMARY = "all/recall"
_ONE_TRAINING = "Each model was trained once: p is about other logs, not about other trainings."
COLUMNS = ("all/recall", "all/DET_l", "all/TOP_ll", "occluded/recall")
CLAIMS = (
    Claim("generated", "generated on city", "generated roads that are closer to recorded logs help"),
    Claim("generated", "generated, right-hand traffic", "scenes with left-hand traffic help"),
    Claim("mixed", "generated", "maps of other logs help on a log that was never seen"),
    Claim("mixed", "maps", "generated roads help beside them"),
    Claim("mixed", "mixed without traffic", "traffic flow helps a model that is trained with it"),
    Claim("mixed", f"mixed, {NO_TRAFFIC}", "this model uses the traffic"),
    Claim("mixed", f"mixed, {OTHER}", "it uses what the traffic tells of this place"),
    Claim("mixed + BEV", "mixed", "traffic in the BEV features helps beside that in the queries"),
    Claim("mixed + BEV", f"mixed + BEV, {NO_TRAFFIC}", "this model uses the traffic"),
    Claim("mixed + BEV", f"mixed + BEV, {OTHER}", "it uses what the traffic tells of this place"),
)
FITTED = (
    "The settings of generated roads (preset real-like) and of traffic were fitted to mean statistics of nine logs "
    "(docs/real_roads.md), and scenes with left-hand traffic were added after a model had failed on five of them: a "
    "tested log that is one of the nine is not wholly unseen."
)
"""What the models know of the logs that they are tested on, for every page."""
# Models to draw, preferred first; the first two with a run are drawn.
_DRAWN = ("mixed + BEV", "generated", "mixed")
# Training of one model on one core of the machine of docs/benchmarks.md, for estimates.
_MINUTES = 40.0

ByLog = dict[str, dict[str, Scores]]
"""Scores by row and log, means over seeds; rows are models, or "model, intervention"."""


def carry_over(settings: Settings, out: Path) -> Path:
    """Train what is missing, test on every log, and write tables, tests and pictures.

    Returns:
        The file of the main table.

    Raises:
        UserError: fewer than two logs, an unknown log or row, a number of folds that the logs do not allow, another
            declaration in `out` (further logs or seeds, other maps, steps, scenes, folds or models), or trainings that
            failed, after the tables of the others were written.
    """
    out = out / "quick" if settings.quick else out
    configs = model_configs(settings)
    claims = tuple(
        claim for claim in CLAIMS if {claim.treatment, model_of_row(str(claim.control), ROWS)} <= set(configs)
    )
    declaration = Declaration(PRIMARY, claims)
    check(declaration, configs)
    untrained = plan_without_trainings(settings)
    content = {**untrained.content, **({} if settings.folds is None else {"folds": str(settings.folds)})}
    plan = with_trainings(untrained, settings, configs, out, worker_threads(settings.parallel, settings.cores))
    by_row = plan.by_row()
    check_rows(by_row)
    declared = declare(declaration, by_row, configs, settings.seeds, out, logs=plan.logs, content=content)
    complete = sum(job.is_complete() for job in plan.flat())
    seconds, guesses = remaining_seconds(by_row, dict.fromkeys(by_row, _MINUTES))
    basis = "a guess" if guesses else "by the runs so far"
    print(
        f"{counted(len(plan.flat()), 'run')}, {complete} complete; the others take about "
        f"{seconds / 3600 / settings.parallel:.1f} h ({settings.parallel} at a time; {basis})",
        flush=True,
    )

    def replan(threads: Mapping[str, Any]) -> list[Job]:
        return with_trainings(untrained, settings, configs, out, threads).flat()

    for line in runs_elsewhere(plan.flat(), out / "runs", replan):
        print(line, flush=True)
    failures = train_all(plan.flat(), settings.parallel, settings.cores)
    found, seeds, protocol = _evaluated(plan, failures)
    if not found:
        raise UserError(summary_of(failures, len(plan.flat())))
    path = _save(found, seeds, declared, protocol, out, quick=settings.quick)
    _draw(plan, failures, out)
    print(f"\nwritten to {out}")
    if failures:
        raise UserError(summary_of(failures, len(plan.flat())))
    return path


def _evaluated(plan: Plan, failures: list[Failure]) -> tuple[ByLog, dict[str, set[int]], str]:
    """Return the scores of all finished runs on the logs that they have not seen, seeds by log, and the protocol.

    A log counts only seeds with which every model was tested on it, so that failed trainings do not bias the
    comparison.
    """
    found: dict[str, dict[str, dict[int, Scores]]] = {}
    protocol, failed = "", {failure.job.folder for failure in failures}
    pairs = [(row, log) for row in plan.jobs for log in plan.logs]
    for row, log in progress_bar(pairs, desc="test on recorded logs", unit="log"):
        for job in plan.of(row, log):
            if job.folder in failed:
                continue
            with noted(job, failures):
                own = measure(job, on_log(job.config, log), "last")
                assert own is not None
                protocol, ways = own.protocol, {row: own.ways[""]}
                if NO_TRAFFIC in own.ways:  # the model reads traffic
                    swapped = measure(job, on_log(job.config, log, plan.other(log)), "last")
                    assert swapped is not None
                    ways |= {f"{row}, {NO_TRAFFIC}": own.ways[NO_TRAFFIC], f"{row}, {OTHER}": swapped.ways[""]}
                for name, scores in ways.items():
                    of_log = found.setdefault(name, {}).setdefault(log, {})
                    of_log[job.seed] = scores
    seeds = {
        log: {job.seed for row in plan.jobs for job in plan.of(row, log)}.intersection(
            *(by_log.get(log, {}) for by_log in found.values())
        )
        for log in plan.logs
    }
    means = {
        name: {
            log: _mean([each[seed] for seed in each if seed in seeds[log]])
            for log, each in by_log.items()
            if seeds[log]
        }
        for name, by_log in found.items()
    }
    return means, seeds, protocol


def _mean(scores: Sequence[Scores]) -> Scores:
    return {key: float(np.mean([each[key] for each in scores])) for key in scores[0]}


def _save(
    found: ByLog, seeds_by_log: Mapping[str, set[int]], declared: Declared, protocol: str, out: Path, *, quick: bool
) -> Path:
    """Print and write the tables; only logs that every row was tested on count in means and tests."""
    logs = [log for log in next(iter(found.values())) if all(log in by_log for by_log in found.values())]
    if not logs:
        raise UserError("no log has been tested with every model yet: run the same command again")
    seeds = sorted(set.union(*(seeds_by_log[log] for log in logs)))
    counts = sorted({len(seeds_by_log[log]) for log in logs})
    number = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else f"{counts[0]}"
    note = "SMOKE TEST, a few updates on a few scenes: no result. " if quick else ""
    interim = declared.interim(seeds, logs)
    if counts[0] < len(seeds):
        which = f"**Interim**: each log has {number} of {len(declared.seeds)} declared seeds, not all the same."
        interim = " ".join(filter(None, [which, declared.interim(declared.seeds, logs)]))
    ending = " ".join(filter(None, [".", interim, FITTED]))
    meta = {"logs": logs, "seeds": list(seeds), "protocol": protocol, "quick": quick, "fitted": FITTED}
    columns = [key for key in COLUMNS if all(key in found[row][log] for row in found for log in logs)]
    rows = compact({row: [by_log[log] for log in logs] for row, by_log in found.items()}, columns)
    title = f"{note}{protocol}; logs that were never seen, percent (mean ± std over {len(logs)} logs){ending}"
    path, _ = save_table(out / "carry_over", rows, meta | {"unit": PERCENT}, title=title)
    table = format_table(rows, title=title)
    each: list[dict[str, Any]] = [
        {"log": log, "model": row} | {key: 100.0 * found[row][log][key] for key in columns}
        for log in logs
        for row in found
    ]
    over = "1 seed" if counts == [1] else f"mean over {number} seeds"
    save_table(out / "logs", each, meta | {"unit": PERCENT}, title=f"{note}{protocol}, percent ({over}){ending}")
    tests = _tests(found, logs, declared)
    paired = f"Paired over {len(logs)} logs, points."
    once = _ONE_TRAINING if counts == [1] else ""
    title = " ".join(filter(None, [note.strip(), declared.sentence(), interim, paired, once, FITTED]))
    save_table(out / "effects", tests, meta | {"unit": POINTS}, title=title, digits=4)
    print(f"\n{table}\n\n{format_table(tests, title=title, digits=4)}")
    return path


def _tests(found: ByLog, logs: Sequence[str], declared: Declared) -> list[dict[str, Any]]:
    """Return one row for each claim.

    A claim about a row without a result is not tested, but counts in Holm's correction: leaving it out would make every
    other test easier to pass.
    """
    declaration, rows, chances = declared.declaration, [], []
    for claim in declaration.claims:
        treatment, control = claim.treatment, str(claim.control)
        row: dict[str, Any] = {"claim": claim.text, "treatment": treatment, "control": control}
        if missing := {treatment, control} - found.keys():
            chances.append(1.0)
            rows.append(
                row
                | dict.fromkeys(("difference", "std"), math.nan)
                | {"logs better": "-", "p": math.nan, "reason": f"no result of {min(missing)}"}
            )
            continue
        treated, plain = (
            np.array([found[name][log][declaration.primary] for log in logs]) for name in (treatment, control)
        )
        test = paired_difference(100.0 * treated, 100.0 * plain)
        chances.append(1.0 if np.isnan(test.p_value) else test.p_value)
        why = "one log" if len(logs) < 2 else f"{declaration.primary} is no number on some log"
        row |= {"difference": test.mean, "std": test.std, "logs better": f"{test.better} of {test.seeds}"}
        rows.append(row | {"p": test.p_value, "reason": why if np.isnan(test.p_value) else ""})
    for row, corrected in zip(rows, holm(chances), strict=True):
        if reason := row.pop("reason"):
            row |= {"p (Holm)": math.nan, "verdict": f"not tested ({reason})"}
            continue
        decided = "shown" if row["difference"] > 0.0 else "contradicted"
        row |= {"p (Holm)": corrected, "verdict": decided if corrected < declaration.alpha else "not shown"}
    return rows


def _draw(plan: Plan, failures: Sequence[Failure], out: Path) -> None:
    """Draw frames of each log with its truth and the predictions of two models that have not seen it."""
    if not can_draw():
        return
    failed = {failure.job.folder for failure in failures}
    for log in plan.logs:
        models = {}
        for row in plan.jobs:
            job = plan.of(row, log)[0]
            if job.folder not in failed:
                run = open_run(job.folder, "last")
                models[row] = Model(run.config.task, run.params[0], run.config.evaluation.batch_size)
        if models:
            pair = [row for row in _DRAWN if row in models][:2] or list(models)
            first = on_log(plan.of(next(iter(models)), log)[0].config, log)
            draw_models(first, models, pair, out / f"{log}.png")

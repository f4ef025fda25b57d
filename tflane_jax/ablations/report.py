"""Tables of a comparison, for each test set: scores of every model at its last and best checkpoint, paired tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.ablations.comparison import compact, shared_seeds, summarise
from tflane_jax.ablations.jobs import file_names
from tflane_jax.ablations.results import Results
from tflane_jax.ablations.scores import CHECKPOINTS, OWN_TEST
from tflane_jax.files.atomic import write_json
from tflane_jax.files.wording import counted
from tflane_jax.plots.tables import FRACTIONS, PERCENT, format_table, save_table
from tflane_jax.tasks import Task


def save_report(results: Results, task: Task, remarks: Mapping[str, Mapping[str, str]], out: Path) -> list[Path]:
    """Print the tables of every test set and save them; return the files, the table of the own test split first.

    `table.md` and `paired.md` are those of the own test split, `table-<name>.md` and so on those of other test sets.
    `scores.json` holds the scores at the last step by row: a list with an object for each seed, which names it
    (`seed`), in the order of the seeds.
    """
    written: list[Path] = []
    for test, suffix in suffixes(results).items():
        every = [
            scores
            for which in CHECKPOINTS
            for by_seed in results.rows(test, which).values()
            for scores in by_seed.values()
        ]
        metrics = [name for name in task.compared if all(name in scores for scores in every)]
        shown = [name for name in task.shown or task.compared if all(name in scores for scores in every)]
        written.append(_save_table(results, test, shown, task, remarks, out / f"table{suffix}"))
        if len(results.seeds) > 1:
            written += _save_paired(results, test, metrics, task, out / f"paired{suffix}")
        last = {
            row: [{"seed": seed, **scores} for seed, scores in by_seed.items()]
            for row, by_seed in results.rows(test, "last").items()
        }
        write_json(out / f"scores{suffix}.json", last)
        written.append(out / f"scores{suffix}.json")
    return written


def suffixes(results: Results) -> dict[str, str]:
    """Return the ending of the files of each test set, "" for the own test split."""
    return {OWN_TEST: "", **{name: f"-{file}" for name, file in file_names(results.tests).items()}}


def _save_table(
    results: Results,
    test: str,
    metrics: Sequence[str],
    task: Task,
    remarks: Mapping[str, Mapping[str, str]],
    stem: Path,
) -> Path:
    title = (
        f"{results.protocol(test)}, {results.title(test)}, {counted(len(results.seeds), 'seed')}, percent (mean ± std)"
    )
    rows: list[dict[str, Any]] = []
    for which in CHECKPOINTS:
        for row, by_seed in results.rows(test, which).items():
            (cells,) = compact({row: by_seed.values()}, metrics)
            cells = {"model": row, "checkpoint": which} | cells
            if which == "last":
                cells |= remarks.get(row, {})
            if len(by_seed) < len(results.seeds):
                cells["seeds"] = listed(by_seed)
            rows.append(cells)
    if missing := [model for model in results.models if not results.has(model)]:
        title += f"; no run of {', '.join(missing)} is complete"
    title = _with_warning(title, results, test)
    rows += task.quoted()
    meta = {"protocol": results.protocol(test), "seeds": list(results.seeds), "test": list(results.tests.get(test, ()))}
    meta["unit"] = PERCENT
    written = save_table(stem, rows, meta, title=title)[0]
    print("\n" + format_table(rows, title=title))
    return written


def _save_paired(results: Results, test: str, metrics: Sequence[str], task: Task, stem: Path) -> list[Path]:
    """Print and save the paired tests of every row against the control, over the seeds that both have.

    Nothing at a checkpoint where no row has two seeds with the control.
    """
    rows: list[dict[str, Any]] = []
    control, seeds = results.models[0], {}
    for which in CHECKPOINTS:
        table = results.rows(test, which)
        pairs = {row: shared_seeds(by_seed, table.get(control, {})) for row, by_seed in table.items()}
        if max((len(shared) for row, shared in pairs.items() if row != control), default=0) < 2:
            why = f"no two seeds with {control}" if results.has(control) else f"no run of {control}"
            print(f"\nno paired tests ({which} checkpoint, {results.title(test)}): {why}")
            continue
        seeds[which] = pairs
        for row in summarise(table, metrics, task.errors):
            shared = pairs[row["model"]]
            part = {} if len(shared) == len(results.seeds) else {"seeds": listed(shared) or "none"}
            rows.append({"checkpoint": which} | row | part)
    if not rows:
        return []
    over = "the seeds that both have" if any("seeds" in row for row in rows) else counted(len(results.seeds), "seed")
    title = f"{results.protocol(test)}, {results.title(test)}: paired differences to {control} ({FRACTIONS}), "
    title += f"two-sided t-test over {over}; p (Holm) is corrected for all tests of one checkpoint"
    title = _with_warning(title, results, test)
    meta = {"protocol": results.protocol(test), "seeds": seeds, "unit": FRACTIONS}
    written = save_table(stem, rows, meta, title=title, digits=4)[0]
    print("\n" + format_table(rows, title=title, digits=4))
    return [written]


def _with_warning(title: str, results: Results, test: str) -> str:
    """Return the title of a table, with a sentence below if its rows are measured by several protocols."""
    mixed = results.mixed_protocols(test)
    return f"{title}\n\n{mixed}" if mixed else title


def listed(seeds: Sequence[int] | Mapping[int, Any]) -> str:
    """Return seeds separated by commas."""
    return ", ".join(map(str, seeds))

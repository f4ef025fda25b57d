"""Tables of a comparison, for each test set: scores of every model at its last and best checkpoint, paired tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tflane_jax.ablations.comparison import Scores, Variant, compact, summarise
from tflane_jax.ablations.jobs import Tests, file_names
from tflane_jax.ablations.scores import CHECKPOINTS, OWN_TEST, Measured, Which
from tflane_jax.files.atomic import write_json
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.tasks import Task


@dataclass
class Results:
    """Scores of a comparison.

    Attributes:
        models: names, the control first.
        seeds: that were asked for.
        tests: further test sets, see `compare`.
        protocol: of the metrics, with its version.
        scores: by (test set, checkpoint), by row of the table, by seed. Rows are models, or "model, way to use it".
        owners: model of each row.
    """

    models: tuple[str, ...]
    seeds: tuple[int, ...]
    tests: Tests
    protocol: str = ""
    scores: dict[tuple[str, Which], dict[str, dict[int, Scores]]] = field(default_factory=dict)
    owners: dict[str, str] = field(default_factory=dict)

    def add(self, test: str, which: Which, model: str, seed: int, measured: Measured) -> None:
        """Add what was measured of a run."""
        self.protocol = measured.protocol
        for way, scores in measured.ways.items():
            row = f"{model}, {way}" if way else model
            self.owners[row] = model
            self.scores.setdefault((test, which), {}).setdefault(row, {})[seed] = scores

    def has(self, model: str) -> bool:
        """Return whether any run of a model was measured."""
        return model in self.owners.values()

    def by_seed(self) -> dict[str, Any]:
        """Return everything as JSON: by test set, checkpoint, row and seed."""
        content: dict[str, Any] = {}
        for (test, which), rows in self.scores.items():
            content.setdefault(test or "test", {})[which] = rows
        return content


def save_report(results: Results, task: Task, remarks: Mapping[str, Mapping[str, str]], out: Path) -> list[Path]:
    """Print the tables of every test set and save them; return the files, the table of the own test split first.

    `table.md` and `paired.md` are those of the own test split, `table-<name>.md` and so on those of other test sets.
    `scores.json` holds the scores at the last step by row, in the order of the seeds.
    """
    written: list[Path] = []
    for test, suffix in {OWN_TEST: "", **{k: f"-{v}" for k, v in file_names(results.tests).items()}}.items():
        every = [scores for which in CHECKPOINTS for row in _rows(results, test, which) for scores in row[1].values()]
        metrics = [name for name in task.compared if all(name in scores for scores in every)]
        written.append(_save_table(results, test, metrics, task, remarks, out / f"table{suffix}"))
        if len(results.seeds) > 1:
            written += _save_paired(results, test, metrics, task, out / f"paired{suffix}")
        last = {row: list(by_seed.values()) for row, by_seed in _rows(results, test, "last")}
        write_json(out / f"scores{suffix}.json", last)
        written.append(out / f"scores{suffix}.json")
    return written


def _rows(results: Results, test: str, which: Which) -> list[tuple[str, dict[int, Scores]]]:
    """Return the rows of a table and their scores by seed, in the order of models and seeds."""
    rows = results.scores.get((test, which), {})
    ordered = sorted(rows, key=lambda row: results.models.index(results.owners[row]))
    return [(row, {seed: rows[row][seed] for seed in results.seeds if seed in rows[row]}) for row in ordered]


def _save_table(
    results: Results,
    test: str,
    metrics: Sequence[str],
    task: Task,
    remarks: Mapping[str, Mapping[str, str]],
    stem: Path,
) -> Path:
    title = f"{results.protocol}, {_name(results, test)}, {_count(results.seeds)}, percent (mean ± std)"
    rows: list[dict[str, Any]] = []
    for which in CHECKPOINTS:
        for row, by_seed in _rows(results, test, which):
            (cells,) = compact([Variant(row, tuple(by_seed.values()))], metrics)
            cells = {"model": row, "checkpoint": which} | cells
            if which == "last":
                cells |= remarks.get(row, {})
            if len(by_seed) < len(results.seeds):
                cells["seeds"] = _listed(by_seed)
            rows.append(cells)
    if missing := [model for model in results.models if not results.has(model)]:
        title += f"; no run of {', '.join(missing)} is complete"
    rows += task.quoted()
    print("\n" + format_table(rows, title=title))
    meta = {"protocol": results.protocol, "seeds": list(results.seeds), "test": list(results.tests.get(test, ()))}
    return save_table(stem, rows, meta, title=title)[0]


def _save_paired(results: Results, test: str, metrics: Sequence[str], task: Task, stem: Path) -> list[Path]:
    """Print and save the paired tests over the seeds that all rows have; nothing without two of them or a control."""
    rows: list[dict[str, Any]] = []
    control, over, seeds = results.models[0], "", {}
    for which in CHECKPOINTS:
        table = _rows(results, test, which)
        shared = [seed for seed in results.seeds if table and all(seed in by_seed for _, by_seed in table)]
        if not results.has(control) or len(shared) < 2:
            why = f"no run of {control}" if not results.has(control) else "fewer than two seeds that all models have"
            print(f"\nno paired tests ({which} checkpoint, {_name(results, test)}): {why}")
            continue
        variants = [Variant(row, tuple(by_seed[seed] for seed in shared)) for row, by_seed in table]
        rows += [{"checkpoint": which} | row for row in summarise(variants, metrics, task.errors)]
        seeds[which] = shared
        whole = len(shared) == len(results.seeds)
        over = over or (_count(shared) if whole else f"the seeds that all models have ({_listed(shared)})")
    if not rows:
        return []
    title = f"{results.protocol}, {_name(results, test)}: paired differences to {control}, two-sided t-test over {over}"
    title += "; p (Holm) is corrected for all tests of one checkpoint"
    print("\n" + format_table(rows, title=title, digits=4))
    return [save_table(stem, rows, {"protocol": results.protocol, "seeds": seeds}, title=title, digits=4)[0]]


def _name(results: Results, test: str) -> str:
    return f"test set {test} ({' '.join(results.tests[test])})" if test else "test split"


def _count(seeds: Sequence[int]) -> str:
    return f"{len(seeds)} seed{'s' if len(seeds) > 1 else ''}"


def _listed(seeds: Sequence[int] | Mapping[int, Any]) -> str:
    return ", ".join(map(str, seeds))

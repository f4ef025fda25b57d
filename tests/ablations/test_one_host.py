"""Rows of a seed come from one training of their host, where recorded runs and those at hand start from different ones.

A host that is trained on another kind of processor is another one.
"""

import json
from dataclasses import replace

import pytest

from tests.ablations.test_tables import small
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations.paper.table import TableRow
from tflane_jax.ablations.reuse import find_archives
from tflane_jax.ablations.table_plan import plan_table
from tflane_jax.ablations.table_run import run_table

pytestmark = pytest.mark.usefixtures("cheap")
OTHER = ("of another machine",)


@pytest.fixture(scope="module")
def table(tiny):
    rows = TableRow("base", f"{tiny}:baseline", start="host"), TableRow("tfm", str(tiny), start="host")
    return small(tiny, rows=rows, hosts=(TableRow("host", str(tiny), ("--optim.lr", "0.1")),))


@pytest.fixture(scope="module")
def trained(table, cheap, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained")
    run_table(table, range(2), out)
    return out


def recorded(trained, origins):
    """Return the record of the table, with other starts for some rows; without the rows that have None."""
    archive = find_archives(trained, ["paper.9"])["paper.9"]
    runs = {
        key: replace(run, facts=replace(run.facts, origins=origins[run.row] or run.facts.origins))
        for key, run in archive.runs.items()
        if run.row in origins
    }
    assert len(runs) == 2 * len(origins)
    return replace(archive, runs=runs)


def taken(table, out, archive):
    """Return for each row whether its runs are recorded ones."""
    jobs = plan_table(table, range(2), out, archive=archive).jobs
    return {row: [job.recorded is not None for job in of_row] for row, of_row in jobs.items()}


def test_the_training_that_most_rows_have_is_taken(table, trained, capsys):
    archive = recorded(trained, {"base": OTHER})
    assert taken(table, trained, archive) == {"base": [False] * 2, "tfm": [False] * 2}
    run_table(table, range(2), trained, archive=archive, finished=True)
    assert json.loads((trained / "paper.9" / "summary.json").read_text())["mixed hosts"] == []


def test_otherwise_recorded_runs_are_taken_before_those_at_hand(table, trained):
    both = recorded(trained, {"base": OTHER, "tfm": OTHER})
    assert taken(table, trained, both) == {"base": [True] * 2, "tfm": [True] * 2}
    assert taken(table, trained, recorded(trained, {"base": ()})) == {"base": [True] * 2, "tfm": [False] * 2}


def test_a_seed_does_not_decide_for_another(table, trained):
    archive = recorded(trained, {"base": OTHER, "tfm": OTHER})
    kept = {key: run for key, run in archive.runs.items() if (run.row, run.seed) != ("tfm", 1)}
    assert taken(table, trained, replace(archive, runs=kept)) == {"base": [True, False], "tfm": [True, False]}


def test_rows_that_were_trained_nowhere_else_stay(table, trained, tmp_path):
    archive = recorded(trained, {"base": OTHER, "tfm": ()})
    assert taken(table, tmp_path, archive) == {"base": [True] * 2, "tfm": [True] * 2}

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


@pytest.fixture(scope="module")
def with_host(table, cheap, tmp_path_factory):
    """Return the table with its host as a row, and its runs."""
    table = replace(table, rows=(*table.rows, *table.hosts))
    out = tmp_path_factory.mktemp("with host")
    run_table(table, range(2), out)
    return table, out


def test_a_row_that_is_the_host_takes_the_training_that_the_others_started_from(with_host, capsys):
    table, out = with_host
    archive = recorded(out, {"host": None})
    assert all(run.facts.gives for run in archive.runs.values())
    other = {key: replace(run, facts=replace(run.facts, gives=OTHER)) for key, run in archive.runs.items()}
    assert taken(table, out, archive) == {"base": [False] * 2, "tfm": [False] * 2, "host": [True] * 2}
    assert taken(table, out, replace(archive, runs=other))["host"] == [False] * 2


def test_a_row_that_is_another_training_of_the_host_is_told(with_host, tmp_path):
    table, out = with_host
    archive = recorded(out, {"base": None, "tfm": None, "host": None})
    other = {
        key: replace(run, facts=replace(run.facts, gives=OTHER)) if (run.row, run.seed) == ("host", 1) else run
        for key, run in archive.runs.items()
    }
    for place, runs in (("same", archive.runs), ("other", other)):
        run_table(table, range(2), tmp_path / place, archive=replace(archive, runs=runs), finished=True)
    told = {
        place: json.loads((tmp_path / place / "paper.9" / "summary.json").read_text())["mixed hosts"]
        for place in ("same", "other")
    }
    mixed = "Rows of seed 1 do not all start from one known training of host: they may differ by their hosts."
    assert told == {"same": [], "other": [mixed]}

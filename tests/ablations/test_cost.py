"""What tables cost by their own figures, beside what was recorded, and beside the runs that a store would hold."""

import json
import re
from dataclasses import replace

import pytest

from tests.shared import ROOT
from tflane_jax.ablations.paper.cost import core_minutes
from tflane_jax.ablations.paper.table import PaperTable, Quoted, TableRow
from tflane_jax.ablations.store import run_key
from tflane_jax.ablations.tables import TABLES


def test_runs_that_tables_share_cost_once():
    host = TableRow("host", "h")
    rows = (TableRow("a", "c:a"), TableRow("b", "c:b", start="host"), host)
    table = PaperTable(
        name="paper.9",
        title="a small table",
        rows=rows,
        claims=(),
        primary="all/DET_l",
        columns=("all/DET_l",),
        quoted=Quoted("no paper", ()),
        hosts=(host,),
        seeds=3,
        minutes=2.0,
        host_minutes=20.0,
    )
    assert core_minutes([table]) == 3 * (2 + 2 + 20)
    fewer = replace(table, name="paper.10", seeds=2)
    assert core_minutes([table, fewer]) == core_minutes([fewer, table]) == core_minutes([table])
    other_host = replace(table, hosts=(TableRow("host", "h:other"),), rows=rows[:2])
    assert core_minutes([table, other_host]) == core_minutes([table]) + 3 * (2 + 20)
    assert core_minutes([table, replace(table, steps=9)]) == 2 * core_minutes([table])
    assert core_minutes([table.lengthened(4)]) == 4 * core_minutes([table])


@pytest.mark.slow
def test_the_cost_of_all_tables_is_that_of_the_runs_that_a_store_would_hold():
    costs = {}
    for table in TABLES.values():
        configs = table.configs(table.hosts)
        hosts = {name: run_key(config, {}) for name, config in configs.items()}
        runs = {
            run_key(config, {}, hosts.get(row.start)): table.minutes
            for row, config in zip(table.rows, table.configs(table.rows).values(), strict=True)
        }
        runs |= dict.fromkeys(hosts.values(), table.host_minutes)
        assert core_minutes([table]) == pytest.approx(table.seeds * sum(runs.values()))
        for seed in range(table.seeds):
            for key, minutes in runs.items():
                costs[key, seed] = max(costs.get((key, seed), 0.0), minutes)
    assert core_minutes(TABLES.values()) == pytest.approx(sum(costs.values()))


def test_the_page_says_what_the_tables_cost():
    of_papers = [t for name, t in TABLES.items() if re.fullmatch(r"tf_lane\.\d|gtn_lane\.1|markers\.[1-4]", name)]
    assert len(of_papers) == 12
    papers, every = (f"{core_minutes(tables) / 60:.0f}" for tables in (of_papers, TABLES.values()))
    page = " ".join((ROOT / "docs" / "comparisons.md").read_text().split())
    assert f"twelve tables of the papers take {papers} hours of one core, all tables {every}, by times" in page


def test_estimates_are_what_was_recorded():
    for path in (ROOT / "docs" / "results").glob("*.json"):
        table, summary = TABLES[path.stem], json.loads(path.read_text())
        if not all(device.startswith("cpu") for device in summary["devices"]):
            continue  # figures are of one core
        recorded = summary["core minutes of a run"]
        hosts = {host.name for host in table.hosts}
        rows = (table.minutes, recorded.keys() - hosts), (table.host_minutes, recorded.keys() & hosts)
        for estimate, names in rows:
            minutes = [recorded[name] for name in names]
            assert not minutes or estimate == pytest.approx(sum(minutes) / len(minutes), abs=1.0)

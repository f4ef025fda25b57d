"""What tables cost on one core, by their own figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tflane_jax.ablations.paper.table import PaperTable, TableRow

_Run = tuple[object, ...]


def core_minutes(tables: Iterable[PaperTable]) -> float:
    """Return the minutes that the updates of all runs take on one core; runs that tables share count once.

    Of different figures that tables give for a run, the highest counts, so that no table costs more than all together.
    Runs are equal here if their rows refer to the same configuration, settings, steps, host and seed: no configuration
    is loaded. A test holds that equal ones are written alike.
    """
    found: dict[_Run, float] = {}
    for table in tables:
        hosts = {host.name: _run(table, host, {}) for host in table.hosts}
        costs = {_run(table, row, hosts): table.minutes for row in table.rows}
        costs |= dict.fromkeys(hosts.values(), table.host_minutes)
        for seed in range(table.seeds):
            for run, minutes in costs.items():
                found[(*run, seed)] = max(found.get((*run, seed), 0.0), minutes)
    return sum(found.values())


def _run(table: PaperTable, row: TableRow, hosts: Mapping[str, _Run]) -> _Run:
    start = hosts[row.start] if row.start else None
    return row.config, row.settings, table.steps, table.steps_factor, start

"""Where the runs of a table come from: from their folders, or from a record of scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.paper.table import TableRow
from tflane_jax.ablations.recorded import Facts
from tflane_jax.errors import UserError
from tflane_jax.training.fine_tuning import origins
from tflane_jax.training.provenance import commit_of, read_provenance
from tflane_jax.training.records import read_records


def facts(job: Job) -> Facts:
    """Return provenance, duration and validation curve of a finished run."""
    if job.recorded is not None:
        return job.recorded.facts
    starts, records = read_provenance(job.folder), read_records(job.folder / "metrics.jsonl")
    seconds = [float(record["seconds"]) for record in records if "seconds" in record]
    return Facts(
        commits=tuple(sorted({commit_of(start["git"]) for start in starts if start.get("git")})),
        devices=tuple(sorted({start["device"] for start in starts})),
        seconds=seconds[-1] if seconds else None,
        validation=tuple(record for record in records if record["split"] == "val"),
        origins=tuple(sorted({_hash(origin) for start in starts for origin in start.get("init_from", ())})),
    )


def given_hashes(job: Job) -> tuple[str, ...]:
    """Return the hashes by which runs that start from a finished run name it; () where a record lacks them."""
    if job.recorded is not None:
        return job.recorded.facts.gives
    try:
        (own,) = origins(str(job.folder), job.config.training.seeds, hash_parameters=True)
    except UserError:  # without checkpoints any more, it can still be measured from its kept scores
        return ()
    return own["parameters"], own["content"]


def _hash(origin: Mapping[str, Any]) -> str:
    """Return the hash of what a run started from: of the parameters, or of the files in earlier runs."""
    return origin.get("parameters", origin["content"])


def mixed_hosts(rows: Sequence[TableRow], trained: Mapping[str, Sequence[Job]]) -> list[str]:
    """Return a sentence for each host of which the rows of a seed do not all start from one training.

    A host that is trained on two kinds of processors differs in the last bits first, and then in its scores, so that
    such rows differ in more than what the table compares. Rows whose start is not recorded count as others; a row that
    is the host itself counts as another if it is known to be one.
    """
    found: dict[str, dict[int, set[tuple[str, ...]]]] = {row.start: {} for row in rows if row.start}
    runs = [(row, job) for row in rows for job in trained.get(row.name, ())]
    for row, job in runs:
        if row.start:
            found[row.start].setdefault(job.seed, set()).add(facts(job).origins)
    for row, job in runs:
        if found.get(row.name):  # it is the host itself, and rows start from it
            started, gives = found[row.name].get(job.seed, set()), given_hashes(job)
            if gives and not any(set(gives) & set(of_row) for of_row in started):
                started.add(gives)
    sentences = []
    for host, by_seed in found.items():
        if mixed := sorted(seed for seed, origins in by_seed.items() if len(origins) > 1):
            seeds = "seed" if len(mixed) == 1 else "seeds"
            sentences.append(
                f"Rows of {seeds} {', '.join(map(str, mixed))} do not all start from one known training of {host}: "
                "they may differ by their hosts."
            )
    return sentences


def row_minutes(trained: Mapping[str, Sequence[Job]]) -> dict[str, float]:
    """Return the time of a run's updates in each row, in minutes, mean over runs; no evaluation, no compiling."""
    found = {}
    for name, jobs in trained.items():
        seconds = [one for job in jobs if (one := facts(job).seconds) is not None]
        if seconds:
            found[name] = round(sum(seconds) / len(seconds) / 60, 1)
    return found

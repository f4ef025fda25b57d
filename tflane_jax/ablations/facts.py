"""Where the runs of a table come from: from their folders, or from a record of scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.recorded import Facts
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
    )


def row_minutes(trained: Mapping[str, Sequence[Job]]) -> dict[str, float]:
    """Return the time of a run's updates in each row, in minutes, mean over runs; no evaluation, no compiling."""
    found = {}
    for name, jobs in trained.items():
        seconds = [one for job in jobs if (one := facts(job).seconds) is not None]
        if seconds:
            found[name] = round(sum(seconds) / len(seconds) / 60, 1)
    return found

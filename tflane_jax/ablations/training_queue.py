"""The runs that a comparison still has to train or measure: those that wait, and those that other processes have.

A run that starts from another one of them waits until that one is complete, or has failed. Whether it is done is
decided then: a run whose origin was trained anew is not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.reservations import Reservations
from tflane_jax.errors import UserError
from tflane_jax.training.run_folder import is_locked

LOOK_SECONDS = 10.0


class Queue:
    """Jobs in the order in which they are to be done.

    A job that another process has reserved, or trains, is set aside and looked at again, until it is done or free.
    """

    def __init__(self, jobs: Sequence[Job], reservations: Reservations, is_done: Callable[[Job], bool]) -> None:
        self._is_done = is_done
        self._elsewhere: list[Job] = []
        self._taken: list[Job] = []
        self._every = {job.place: job for job in jobs}
        undone = {job.place for job in jobs if not is_done(job)}
        self._waiting = [job for job in jobs if undone & {job.place, *(each.place for each in self._lineage(job))}]
        self._reservations = reservations
        self._looked = time.monotonic()

    def __len__(self) -> int:
        """Return the number of jobs that are neither done nor taken."""
        return len(self._waiting) + len(self._elsewhere)

    @property
    def elsewhere(self) -> Sequence[Job]:
        """Jobs that other processes have."""
        return self._elsewhere

    def take(self, mine: Collection[Any] = (), others: Collection[Any] = ()) -> Job | None:
        """Reserve the next job and return it; None if others have all that are left, or those that they start from.

        Args:
            mine, others: see `choose`.
        """
        self._look_again()
        while ready := self._ready():
            job = choose(ready, mine, others)
            self._waiting.remove(job)
            if not self._reservations.take(job.folder):
                self._elsewhere.append(job)
            elif self._is_done(job):  # another process has just finished it
                self._reservations.release(job.folder)
            elif is_locked(job.folder):  # by `tflane train`, or by what a killed process has left behind
                self._reservations.release(job.folder)
                self._elsewhere.append(job)
            else:
                self._taken.append(job)
                return job
        return None

    def check_origins(self, job: Job) -> None:
        """Raise UserError if a run that a job starts from has failed: it would start from any checkpoint of that."""
        for origin in self._origins(job):
            if not origin.is_complete() and job.start() != "resume":
                raise UserError(f"{origin.label or origin.folder}, the run that it starts from, is not complete")

    def done(self, job: Job) -> None:
        """Release a job that is done, or failed."""
        self._taken.remove(job)
        self._reservations.release(job.folder)

    def _origins(self, job: Job) -> list[Job]:
        """Return the jobs of this queue, done or not, that a job starts from."""
        return [self._every[place] for place in job.starts_from if place in self._every]

    def _lineage(self, job: Job) -> list[Job]:
        """Return the jobs of this queue that a job starts from, and those that these start from."""
        found: dict[Path, Job] = {}
        new = self._origins(job)
        while new:
            found |= {each.place: each for each in new}
            new = [each for one in new for each in self._origins(one) if each.place not in found]
        return list(found.values())

    def _ready(self) -> list[Job]:
        """Return the waiting jobs that start from none that is still to be done."""
        pending = {job.place for job in (*self._waiting, *self._elsewhere, *self._taken)}
        ready = [job for job in self._waiting if not pending.intersection(job.starts_from)]
        # Runs that start from one another: the first one is refused.
        return ready or ([] if self._elsewhere or self._taken else self._waiting)

    def _look_again(self) -> None:
        """Let jobs that are free again wait; forget those that other processes have finished."""
        if time.monotonic() - self._looked > LOOK_SECONDS:
            self._waiting += [job for job in self._elsewhere if not self._is_done(job)]
            self._elsewhere, self._looked = [], time.monotonic()


def choose(waiting: Sequence[Job], mine: Collection[Any], others: Collection[Any]) -> Job:
    """Return the job that a worker takes next.

    All models get a seed before any gets the next one, so that a comparison stopped early has pairs. Within a seed, a
    model that this worker has compiled goes first, then one that no other worker has.

    Args:
        waiting: in the order of seeds; not empty.
        mine: tasks that this worker has compiled.
        others: tasks that other workers have.
    """
    first = [job for job in waiting if job.config.training.seeds == waiting[0].config.training.seeds]
    compiled = (job for job in first if job.config.task in mine)
    fresh = (job for job in first if job.config.task not in others)
    return next(compiled, None) or next(fresh, first[0])

"""Training many runs, one after the other in this process, or several at a time in worker processes.

Workers also evaluate the runs. A training that fails is noted, and the others go on.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tflane_jax import accelerators
from tflane_jax.ablations.cores import cores_each, cores_of_workers
from tflane_jax.ablations.jobs import Failure, Job
from tflane_jax.ablations.reservations import Reservations
from tflane_jax.ablations.scores import code_digest, is_measured, measure_all
from tflane_jax.ablations.training_queue import Queue
from tflane_jax.child_processes import SAFE_PATH, end_with_parent, environment_of_children, spared_interrupts
from tflane_jax.config_io import first_difference
from tflane_jax.errors import Interrupted, UserError
from tflane_jax.files.wording import counted
from tflane_jax.memory import give_back_freed_memory, huge_pages_for_children, keep_freed_memory
from tflane_jax.progress import progress_bar, write
from tflane_jax.run_checks import check_run
from tflane_jax.runs import build_data, train_run
from tflane_jax.startup import leave, showing
from tflane_jax.training.array_files import first_line
from tflane_jax.training.provenance import thread_setting
from tflane_jax.training.runtime import configure_jax

_POLL_SECONDS = 1.0


Finished = Callable[[Job], None]
"""What is done with a run as soon as this process or one of its workers has finished it."""


def train_all(
    jobs: Sequence[Job], parallel: int, cores: int | None = None, finished: Finished | None = None
) -> list[Failure]:
    """Train every job that is not complete, in this process or `parallel` at a time in workers; return what failed.

    Workers have `cores` cores each, or equal shares of all for None. With `cores`, one at a time is a worker too.
    Workers also measure runs that are complete, but not measured by this state of the code.

    Several processes, also of several machines that share a folder, may train the same jobs: each takes those that no
    other has reserved, and returns when all are complete. `finished` is not called for those that others train; an
    error that it raises is a failure of that run.
    """
    code_digest()  # of the code that is running: its files may change while it trains
    with Reservations() as reservations:
        if parallel == 1 and cores is None:
            return _train_here(Queue(jobs, reservations, lambda job: job.is_complete()), finished)
        return _train_in_workers(Queue(jobs, reservations, is_measured), jobs, parallel, cores, finished)


def worker_threads(parallel: int, cores: int | None = None) -> dict[str, Any]:
    """Return the thread setting in which `train_all` trains; raise UserError for more cores than there are.

    A process that is going to have workers reserves no memory of GPUs from here on: asking JAX for its devices would.
    """
    accelerators.disable_triton_gemm()  # as workers do
    if parallel == 1 and cores is None:
        return thread_setting()
    accelerators.leave_to_workers()
    return thread_setting(cores_each(parallel, cores) or None, devices=1)


@contextlib.contextmanager
def noted(job: Job, failures: list[Failure]) -> Iterator[None]:
    """Add an error inside the block to `failures`, and write it to the job's log, with a traceback if unexpected."""
    try:
        yield
    except Exception as error:
        known = isinstance(error, UserError)
        failures.append(Failure(job, str(error) if known else f"{type(error).__name__}: {error}"))
        _log(job, f"tflane: {error}" if known else traceback.format_exc())


def _tell(failures: Sequence[Failure]) -> None:
    for failure in failures:
        write(f"{failure}; the others go on")


def _log(job: Job, text: str) -> None:
    try:
        job.log.parent.mkdir(parents=True, exist_ok=True)
        with job.log.open("a", encoding="utf-8") as log:
            print(text, file=log)
    except OSError as error:  # a full disk, which may be why the training failed
        write(f"cannot write {job.log} ({error.strerror}):\n{text}")


def _train_here(queue: Queue, finished: Finished | None) -> list[Failure]:
    failures: list[Failure] = []
    waits = False
    while len(queue):
        if (job := queue.take()) is None:
            if not waits:
                write(f"waiting for {counted(len(queue), 'run')} that other processes train")
            waits = True
            time.sleep(_POLL_SECONDS)
            continue
        with noted(job, failures):
            queue.check_origins(job)
            write(f"train {job.label or job.folder}")
            if (number := train_run(job.config, job.folder, start=job.start(), drawn="end").asked_by) is not None:
                raise Interrupted(number)  # all of it; the same command resumes what was written
            if finished is not None:
                write(f"evaluate {job.label or job.folder}")
                finished(job)
        queue.done(job)
        _tell([failure for failure in failures if failure.job is job])
    return failures


def _train_in_workers(
    queue: Queue, jobs: Sequence[Job], parallel: int, cores: int | None, finished: Finished | None
) -> list[Failure]:
    failures: list[Failure] = []
    built: set[Any] = set()
    with contextlib.ExitStack() as stack:
        shares = stack.enter_context(cores_of_workers(min(parallel, len(queue)), cores_each(parallel, cores)))
        workers = [stack.enter_context(Worker(share, slot, len(shares))) for slot, share in enumerate(shares)]
        stack.callback(lambda: [worker.end() for worker in workers])  # before any of them is waited for
        total, made = sum(job.config.training.steps for job in jobs), sum(job.resumes_at() for job in jobs)
        anew = {job.place for job in jobs if job.start() == "overwrite"}  # their folders hold records of other runs
        bar = stack.enter_context(
            progress_bar(total=total, initial=made, desc=f"train and measure {counted(len(jobs), 'run')}", unit="step")
        )
        while len(queue) or any(worker.job for worker in workers):
            for worker in workers:
                others = {task for other in workers if other is not worker for task in other.tasks}
                if worker.job is None and (chosen := queue.take(worker.tasks, others)) is not None:
                    with noted(chosen, failures):
                        queue.check_origins(chosen)
                        _build(chosen, built)
                        worker.begin(chosen)
                    if worker.job is None:
                        queue.done(chosen)
                    _tell([failure for failure in failures if failure.job is chosen])
            time.sleep(_POLL_SECONDS)
            bar.set_postfix_str(_running(workers, queue), refresh=False)
            begun = [*(worker.job for worker in workers if worker.job is not None), *queue.elsewhere]
            anew = _not_begun(anew, begun)
            bar.update(_steps(jobs, anew) - bar.n)
            for worker in workers:
                if (done := worker.poll()) is None:
                    continue
                if done.failure is not None:
                    failures.append(done.failure)
                    _tell([done.failure])
                elif finished is not None:
                    with noted(done.job, failures):
                        finished(done.job)
                queue.done(done.job)
    return failures


def _not_begun(anew: set[Path], begun: Sequence[Job]) -> set[Path]:
    """Return the folders among those of runs that are trained anew which still hold the records of other runs."""
    return anew - {job.place for job in begun if job.start() != "overwrite"}


def _steps(jobs: Sequence[Job], anew: Collection[Path]) -> int:
    """Return the updates that all runs have made; the folders of `anew` still hold the records of other runs."""
    return sum(job.step() for job in jobs if job.place not in anew)


def _running(workers: Sequence[Worker], queue: Queue) -> str:
    """Return what is being trained, for the progress bar."""
    names = [f"{worker.job.label}{worker.stage}" for worker in workers if worker.job is not None]
    if queue.elsewhere:
        names.append(f"{len(queue.elsewhere)} by other processes")
    return "; ".join(names)


def _build(job: Job, built: set[Any]) -> None:
    """Make the data that a job needs, with all cores, unless an earlier job needed them too.

    Raises UserError before that for a run that must fail.
    """
    if not job.is_complete():
        check_run(job.config)
    for split in ("train", "val", "test"):
        if (source := job.config.data.source(split)) not in built:
            build_data(source)
            built.add(source)


class Done(NamedTuple):
    """A job that a worker has finished, and why it failed; None if it did not."""

    job: Job
    failure: Failure | None


class Worker:
    """A process on its own cores and GPU that trains one job after the other, and compiles every model once."""

    def __init__(self, cores: list[int], slot: int = 0, parallel: int = 1) -> None:
        """Prepare worker number `slot` of `parallel`; an empty list of cores leaves it all."""
        self._cores, self._accelerator = cores, accelerators.of_worker(slot, parallel)
        self.job: Job | None = None
        self.tasks: set[Any] = set()
        self.stage = ""

    def __enter__(self) -> Worker:
        self._begin_process()
        return self

    def _begin_process(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, far = context.Pipe()
        given = far, self._cores, self._accelerator
        self._process: Any = context.Process(target=_train_jobs, args=given, daemon=True)
        with huge_pages_for_children(), environment_of_children(SAFE_PATH), spared_interrupts():
            self._process.start()
        far.close()  # so that reading fails, instead of waiting, once the process is gone
        self.tasks.clear()

    def end(self) -> None:
        """Tell the process to end, without waiting for it."""
        if self.job is None and self._process.exitcode is None:
            with contextlib.suppress(OSError):
                self._pipe.send(None)
        else:  # an error ends the comparison: the same command resumes what was written
            self._process.terminate()
        self._pipe.close()  # so that a process that has stopped waits for no further job

    def __exit__(self, *_: object) -> None:
        if not self._pipe.closed:
            self.end()
        self._process.join()

    def begin(self, job: Job) -> None:
        """Let the process train a job; raise UserError for one that cannot be sent there."""
        if self._process.exitcode is not None:
            self._pipe.close()
            self._begin_process()
        self.job, self.stage = job, ""
        self.tasks.add(job.config.task)
        job.log.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._pipe.send(job)
        except OSError:
            pass  # a process that is gone is found by `poll`
        except Exception as error:
            self.job = None
            raise UserError(
                f"its configuration cannot be sent to a worker process ({first_line(error)}): define own classes and "
                "functions at the top level of a module, or leave out --jobs and --cores"
            ) from error

    def poll(self) -> Done | None:
        """Read what the process has told; return the current job, and forget it, once it is done.

        A process that is gone is replaced when the next job begins.
        """
        while self.job is not None and self._pipe.poll():
            try:
                what, text = self._pipe.recv()
            except (EOFError, OSError):
                self._process.join()
                what, text = "done", _death(self._process.exitcode)
                _log(self.job, f"tflane: {text}")
            if what == "done":
                job, self.job = self.job, None
                return Done(job, None if text is None else Failure(job, text))
            self.stage = f" ({text})" if text else ""
        return None


def _death(code: int) -> str:
    if code >= 0:
        return f"its worker process ended with code {code}"
    name = signal.Signals(-code).name
    hint = ", as the system does when memory runs out" if name == "SIGKILL" else ""
    return f"its worker process was killed by {name}{hint}"


def _check_setting(job: Job) -> None:
    """Raise UserError if this process would not train as planned, as on a CPU because JAX found no GPU."""
    if difference := first_difference(thread_setting(), dict(job.threads)):
        raise UserError(f"the process that trains has another setting than was planned: {difference}")


def _train(job: Job) -> None:
    result = train_run(job.config, job.folder, start=job.start(), progress=False, drawn="end")
    if result.stopped_by is not None:
        raise UserError(f"stopped by {signal.Signals(result.stopped_by).name} after step {result.step}")


def _train_jobs(pipe: Any, cores: list[int], accelerator: Mapping[str, str]) -> None:
    """Train and measure the jobs that come through the pipe; answer ("done", None) for each, or why it failed.

    Before that, what a job is doing is told as ("stage", name), and ("stage", "") at its end. Messages go to the job's
    log.
    """
    keep_freed_memory()
    end_with_parent()
    code_digest()  # as in `train_all`
    if cores:
        os.sched_setaffinity(0, cores)  # XLA takes the size of its thread pool from this
    os.environ.update(accelerator)

    def tell(what: str, text: str | None) -> None:
        with contextlib.suppress(OSError):  # the comparison is gone
            pipe.send((what, text))

    def begin(stage: str) -> None:
        if stage:
            print(f"{time.strftime('%H:%M:%S')} {stage}", flush=True)
        tell("stage", stage)

    try:
        while (job := _next(pipe)) is not None:
            failures: list[Failure] = []
            log = job.log.open("a", encoding="utf-8", errors="backslashreplace")
            with log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
                configure_jax()
                with noted(job, failures), showing(begin):
                    if not job.is_complete():
                        _check_setting(job)
                        _train(job)
                    measure_all(job)
            give_back_freed_memory()
            tell("done", failures[0].reason if failures else None)
    except KeyboardInterrupt as error:  # the comparison tells of it
        code = 128 + getattr(error, "number", signal.SIGINT)
        leave(code)
        sys.exit(code)


def _next(pipe: Any) -> Job | None:
    with contextlib.suppress(EOFError, OSError):  # the comparison is gone
        return pipe.recv()
    return None

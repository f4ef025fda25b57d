"""Processes that this program starts: they end with it, also when it is killed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import resource_tracker

SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""With it, a child does not look for Python's own modules in the working directory.

It starts as `python -c`, which puts that folder first until the child gets the search path of its parent.
"""


@contextlib.contextmanager
def spared_interrupts() -> Iterator[None]:
    """Processes that this thread starts inside the block never see Ctrl-C, which reaches the whole process group.

    Their parent ends them. A handler of their own would come too late: they import modules for seconds before it.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # else multiprocessing starts it with the first process, and takes the block away
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def environment_of_children(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables, which child processes inherit, for as long as the block lasts."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def end_workers(pool: ProcessPoolExecutor) -> None:
    """End the processes of a pool at once and wait until they are gone; `shutdown` alone waits for running tasks."""
    for process in list((pool._processes or {}).values()):  # `terminate_workers` (Python 3.14) does not wait
        process.terminate()
    pool.shutdown(cancel_futures=True)


def end_with_parent() -> None:
    """Let this process, which `multiprocessing` started, end at once when its parent is gone; returns immediately.

    A parent that is killed (SIGKILL, out of memory) cannot stop its workers. Without this, a waiting worker would wait
    forever, and a training one would go on and keep its run locked.
    """
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

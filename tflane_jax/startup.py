"""What a command does before its first step or result: stages, shown as they begin, and compiling that can be ended.

XLA compiles in C++, for up to minutes, and Python handles a signal only when that returns. `compiled` therefore lets
another thread compile while the main thread waits: Ctrl-C and SIGTERM act at once. XLA itself cannot be stopped, so
the thread goes on until it is done, or until `leave` ends the process.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, TypeVar

from tflane_jax.progress import write

T = TypeVar("T")
_REFRESH_SECONDS = 0.5


class _Display:
    """Shows stages and counts the seconds that each takes."""

    def __init__(self, show: Callable[[str], None] | None) -> None:
        self._show, self._began = show, time.perf_counter()
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        with self._line(name):
            yield
        if self._show is not None:
            self._show("")
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def _line(self, name: str) -> contextlib.AbstractContextManager[None]:
        if self._show is None and sys.stderr.isatty():
            return _updated_line(name)
        if self._show is not None:
            self._show(name)
        else:
            write(f"[{time.perf_counter() - self._began:5.1f} s] {name}")
        return contextlib.nullcontext()

    def ready(self) -> None:
        """Print the time since the beginning and that of each stage, and reset both."""
        if self._show is None and self.seconds:
            parts = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.seconds.items())
            write(f"ready after {time.perf_counter() - self._began:.1f} s ({parts})")
        self.seconds, self._began = {}, time.perf_counter()


_shown: ContextVar[_Display | None] = ContextVar("shown", default=None)


@contextlib.contextmanager
def showing(show: bool | Callable[[str], None]) -> Iterator[None]:
    """Show the stages inside the block on standard error; no-op inside another `showing` that shows them.

    Args:
        show: whether to show them: on a terminal one line with the time of the stage, updated; elsewhere a line for
            each, with the time since the beginning. A function gets the name instead, and "" at the end of a stage.
    """
    if not show or _shown.get() is not None:
        yield
        return
    token = _shown.set(_Display(None if show is True else show))
    try:
        yield
    finally:
        _shown.reset(token)


@contextlib.contextmanager
def stage(name: str) -> Iterator[None]:
    """Show that a stage begins, inside `showing`; elsewhere do nothing."""
    display = _shown.get()
    with contextlib.nullcontext() if display is None else display.stage(name):
        yield


def ready() -> None:
    """Print the time until now and that of each stage, inside `showing`."""
    if (display := _shown.get()) is not None:
        display.ready()


@contextlib.contextmanager
def _updated_line(name: str) -> Iterator[None]:
    """Show a line with the seconds since it began, which vanishes at the end of the block."""
    from tqdm import tqdm

    ended = threading.Event()
    with tqdm(desc=name, bar_format="{desc} ({elapsed})", leave=False) as line:

        def refresh() -> None:
            while not ended.wait(_REFRESH_SECONDS):
                line.refresh()

        thread = threading.Thread(target=refresh, name="stage", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


# ---------------------------------------------------------------------------------------------------------------------
# Compiling

_left_running: list[threading.Event] = []
"""An event for each thread whose wait was interrupted; set when the thread is done."""


def compiled(
    program: Any,
    *arguments: Any,
    what: str,
    context: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext,
) -> Any:
    """Return a program of `jax.jit` compiled for given arguments, or their shapes. Later calls of `program` reuse it.

    Args:
        program: from `jax.jit`.
        arguments: of the program.
        what: what it computes, for the names of the stages.
        context: in which the program is traced, lowered and compiled.
    """
    with context():
        with stage(f"tracing {what}"):
            traced = program.trace(*arguments)
        with stage(f"lowering {what}"):
            lowered = traced.lower()

    def compile_it() -> Any:
        with context():  # contexts of JAX hold for one thread
            return lowered.compile()

    with stage(f"compiling {what}"):
        return in_another_thread(compile_it)


def in_another_thread(work: Callable[[], T]) -> T:
    """Return `work()`, done by another thread, so that a signal can end the wait in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return work()
    results: list[T] = []
    errors: list[BaseException] = []
    done = threading.Event()  # an interrupted `join` marks a running thread as ended (Python 3.11)

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:
            errors.append(error)
        finally:
            done.set()

    try:
        threading.Thread(target=run, name="compile").start()
        while not done.wait(_REFRESH_SECONDS):  # on Windows, Ctrl-C does not interrupt a wait without a timeout
            pass
    except BaseException:
        _left_running.append(done)
        raise
    if errors:
        raise errors[0]
    return results[0]


def leave(code: int) -> None:
    """End the process at once if an abandoned thread still compiles: a normal exit would wait for it."""
    if not all(done.is_set() for done in _left_running):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)

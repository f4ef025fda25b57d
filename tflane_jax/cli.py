"""`tflane`, the command line: the parser and the call of the chosen command.

`tflane_jax.commands.arguments` says what each command takes, `tflane_jax.commands` what it does. A command's module is
imported when it runs, and nothing slow is imported here, so `tflane --help` is instant.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import itertools
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from tflane_jax.commands.arguments import comparisons, data, markers, models
from tflane_jax.commands.arguments.shared import CommandParser
from tflane_jax.errors import Interrupted, UserError, not_installed, printable
from tflane_jax.memory import keep_freed_memory
from tflane_jax.own_modules import add_imports, import_own, take_imports
from tflane_jax.startup import leave

_AGAIN_SECONDS = 0.1
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 2 an error of the user's, 128 + n ended by signal n."""
    _open_closed()
    keep_freed_memory()
    if arguments is None:  # the program itself
        _escape_unprintable()
        warnings.showwarning = OneLineWarnings(warnings.showwarning)
    with _ending_on_sigterm(), _signals_not_lost():
        code = exit_code(lambda: _run(sys.argv[1:] if arguments is None else arguments))
    if arguments is None:  # the program itself
        leave(code)
    return code


def _open_closed() -> None:
    """Let output that was closed before the start (`tflane ... >&-`) go nowhere, instead of into the next file."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (open until the end)


def _escape_unprintable() -> None:
    """Print characters that the encoding of standard output lacks as escapes, as standard error does."""
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None and sys.stdout.errors == "strict":
        reconfigure(errors="backslashreplace")


def _run(arguments: Sequence[str]) -> int:
    """Read the arguments, run the command and return its exit code."""
    _check_filled(arguments)
    modules, others = take_imports(arguments)
    add_imports(modules)
    import_own()  # before names of own datasets are read
    parser = build_parser()
    options, rest = parser.parse_known_args(others)
    if rest and not options.takes_overrides:
        if not hasattr(options, "inputs") or any(argument.startswith("-") for argument in rest):
            parser.error(f"unknown argument {rest[0]}: see tflane {options.command} --help")
        options.inputs += map(Path, rest)  # of `tflane predict RUN --threshold 0.4 PHOTO`, which argparse leaves over
        rest = []
    command = getattr(importlib.import_module(f"tflane_jax.commands.{options.module}"), options.function)
    code = (command(options, rest) if options.takes_overrides else command(options)) or 0
    sys.stdout.flush()  # here, where its errors are told
    return code


def _check_filled(arguments: Sequence[str]) -> None:
    """Raise UserError for an empty argument, which as a path would be the working directory, and for a comment's #."""
    for before, argument in itertools.pairwise(("tflane", *arguments)):
        if not argument or re.fullmatch("--[^=]+=", argument):
            place = f"{argument.removesuffix('=')} has an empty value" if argument else f"an empty word after {before}"
            raise UserError(f"{place}: is a variable of the shell not set?")
        if argument == "#":
            raise UserError(
                "this shell reads # as a word: leave out the comment, or `setopt interactive_comments` before"
            )


def exit_code(run: Callable[[], int]) -> int:
    """Run a command and return its exit code; errors that are the user's become a message."""
    try:
        return run()
    except UserError as error:
        _tell(f"tflane: {error}")
        return 2
    except ModuleNotFoundError as error:
        if (told := not_installed(error)) is None:
            raise
        _tell(f"tflane: {told}")
        return 2
    except KeyboardInterrupt as error:
        _tell("tflane: stopped")
        return 128 + getattr(error, "number", signal.SIGINT)
    except MemoryError as error:
        _tell(f"tflane: memory is full: {error or 'ask for less at a time'}")
        return 2
    except BrokenPipeError:  # `tflane ... | head`
        _drop_output(sys.stdout)
        return 128 + getattr(signal, "SIGPIPE", 13)  # Windows has none
    except RuntimeError as error:
        # By name, because importing JAX is slow. Other libraries say the same of a full disk.
        if type(error).__name__ != "JaxRuntimeError" or "RESOURCE_EXHAUSTED" not in str(error):
            raise
        remedies = "a smaller training.batch_size or evaluation.batch_size, training.accumulate, precision or remat"
        _tell(f"tflane: the memory of the device is full: {remedies} (docs/scale.md)")
        return 2
    except OSError as error:
        if error.filename is None and error.errno in _FULL:
            _tell(f"tflane: cannot print: {error.strerror}; make room or print elsewhere")
            _drop_output(sys.stdout)
            return 2
        # pathlib raises these wherever it looks for such a file
        if error.filename is None or error.errno not in (errno.ENAMETOOLONG, errno.EACCES, errno.EPERM):
            raise
        remedy = "" if error.errno == errno.ENAMETOOLONG else ": give yourself the right, or choose another path"
        _tell(f"tflane: {error.filename}: {error.strerror}{remedy}")
        return 2


def _tell(text: str) -> None:
    """Print a line on standard error; where that cannot be written, the exit code alone tells of the error.

    Texts of files may be in it: none of them controls the terminal.
    """
    try:
        print(printable(text, "\n\t"), file=sys.stderr)
    except OSError:
        _drop_output(sys.stderr)


def _drop_output(stream: TextIO) -> None:
    """Print nothing more there: what is left would fail again when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class OneLineWarnings:
    """Shows the warnings of this package as one line each, and every text once; others as `show` does."""

    def __init__(self, show: Callable[..., None]):
        self._show, self._shown = show, set[str]()

    def __call__(self, message: Warning | str, category: type[Warning], *place: Any, **named: Any) -> None:
        if category.__module__.partition(".")[0] != "tflane_jax":
            self._show(message, category, *place, **named)
        elif str(message) not in self._shown:
            self._shown.add(str(message))
            _tell(f"tflane: warning: {message}")


@contextlib.contextmanager
def _ending_on_sigterm() -> Iterator[None]:
    """Let SIGTERM end a command like Ctrl-C, so that it leaves no processes and temporary files behind."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        del frame
        raise Interrupted(number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def _signals_not_lost() -> Iterator[None]:
    """Send a signal again if Python ignored what it raised, as in callbacks of the garbage collector (JAX has one)."""
    before = sys.unraisablehook

    def hook(ignored: Any) -> None:
        if isinstance(error := ignored.exc_value, KeyboardInterrupt):
            number = getattr(error, "number", signal.SIGINT)
            threading.Timer(_AGAIN_SECONDS, os.kill, (os.getpid(), number)).start()
        else:
            before(ignored)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = CommandParser(prog="tflane", description="Lane perception with priors, in JAX.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    models.train(commands)
    models.evaluate(commands)
    models.predict(commands)
    models.submit(commands)
    models.convert(commands)
    models.export(commands)
    data.data(commands)
    data.cache(commands)
    models.summary(commands)
    comparisons.compare(commands)
    comparisons.tables(commands)
    comparisons.carry_over(commands)
    comparisons.sweep(commands)
    comparisons.score(commands)
    markers.markers(commands)
    comparisons.demo(commands)
    comparisons.bench(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())

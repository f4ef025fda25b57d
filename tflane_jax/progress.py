"""Progress of long work with its rate and the time left: a bar where lines can be updated, elsewhere a line at times.

A log file keeps every state of a bar that is drawn into it; `progress_bar` writes whole lines there, few of them.
tqdm is imported in functions: the command line imports this file before it knows whether there is progress to show.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")
# Between two lines in a log.
_LINE_SECONDS = 30.0
_KNOWN_TOTAL = "{desc}: {percentage:3.0f}% {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
_UNKNOWN_TOTAL = "{desc}: {n_fmt}{unit} [{elapsed}, {rate_fmt}{postfix}]"


def progress_bar(
    items: Iterable[T] | None = None,
    desc: str = "",
    *,
    unit: str,
    total: int | None = None,
    initial: int = 0,
    disable: bool = False,
) -> tqdm[T] | ProgressLines[T]:
    """Return what shows progress on standard error: iterate over it, or call its `update` inside a `with` block.

    Args:
        items: to iterate over.
        desc: what is done.
        unit: of what is counted, singular.
        total: to be done; None for the number of items, if they have one.
        initial: already done.
        disable: show nothing.
    """
    # In a notebook, standard error is no terminal, but its lines are updated.
    if disable or sys.stderr.isatty() or "ipykernel" in sys.modules:
        from tqdm import tqdm

        return cast("tqdm[T]", tqdm(items, desc, total, unit=unit, initial=initial, disable=disable))
    return ProgressLines(items, desc, unit, total, initial)


def write(text: str) -> None:
    """Print a line on standard error, above progress bars."""
    from tqdm import tqdm

    tqdm.write(text, file=sys.stderr)


class ProgressLines(Generic[T]):
    """Progress as lines of a log: one every half minute, and one at the end. As much of tqdm as is used here.

    The rate counts from the first progress on, because compiling comes before it; at the end it is that of the whole.
    """

    def __init__(self, items: Iterable[T] | None, desc: str, unit: str, total: int | None, initial: int) -> None:
        if total is None and hasattr(items, "__len__"):
            total = len(items)  # pyright: ignore[reportArgumentType]
        self._items, self._unit, self._total, self._initial = items, unit, total, initial
        self._desc, self._postfix = desc, ""
        self._began = self._written = time.monotonic()
        self._first: tuple[float, int] | None = None  # when the first progress was made, and how far it came
        self.n = initial

    def update(self, count: int = 1) -> None:
        """Count what has been done since the last call."""
        self.n += count
        if count and self._first is None:
            self._first = time.monotonic(), self.n
        if time.monotonic() - self._written >= _LINE_SECONDS:
            self._write(self._rate())

    def set_description(self, desc: str) -> None:
        """Name what is done from now on."""
        self._desc = desc

    def set_postfix_str(self, text: str, refresh: bool = True) -> None:
        """Set what stands behind the rate; it is shown with the next line."""
        self._postfix = text

    def set_postfix(self, refresh: bool = True, **values: Any) -> None:
        """Set values that stand behind the rate, by name."""
        self.set_postfix_str(", ".join(f"{name}={value}" for name, value in values.items()))

    def __iter__(self) -> Iterator[T]:
        assert self._items is not None
        with self:
            for item in self._items:
                yield item
                self.update()

    def __enter__(self) -> ProgressLines[T]:
        return self

    def __exit__(self, *_: object) -> None:
        self._write(rate=None)

    def _rate(self) -> float:
        """Return the progress in a second; 0, which is shown as unknown, before the second progress."""
        since, done = self._first or (0.0, self.n)
        return (self.n - done) / (time.monotonic() - since) if self.n > done else 0.0

    def _write(self, rate: float | None) -> None:
        """Write a line; with a rate of None, it is the mean since the beginning."""
        from tqdm import tqdm

        self._written = time.monotonic()
        line = tqdm.format_meter(
            self.n,
            self._total or 0,
            self._written - self._began,
            prefix=self._desc,
            unit=self._unit,
            initial=self._initial,
            rate=rate,
            postfix=self._postfix or None,
            bar_format=_KNOWN_TOTAL if self._total else _UNKNOWN_TOTAL,
        )
        print(line, file=sys.stderr, flush=True)

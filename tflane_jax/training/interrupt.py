"""Ctrl-C and SIGTERM as a request to stop: at once before the first step, then after the current one."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType

from tflane_jax.errors import Interrupted


class StopRequest:
    """Inside the block, SIGINT and SIGTERM set `signal`; a second one has its usual effect.

    Between `at_once` and `after_the_step`, they raise `Interrupted` as well. Outside the main thread, signals are not
    touched, and those that the process ignores stay ignored: a shell lets its background commands ignore Ctrl-C.
    """

    signal: int | None = None
    _at_once = False

    def __enter__(self) -> StopRequest:
        self._before = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._on_signal)
        return self

    def at_once(self) -> None:
        """Let a signal, also one that came before, raise `Interrupted`."""
        self._at_once = True
        if self.signal is not None:
            raise Interrupted(self.signal)

    def after_the_step(self) -> None:
        """Only set `signal` from now on. It may be set already: Python ignores errors raised in some places."""
        self._at_once = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.signal = number
        self._restore_handlers()
        if self._at_once:
            raise Interrupted(number)

    def _restore_handlers(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore_handlers()

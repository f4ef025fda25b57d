"""Processes that this program starts: they end with it, also when it is killed."""

from __future__ import annotations

import multiprocessing
import os
import threading


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

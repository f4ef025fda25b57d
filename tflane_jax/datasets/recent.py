"""Values that are made when they are asked for, of which the last ones are kept."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Recent(Generic[K, V]):
    """Calling it returns the value of a key: the kept one, or a new one. Threads may call it.

    A pickled copy keeps nothing at first, so that a worker process gets no values that it may never need.

    Args:
        make: key -> value. Of the keys that are asked for at once, one is made after the other.
        most: number of values that are kept; of more, those asked for longest ago are dropped.
    """

    def __init__(self, make: Callable[[K], V], most: int):
        self._make, self._most = make, most
        self._kept: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self):
        return Recent, (self._make, self._most)

    def __call__(self, key: K) -> V:
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self._make(key)
            self._kept.move_to_end(key)
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
            return self._kept[key]

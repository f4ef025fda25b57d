"""Thread-safe caches: the values asked for last, and values that are kept as long as an object.

A value is made on first use, once. Only threads that ask for the same value wait meanwhile.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class KeyLocks:
    """A lock for each key. Calling it gives a context in which one thread at a time works for the key."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._used: dict[Hashable, tuple[threading.Lock, int]] = {}  # and by how many threads

    @contextlib.contextmanager
    def __call__(self, key: Hashable) -> Iterator[None]:
        with self._lock:
            own, users = self._used.get(key, (threading.Lock(), 0))
            self._used[key] = own, users + 1
        try:
            with own:
                yield
        finally:
            with self._lock:
                _, users = self._used.pop(key)
                if users > 1:
                    self._used[key] = own, users - 1


class KeptWith(Generic[V]):
    """Values (never None) made once for an object and a key, and kept as long as the object lives. Threads may call it.

    An error of `make` leaves nothing behind.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[int, Hashable], V] = {}
        self._making = KeyLocks()

    def __call__(self, owner: object, key: Hashable, make: Callable[[], V]) -> V:
        full = id(owner), key
        if (found := self._kept.get(full)) is None:
            with self._making(full):
                if (found := self._kept.get(full)) is None:
                    found = self._kept[full] = make()
                    weakref.finalize(owner, self._kept.pop, full, None)
        return found


class Recent(Generic[K, V]):
    """Calling it returns the value of a key: the kept one, or a new one. Threads may call it.

    A pickled copy keeps nothing at first, so that a worker process gets no values that it may never need.

    Args:
        make: key -> value. Threads that ask for one key at once wait for the first of them; after an error, the next
            one tries again. Other keys are made meanwhile.
        most: number of values that are kept; of more, those asked for longest ago are dropped.
    """

    def __init__(self, make: Callable[[K], V], most: int):
        self._make, self._most = make, most
        self._kept: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()
        self._making = KeyLocks()

    def __reduce__(self):
        return Recent, (self._make, self._most)

    def __call__(self, key: K) -> V:
        with contextlib.suppress(KeyError):
            return self._asked_for(key)
        with self._making(key):
            with contextlib.suppress(KeyError):
                return self._asked_for(key)
            value = self._make(key)
            with self._lock:
                self._kept[key] = value
                if len(self._kept) > self._most:
                    self._kept.popitem(last=False)
            return value

    def _asked_for(self, key: K) -> V:
        """Return a kept value, the last to be dropped from now on; raises KeyError for one that is not kept."""
        with self._lock:
            self._kept.move_to_end(key)
            return self._kept[key]

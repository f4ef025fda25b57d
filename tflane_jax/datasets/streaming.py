"""Examples that workers load and augment shortly before they are needed, with grain.

The caller decides the order of examples (`datasets.batches`, from seed and step alone). Neither the number of workers
nor an interruption changes it, and the position in the data is the step in the checkpoint.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np

from tflane_jax.cores import own_cores
from tflane_jax.datasets.base import IndexedExamples, made
from tflane_jax.datasets.leaves import Form, check_form, example_leaves
from tflane_jax.datasets.plausible import check_lanes
from tflane_jax.errors import UserError, missing_extra
from tflane_jax.limits import Count, CountOrZero

# Draws in place of an example that is not wanted.
_MOST_DRAWS = 1000
# In grain's message about a worker process that ended without an error of its own.
_DIED = "terminated unexpectedly"


@dataclass(frozen=True)
class StreamingConfig:
    """Where examples are kept, and the workers that load and augment them.

    Batches do not depend on it, except with `task.empty_frames=skip`: see `empty_frames.without_empty`.

    Attributes:
        where: "memory": all examples of a split are read once and kept; "disk": each is read, decoded and prepared
            shortly before it is needed; "auto": what suits the dataset (docs/scale.md has the table).
        threads: threads that load and augment examples, in each process; 0 does so on request. None takes one less
            than the cores of this process (`cores.own_cores`), divided among `processes`, but at least one.
        ahead: examples loaded ahead of the current one, in each process. None: twice the threads, but at least 16.
        processes: further processes that load, for datasets whose code holds Python's global lock (decoding images
            does not). The caller's script must then be guarded by `if __name__ == "__main__":`. Not for examples in
            memory.
    """

    where: Literal["auto", "memory", "disk"] = "auto"
    threads: CountOrZero | None = None
    ahead: Count | None = None
    processes: CountOrZero = 0

    def workers(self) -> tuple[int, int]:
        """Return threads and examples ahead, with the numbers that None stands for in this process."""
        each = max((own_cores(os.environ) - 1) // max(self.processes, 1), 1)
        threads = each if self.threads is None else self.threads
        return threads, max(2 * threads, 16) if self.ahead is None else self.ahead


class Request(NamedTuple):
    """A requested example: its index, and the key (run seed, step, place in the batch) of its augmentation."""

    index: int
    key: tuple[int, int, int]


Prepare = Callable[[Any, tuple[int, int, int]], Any]
"""Augmentation: (example in numpy, (run seed, step, place in the batch)) -> example for the training step."""


@dataclass(frozen=True)
class InOrder:
    """Requests of all examples in order, or of the same places of every batch; beyond the end the last one is repeated.

    Attributes:
        examples: number of examples.
        batch_size: of the batches.
        places: places in each batch that are requested.
    """

    examples: int
    batch_size: int = 1
    places: range = range(1)

    def __call__(self, number: int) -> Request:
        batch, place = divmod(number, len(self.places))
        number = batch * self.batch_size + self.places[place]
        return Request(min(number, self.examples - 1), (0, 0, number))


@dataclass(frozen=True)
class Streamed:
    """A dataset that is read while it is used.

    Attributes:
        dataset: its examples all have the same shapes; several threads call it, or it is pickled for processes.
        config: workers.
        select: example -> the part of it to keep; None keeps all.
        wanted: example -> whether to use it. In place of one that is not wanted, `stream` yields another, drawn with
            the request's key. None uses all.
        form: of what `select` keeps of the first example; None where examples are known to be alike.
    """

    dataset: IndexedExamples
    config: StreamingConfig = StreamingConfig()
    select: Callable[[Any], Any] | None = None
    wanted: Callable[[Any], bool] | None = None
    form: Form | None = None

    def __len__(self) -> int:
        return len(self.dataset)

    def example(self, index: int) -> Any:
        """Return the selected part of one example."""
        example = made(self.dataset, index)
        example = example if self.select is None else self.select(example)
        if self.form is not None:
            check_form(self.dataset.name, index, example_leaves(example), self.form)
            check_lanes(self.dataset.name, index, example)
        return example

    def requested(self, request: Request) -> Any:
        """Return the requested example, or the one drawn in its place; see `wanted`.

        Raises UserError if the first `_MOST_DRAWS` are not wanted.
        """
        draws = np.random.default_rng(request.key)
        index = request.index
        for _ in range(_MOST_DRAWS):
            example = self.example(index)
            if self.wanted is None or self.wanted(example):
                return example
            index = int(draws.integers(len(self)))
        raise UserError(
            f"{self.dataset.name}: of {_MOST_DRAWS} examples none has any lanes: set task.empty_frames=keep"
        )

    def stream(self, requests: Callable[[int], Request], count: int, prepare: Prepare | None = None) -> Generator[Any]:
        """Yield the examples of requests 0 to count - 1, in this order.

        Args:
            requests: number -> request; called in workers.
            count: number of examples.
            prepare: applied to every example, in the worker that loads it.

        Raises:
            UserError: grain is not installed, the settings are out of range, a file cannot be read, or a worker process
                died.
            Exception: what else `dataset.example` raises.
        """
        (threads, ahead), processes = self.config.workers(), self.config.processes
        if min(threads, processes) < 0 or ahead < 1:
            raise UserError(f"{self.config}: threads and processes must be at least 0, ahead at least 1")
        grain = _grain()
        examples = grain.MapDataset.range(count).map(_Load(self, requests, prepare))
        options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=ahead if threads else 0)
        loaded = examples.to_iter_dataset(options)
        if processes:
            _mark_flags_as_parsed()
            loaded = loaded.mp_prefetch(grain.MultiprocessingOptions(num_workers=processes))
        iterator = iter(loaded)
        try:
            yield from iterator
        except RuntimeError as error:
            if _DIED not in str(error):
                raise
            raise UserError(
                f"{self.dataset.name}: a process that loads examples died: either memory ran out (set fewer "
                "data.loading.processes, or 0), or /dev/shm is full, which containers often limit to 64 MB (docker run "
                '--shm-size 2g), or a script started the training outside `if __name__ == "__main__":` (these '
                "processes import the script)"
            ) from error
        finally:
            iterator.close()


@dataclass(frozen=True)
class _Load:
    """Turns the number of a request into its example."""

    source: Streamed
    requests: Callable[[int], Request]
    prepare: Prepare | None

    def __call__(self, number: int) -> Any:
        request = self.requests(int(number))
        try:
            example = self.source.requested(request)
        except OSError as error:
            raise UserError(f"{self.source.dataset.name}: cannot read example {request.index}: {error}") from error
        return example if self.prepare is None else self.prepare(example, request.key)


def _mark_flags_as_parsed() -> None:
    """Let grain start processes in a program that does not parse absl flags: grain reads a flag of its own."""
    from absl import flags

    if not flags.FLAGS.is_parsed():
        flags.FLAGS.mark_as_parsed()


def _grain() -> ModuleType:
    try:
        import grain
    except ImportError as error:
        raise missing_extra("reading datasets while training needs grain", "images") from error
    return grain

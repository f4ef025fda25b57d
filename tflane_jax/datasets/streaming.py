"""Datasets too large for memory: examples are loaded by workers shortly before they are needed, with grain.

Which example comes when is decided by whoever asks (`datasets.batches`: by seed and step alone), so that neither the
number of workers nor a stop in between changes anything, and the position is the step that the checkpoint holds.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

from tflane_jax.datasets.base import IndexedExamples
from tflane_jax.errors import UserError


@dataclass(frozen=True)
class StreamingConfig:
    """Workers; they change the speed and nothing else.

    Attributes:
        threads: that load examples, in each process; 0 loads when an example is asked for.
        ahead: examples loaded ahead of the one that is needed, in each process.
        processes: further processes to load in, for datasets whose making holds Python's lock (decoding images does
            not). They need the caller's script to be guarded by `if __name__ == "__main__":`.
    """

    threads: int = 4
    ahead: int = 16
    processes: int = 0


class Request(NamedTuple):
    """One example that is wanted: its index, and the key (run seed, step, place in the batch) of its augmentation."""

    index: int
    key: tuple[int, int, int]


Prepare = Callable[[Any, tuple[int, int, int]], Any]
"""(an example, numpy, and the run's seed, the step and the place in the batch) -> what the step sees of it."""


@dataclass(frozen=True)
class Streamed:
    """A dataset that is read while it is used.

    Attributes:
        dataset: its examples all have the same shapes; it is called by several threads, or sent to processes (pickle).
        config: workers.
        select: what to keep of an example, None is all of it.
    """

    dataset: IndexedExamples
    config: StreamingConfig = StreamingConfig()
    select: Callable[[Any], Any] | None = None

    def __len__(self) -> int:
        return len(self.dataset)

    def example(self, index: int) -> Any:
        """Return one example, of it what is selected."""
        example = self.dataset.example(index)
        return example if self.select is None else self.select(example)

    def stream(self, requests: Callable[[int], Request], count: int, prepare: Prepare | None = None) -> Generator[Any]:
        """Yield the examples that requests 0 to count - 1 name, in this order.

        Args:
            requests: called in workers.
            count: how many.
            prepare: applied to every example, in the worker that loads it.

        Raises:
            UserError: grain is not installed, or settings that cannot work; and what `dataset.example` raises.
        """
        if min(self.config.threads, self.config.processes) < 0 or self.config.ahead < 1:
            raise UserError(f"{self.config}: threads and processes must be at least 0, ahead at least 1")
        grain = _grain()
        wanted = grain.MapDataset.range(count).map(_Load(self, requests, prepare))
        ahead = self.config.ahead if self.config.threads else 0
        loaded = wanted.to_iter_dataset(grain.ReadOptions(num_threads=self.config.threads, prefetch_buffer_size=ahead))
        if self.config.processes:
            _mark_flags_as_parsed()
            loaded = loaded.mp_prefetch(grain.MultiprocessingOptions(num_workers=self.config.processes))
        iterator = iter(loaded)
        try:
            yield from iterator
        finally:
            iterator.close()


@dataclass(frozen=True)
class _Load:
    """Turns the number of a request into its example."""

    source: Streamed
    requests: Callable[[int], Request]
    prepare: Prepare | None

    def __call__(self, number: int) -> Any:
        index, key = self.requests(int(number))
        example = self.source.example(index)
        return example if self.prepare is None else self.prepare(example, key)


def _mark_flags_as_parsed() -> None:
    """Let grain start processes in a program that has no absl flags: it asks for one of its own."""
    from absl import flags

    if not flags.FLAGS.is_parsed():
        flags.FLAGS.mark_as_parsed()


def _grain() -> ModuleType:
    try:
        import grain
    except ImportError as error:
        raise UserError("reading datasets while training needs grain: pip install 'tflane_jax[images]'") from error
    return grain

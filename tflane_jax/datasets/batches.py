"""Batches: which examples each step uses, gathered while the step before runs.

Examples are arrays in memory (stacked, numpy leaves with a leading axis) or a `datasets.streaming.Streamed`. Both give
the same batches. `in_workers` lets the workers of a `Streamed` augment examples that are in memory.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from tflane_jax.datasets.base import FrameInfo
from tflane_jax.datasets.streaming import InOrder, Prepare, Request, Streamed, StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.scene import row_of, stack_examples

__all__ = [
    "Prepare",
    "batch_indices",
    "batches",
    "chosen_examples",
    "count",
    "first_example",
    "in_workers",
    "ordered_batches",
    "prepared",
]


def batch_indices(seed: int, step: int, examples: int, batch_size: int) -> Int[np.ndarray, " b"]:
    """Return the examples of one step.

    Every epoch is another permutation, drawn from (seed, epoch). Batches run through the epochs without gaps: a batch
    may hold the end of one epoch and the start of the next. The indices depend on the step alone, so that a resumed
    run continues with the same batches.
    """
    epochs, places = np.divmod(step * batch_size + np.arange(batch_size), examples)
    return np.concatenate(
        [_permutation(seed, int(epoch), examples)[places[epochs == epoch]] for epoch in np.unique(epochs)]
    )


@functools.lru_cache(maxsize=64)
def _permutation(seed: int, epoch: int, examples: int) -> Int[np.ndarray, " n"]:
    order = np.random.default_rng([seed, epoch]).permutation(examples)
    order.flags.writeable = False
    return order


def count(arrays: Any) -> int:
    """Return the number of examples."""
    return len(arrays) if isinstance(arrays, Streamed) else len(jax.tree.leaves(arrays)[0])


def first_example(arrays: Any) -> Any:
    """Return one example; raises UserError if there is none."""
    if count(arrays) == 0:
        raise UserError("there are no examples: nothing can be trained or evaluated on them")
    return arrays.example(0) if isinstance(arrays, Streamed) else row_of(arrays, 0)


def chosen_examples(arrays: Any, indices: Sequence[int]) -> Any:
    """Return some examples, stacked."""
    if isinstance(arrays, Streamed):
        return stack_examples([arrays.example(index) for index in indices])
    return jax.tree.map(lambda leaf: leaf[list(indices)], arrays)


def in_workers(arrays: Any, config: StreamingConfig) -> Any:
    """Return examples so that the threads of `config` augment them.

    The thread that gathers batches does so, which gives the same ones, without threads or grain. Streamed examples are
    returned as they are: their workers augment them.
    """
    if isinstance(arrays, Streamed) or config.threads == 0 or find_spec("grain") is None:
        return arrays
    return Streamed(_Rows(arrays), replace(config, processes=0))


def prepared(batch: Any, prepare: Prepare, seed: int, step: int) -> Any:
    """Return stacked examples, augmented as in the given step."""
    size = len(jax.tree.leaves(batch)[0])
    return stack_examples([prepare(row_of(batch, i), (seed, step, i)) for i in range(size)])


def batches(
    arrays: Any,
    seeds: Sequence[int],
    steps: range,
    batch_size: int,
    prepare: Prepare | None = None,
    *,
    share: tuple[int, int] = (0, 1),
    place: Callable[[Any], Any] = jax.device_put,
) -> Generator[list[Any]]:
    """Yield the batches of each step on the device, one for each seed; a thread gathers the next ones meanwhile.

    Args:
        arrays: examples, see the module's docstring.
        seeds: of the run; each has its own order.
        steps: the steps to yield batches for.
        batch_size: examples of a step (and seed).
        prepare: augments each example with the key (seed, step, place in the batch of all processes); called in the
            workers of a `Streamed`, or in that thread.
        share: (index, count) of this process among those that divide every batch (`jax.process_index()`,
            `jax.process_count()`); it gets its part of the rows.
        place: puts these rows on the device, or on several (`devices.divided`).

    Raises:
        ValueError: the processes cannot divide a batch evenly.
    """
    index, processes = share
    if batch_size % processes:
        raise ValueError(f"{processes} processes cannot share batches of {batch_size} evenly")
    rows = batch_size // processes
    order = _Order(tuple(seeds), steps.start, count(arrays), batch_size, range(index * rows, (index + 1) * rows))

    def gathered(step: int) -> list[Any]:
        parts = []
        for seed in seeds:
            indices = batch_indices(seed, step, order.examples, batch_size)[order.places]
            # Not np.take: that copies the whole of a leaf that is a broadcast view.
            part = jax.tree.map(lambda leaf, indices=indices: leaf[indices], arrays)
            if prepare is not None:
                keys = [(seed, step, row) for row in order.places]
                part = stack_examples([prepare(row_of(part, i), key) for i, key in enumerate(keys)])
            parts.append(part)
        return parts

    def streamed(step: int) -> list[Any]:
        return [stack_examples([next(stream) for _ in order.places]) for _ in seeds]

    stream: Generator[Any] = _nothing()
    if isinstance(arrays, Streamed):
        stream = arrays.stream(order, len(steps) * len(seeds) * rows, prepare)

    def fetch(step: int) -> list[Any]:
        parts = streamed(step) if isinstance(arrays, Streamed) else gathered(step)
        return [place(part) for part in parts]

    with contextlib.closing(stream), ThreadPoolExecutor(1, thread_name_prefix="batches") as pool:
        ahead = None
        for step in steps:
            batch = fetch(step) if ahead is None else ahead.result()
            ahead = pool.submit(fetch, step + 1) if step + 1 in steps else None
            yield batch


def ordered_batches(arrays: Any, batch_size: int, share: tuple[int, int] = (0, 1)) -> Iterator[tuple[range, Any]]:
    """Yield all examples once in order: their indices, and a batch (numpy) that begins with them.

    The last batch is filled up with copies of the last example, so that all batches have the same size.

    Args:
        arrays: examples, see the module's docstring.
        batch_size: examples of a batch.
        share: (index, count) of this process among those that divide every batch evenly; it gets its own rows alone.

    Raises UserError for a batch of no examples.
    """
    if batch_size < 1:
        raise UserError(f"batches of {batch_size} examples hold none: give a batch_size of 1 or more")
    examples, rows = count(arrays), batch_size // share[1]
    places = range(share[0] * rows, (share[0] + 1) * rows)
    starts = range(0, examples, batch_size)
    stream: Generator[Any] = _nothing()
    if isinstance(arrays, Streamed):
        stream = arrays.stream(InOrder(examples, batch_size, places), len(starts) * rows)
    with contextlib.closing(stream):
        for start in starts:
            if isinstance(arrays, Streamed):
                batch = stack_examples([next(stream) for _ in places])
            else:
                filled = np.minimum(start + np.array(places), examples - 1)
                batch = jax.tree.map(lambda leaf, rows=filled: leaf[rows], arrays)
            yield range(start, min(start + batch_size, examples)), batch


def _nothing() -> Generator[Any]:
    yield from ()


@dataclass(frozen=True)
class _Order:
    """Requests of a training: by step, then by seed, then by place in this process's part of the batch."""

    seeds: tuple[int, ...]
    first_step: int
    examples: int
    batch_size: int
    places: range

    def __call__(self, number: int) -> Request:
        rest, place = divmod(number, len(self.places))
        step, seed = divmod(rest, len(self.seeds))
        step, seed, place = self.first_step + step, self.seeds[seed], self.places[place]
        index = batch_indices(seed, step, self.examples, self.batch_size)[place]
        return Request(int(index), (seed, step, place))


class _Rows:
    """Examples in memory as a dataset."""

    name = "examples in memory"

    def __init__(self, arrays: Any):
        self.arrays = arrays

    def __len__(self) -> int:
        return count(self.arrays)

    def example(self, index: int) -> Any:
        return row_of(self.arrays, index)

    def info(self, index: int) -> FrameInfo:
        return FrameInfo(self.name, f"example {index}", 0, np.eye(4))

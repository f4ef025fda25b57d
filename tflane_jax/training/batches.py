"""Which examples a step sees, and having them ready when it starts."""

from __future__ import annotations

import functools
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

Prepare = Callable[[Any, tuple[int, int]], Any]
"""(a batch, numpy, and the run's seed with the step) -> the batch that the step sees: seeded augmentation."""


def batch_indices(seed: int, step: int, examples: int, batch_size: int) -> Int[np.ndarray, " b"]:
    """Return the examples of one step.

    Every epoch is a permutation of its own, drawn from (seed, epoch), and the batches run through them without gaps: a
    batch at the seam takes the rest of one epoch and the start of the next. The step alone says where one is, so
    that a resumed run goes on with the same batches.
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


def batches(
    arrays: Any, seeds: Sequence[int], steps: range, batch_size: int, prepare: Prepare | None = None
) -> Generator[Any]:
    """Yield the batch of each step on the device, the next one being gathered in a thread meanwhile.

    Args:
        arrays: stacked examples, numpy leaves with a leading axis.
        seeds: of the run; each has an order of its own, and more than one gives batches a leading seed axis.
        steps: which steps.
        batch_size: examples of a step (and seed).
        prepare: called in that thread.
    """
    examples = len(jax.tree.leaves(arrays)[0])

    def fetch(step: int) -> Any:
        parts = []
        for seed in seeds:
            order = batch_indices(seed, step, examples, batch_size)
            # Not np.take: that copies the whole of a leaf that is a broadcast view.
            part = jax.tree.map(lambda leaf, order=order: leaf[order], arrays)
            parts.append(part if prepare is None else prepare(part, (seed, step)))
        batch = parts[0] if len(seeds) == 1 else jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        return jax.device_put(batch)

    with ThreadPoolExecutor(1, thread_name_prefix="batches") as pool:
        ahead = None
        for step in steps:
            batch = fetch(step) if ahead is None else ahead.result()
            ahead = pool.submit(fetch, step + 1) if step + 1 in steps else None
            yield batch

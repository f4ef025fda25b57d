"""The test examples of a comparison, which are read once for all of its models."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

from tflane_jax.config import RunConfig
from tflane_jax.datasets.sources import check_labelled


def load_test_data(config: RunConfig) -> Any:
    """Return the examples of a configuration's test split; the latest result is cached in memory.

    Raises UserError where they have no truth.
    """
    check_labelled(config.data.source("test"), "an evaluation")
    return _loaded(_TestData(config.data.source("test"), type(config.task), config.task.parts, config.task))


@dataclass(frozen=True)
class _TestData:
    """Key of the cache: equal for all tasks of one class that read the same parts of an example."""

    source: Any
    kind: type
    parts: tuple[str, ...]
    task: Any = field(compare=False)


@functools.lru_cache(maxsize=1)
def _loaded(data: _TestData) -> Any:
    return data.task.load(data.source)

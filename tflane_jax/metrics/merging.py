"""What accumulators hold of every frame: as one array, and joined over several parts of a data set."""

from __future__ import annotations

import copy
import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np


def joined(parts: Sequence[Any]) -> Any:
    """Return the parts, at least one, as one: lists one after the other, numbers and arrays added up in this order.

    What is returned is new: an accumulator adds to its arrays in place.
    """
    if isinstance(parts[0], list):
        return list(itertools.chain.from_iterable(parts))
    return functools.reduce(operator.add, parts) if len(parts) > 1 else copy.copy(parts[0])


def by_frame(parts: Sequence[np.ndarray], shape: tuple[int, ...], dtype: type = float) -> np.ndarray:
    """Return arrays of this shape, one of each frame, as one array (frames, *shape)."""
    # Of thousands of small arrays, `concatenate` is up to ten times as fast as `stack`.
    return np.concatenate([np.zeros((0, *shape[1:]), dtype), *parts]).reshape(-1, *shape)

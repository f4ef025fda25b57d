"""Joining what accumulators of several parts of a data set hold."""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any


def joined(parts: Sequence[Any]) -> Any:
    """Return the parts, at least one, as one: lists one after the other, numbers and arrays added up in this order."""
    if isinstance(parts[0], list):
        return list(itertools.chain.from_iterable(parts))
    return functools.reduce(operator.add, parts)

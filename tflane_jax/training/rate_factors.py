"""Learning rates that differ between parameters: a factor for each path pattern, such as 0.1 for the backbone."""

from __future__ import annotations

import difflib
import fnmatch
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import optax

from tflane_jax.errors import UserError
from tflane_jax.limits import PositiveOrZero
from tflane_jax.training.vectors import ROW, Layout

Factors = tuple[tuple[str, PositiveOrZero], ...]
"""(pattern, factor) pairs, see `OptimConfig.lr_factors`."""


def scale_by_factors(factors: Factors) -> optax.GradientTransformation:
    """Return the transformation that multiplies the update of each parameter of `Vectors` by its factor.

    Its `init` raises UserError like `factor_of_leaves`.
    """

    def init(params: Any) -> optax.EmptyState:
        factor_of_leaves(params.layout, factors)
        return optax.EmptyState()

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        of_leaf, layout = factor_of_leaves(updates.layout, factors), updates.layout

        def scaled(group: str, change: Any) -> Any:
            members = layout.members(group)
            of_row = np.repeat([of_leaf[i] for i in members], [layout.places[i].rows for i in members])
            of_row = np.pad(of_row, (0, layout.tail(group)))
            return (change.reshape(-1, ROW) * of_row.astype(np.float32)[:, None]).reshape(change.shape)

        return updates.map(scaled), state

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


@functools.lru_cache(maxsize=16)
def factor_of_leaves(layout: Layout, factors: Factors) -> tuple[float, ...]:
    """Return the factor of every parameter, in the order of the tree; 1 where no pattern matches.

    Raises UserError for a pattern that decides for no parameter: it matches none, or only those of patterns before it.
    """
    names = parameter_names(layout)
    deciding = [next((k for k, (pattern, _) in enumerate(factors) if _matches(pattern, n)), None) for n in names]
    for k, (pattern, _) in enumerate(factors):
        if k in deciding:
            continue
        if any(_matches(pattern, name) for name in names):
            raise UserError(
                f"optim.lr_factors: {pattern!r} matches only parameters of patterns before it: put it before them"
            )
        raise UserError(f"optim.lr_factors: no parameter matches {pattern!r}{_hint(pattern, names)}")
    return tuple(1.0 if k is None else factors[k][1] for k in deciding)


def parameter_names(layout: Layout) -> list[str]:
    """Return the path of every parameter, such as `encoder/images/backbone/conv1/kernel`, in the order of the tree."""
    numbered = jax.tree.unflatten(layout.treedef, list(range(len(layout.places))))
    paths = jax.tree_util.tree_flatten_with_path(numbered)[0]
    return ["/".join(str(getattr(key, "key", key)) for key in path) for path, _ in paths]


def _matches(pattern: str, name: str) -> bool:
    """Return whether a pattern matches a path or a module that contains it."""
    return fnmatch.fnmatchcase(name, pattern) or fnmatch.fnmatchcase(name, f"{pattern}/*")


def _hint(pattern: str, names: Sequence[str]) -> str:
    parts = [name.split("/") for name in names]
    modules = list(dict.fromkeys("/".join(part[:n]) for part in parts for n in range(1, len(part) + 1)))
    last = pattern.strip("*/").rpartition("/")[2]
    close = [module for module in modules if module.rpartition("/")[2] == last]
    close = (close or difflib.get_close_matches(pattern, modules, 3, 0.6))[:3]
    if close:
        return f"; did you mean {' or '.join(close)}?"
    return f"; the modules are {', '.join(dict.fromkeys(part[0] for part in parts))}"

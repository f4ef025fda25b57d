"""Checks converted variables against a model: none missing, none left over but auxiliary heads.

Auxiliary heads exist in training only. A file may lack them, and then they start afresh, or have some that the model
does not, which are left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax

from tflane_jax.convert.renaming import Converted, check_fits, put, shapes, size_text, without
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.models.parameters import Params

Missing = Literal["fresh", "left out"]
"""What becomes of parameters that a file may lack: initial values, or nothing, which is enough for predictions."""

# Heads of auxiliary outputs that files have: MapTRv2's masks.
_AUXILIARY = r"params/(encoder/view_)?mask_head/.*"


@dataclass(frozen=True)
class Expected:
    """What a model's `init` makes.

    Attributes:
        init: returns initial variables.
        whole: shapes of all of them.
        needed: shapes without auxiliary heads.
    """

    init: Callable[[], Any]
    whole: Any
    needed: Any


def expected_variables(module: Any, arguments: tuple[Any, ...]) -> Expected:
    """Return what a module has for arguments of these shapes."""

    def init(**settings: Any) -> Any:
        zeros = jax.tree.map(lambda leaf: jax.numpy.zeros(leaf.shape, leaf.dtype), arguments)
        return module.init(jax.random.key(0), *zeros, **settings)

    def kept(variables: Any) -> dict[str, Any]:
        return {name: variables.get(name, {}) for name in ("params", STATISTICS)}

    return Expected(
        init=jax.jit(lambda: kept(init())),
        whole=kept(jax.eval_shape(init)),
        needed=kept(jax.eval_shape(lambda: init(mutable=("params", STATISTICS)))),
    )


def fitted(
    converted: Converted, expected: Expected, path: Path | str, missing: Missing, unmapped: str = "(?!)"
) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters, and an account of every tensor and of every parameter without one.

    Args:
        converted: from a file.
        expected: of the model.
        path: of the file, for messages.
        missing: what becomes of auxiliary heads and of `unmapped` parameters.
        unmapped: pattern of paths of parameters that no tensor of such a file becomes.

    Raises:
        UserError: names a parameter that only one side has, or that has another shape.
    """
    here, whole, needed = (shapes(tree) for tree in (converted.variables, expected.whole, expected.needed))
    surplus = [name for name in here.keys() - whole.keys() if re.fullmatch(_AUXILIARY, name)]
    absent = {name for name in whole.keys() - here.keys() if name not in needed or re.fullmatch(unmapped, name)}
    variables = without(converted.variables, surplus)
    check_fits(variables, without(expected.whole, sorted(absent)), path)
    left_out = {name.partition("/")[2] for name in surplus}
    table = [
        row | {"becomes": "an auxiliary head that the model does not have, left out"}
        if left_out & set(row["becomes"].split(", "))
        else row
        for row in converted.table
    ]
    for name in sorted(absent):
        what = "no such tensor in the file" if name in needed else "an auxiliary head that the file does not have"
        becomes = f"{name.partition('/')[2]} {'starts afresh' if missing == 'fresh' else 'is left out'}: {what}"
        table.append({"tensor": "-", "shape": size_text(whole[name]), "becomes": becomes})
    if absent and missing == "fresh":
        initial = expected.init()
        for name in absent:
            put(variables, name, _leaf(initial, name))
    return variables["params"] | {STATISTICS: variables[STATISTICS]}, table


def _leaf(tree: Any, path: str) -> Any:
    for name in path.split("/"):
        tree = tree[name]
    return tree

"""Export of a trained model as one StableHLO file with its weights, for any batch size.

The file runs with jax alone, without this package:

from jax import export
program = export.deserialize(open("lstr.stablehlo", "rb").read())
answer = program.call(images)    # (b, 360, 640, 3) uint8 RGB -> {"logits": (b, q, 2), "curves": (b, q, 8)}

A model of lanes around the vehicle takes a dict of those arrays of an `Example` that it reads ("bev",
"traffic_flow/position", ...), and returns the arrays of `tasks.answers`. One with memory also takes and returns the
arrays "memory/...".
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.extend.core import Literal
from jaxtyping import Array, UInt8

from tflane_jax.errors import UserError
from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.scene import Example, LaneLines, RoadImage, stack_examples
from tflane_jax.tasks.answers import answer_arrays
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask

PLATFORMS = ("cpu", "cuda")
MEMORY = "memory/"
"""Names of arrays that a model carries from frame to frame begin with this."""
_LONGEST_MEASUREMENT = 20.0  # seconds for the calls of one batch size
_FEWEST_CALLS = 3

Arrays = dict[str, Any]


class Program(NamedTuple):
    """A model as a function of arrays alone, its weights inside.

    Attributes:
        call: from inputs, an array or arrays by name, to answers by name; all have a leading batch axis.
        inputs: of one example, without that axis (numpy).
    """

    call: Callable[[Any], Arrays]
    inputs: Any


def image_program(task: LaneShapeTask, params: Params, *, height: int, width: int) -> Program:
    """Return a model of lane lines in one image, as a function of RGB images; its example is noise."""

    def call(images: UInt8[Array, "b h w 3"]) -> Arrays:
        no_lines = LaneLines(jnp.zeros((0, 1, 2)), jnp.zeros((0, 1), bool), jnp.zeros(0, bool))

        def one(image):
            prediction = task.predict(params, RoadImage(image, jnp.ones(image.shape[:2], bool), no_lines))
            assert prediction.curves is not None, "tasks of lane shapes predict curves"
            return prediction.curves

        answer = jax.vmap(one)(images)
        return {"logits": answer.logits, "curves": answer.curves}

    return Program(call, np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8))


def scene_program(task: LaneGraphTask, params: Params, example: Example) -> Program:
    """Return a model of lanes around the vehicle, as a function of the arrays that it reads, by name.

    Names are paths below `Example`, such as "traffic_flow/position". A model with memory (`task.streams`) also takes
    and returns arrays "memory/...", of any finite values where `has_previous` is False.

    Args:
        task, params: the model.
        example: one frame; where a dataset lacks a prior (None), the program takes none.
    """
    given: Arrays = {"": jax.tree.map(np.asarray, example)}
    if task.streams:
        given[MEMORY] = jax.tree.map(np.asarray, task.start())
    module, (learned, statistics) = task.model.build(), split_statistics(params)
    every = {prefix + name: leaf for prefix, tree in given.items() for name, leaf in _named(tree).items()}

    def answered(inputs: Arrays) -> Arrays:
        """Return the answer for one example; inputs that are not given are those of `example`."""
        leaves, tree = [inputs.get(name, leaf) for name, leaf in every.items()], jax.tree.structure(given)
        found = jax.tree.unflatten(tree, leaves)
        variables = {"params": learned} | statistics
        # Not `task.step`, whose barrier would make the program read the whole example.
        result: Any = module.apply(variables, found[""], found.get(MEMORY), method=type(module).step)
        outputs, memory = result
        answer = answer_arrays(jax.tree.map(lambda layers: layers[-1], outputs))
        if task.streams:
            answer |= {MEMORY + name: leaf for name, leaf in _named(memory).items()}
        return answer

    read = _read(answered, every)
    inputs = {name: leaf for name, leaf in every.items() if name in read}
    unread = {name for name in every if name.startswith(MEMORY)} - read

    def one(inputs: Arrays) -> Arrays:
        return {name: leaf for name, leaf in answered(inputs).items() if name not in unread}

    return Program(jax.vmap(one), inputs)


def _named(tree: Any) -> Arrays:
    """Return the leaves of a tree by their paths, in its order."""
    paths = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in paths}


def _read(function: Callable[[Arrays], Arrays], inputs: Arrays) -> set[str]:
    """Return the names of the inputs on which the result depends."""
    jaxpr = jax.make_jaxpr(lambda *leaves: function(dict(zip(inputs, leaves, strict=True))))(*inputs.values()).jaxpr
    live = {variable for variable in jaxpr.outvars if not isinstance(variable, Literal)}
    for equation in reversed(jaxpr.eqns):
        if not live.isdisjoint(equation.outvars):
            live |= {variable for variable in equation.invars if not isinstance(variable, Literal)}
    return {name for name, variable in zip(inputs, jaxpr.invars, strict=True) if variable in live}


def serialized_model(program: Program, platforms: Sequence[str] = PLATFORMS) -> bytearray:
    """Return the content of the file of a model, for batches of any size."""
    (batch,) = export.symbolic_shape("b")
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((batch, *leaf.shape), leaf.dtype), program.inputs)
    return export.export(jax.jit(program.call), platforms=platforms)(shapes).serialize()


def load_program(path: Path) -> export.Exported:
    """Return an exported program; raises UserError where there is none or it is damaged."""
    try:
        return export.deserialize(bytearray(path.read_bytes()))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except Exception as error:  # a damaged flatbuffer raises many types
        raise UserError(f"{path} is no exported program, or damaged: write it again with tflane export") from error


def largest_difference(ours: Arrays, others: Arrays) -> float:
    """Return the largest difference of two answers, relative to numbers above 1; NaN if one has a number not finite.

    Categories do not count: rounding may decide between two that are equally likely.
    """
    found = [0.0]
    for name, array in ours.items():
        mine, other = np.asarray(array), np.asarray(others[name])
        if np.issubdtype(mine.dtype, np.inexact):
            finite = np.isfinite(mine).all() and np.isfinite(other).all()
            relative = np.abs(mine - other) / np.maximum(np.abs(mine), 1.0) if finite else np.array(np.nan)
            found.append(float(np.max(relative, initial=0.0)))
    return float(np.max(found))


def latencies(
    program: export.Exported, inputs: Any, *, batches: Sequence[int] = (1, 4, 16), runs: int = 20
) -> list[dict[str, Any]]:
    """Return a row for each batch size: seconds to compile, median milliseconds a call, examples a second.

    Args:
        program: exported.
        inputs: of one example, see `Program`.
        batches: sizes; a batch holds the example as often.
        runs: calls of each, fewer where they take long.
    """
    rows = []
    for batch in batches:
        stacked = jax.device_put(stack_examples([inputs] * batch))
        began = time.perf_counter()
        call = jax.jit(program.call).lower(stacked).compile()
        compiled = time.perf_counter() - began
        seconds: list[float] = []
        while len(seconds) < runs and (sum(seconds) < _LONGEST_MEASUREMENT or len(seconds) < _FEWEST_CALLS):
            began = time.perf_counter()
            jax.block_until_ready(call(stacked))
            seconds.append(time.perf_counter() - began)
        median = float(np.median(seconds[1:] or seconds))
        rows.append({"batch": batch, "ms": 1e3 * median, "examples/s": batch / median, "compile s": compiled})
    return rows

"""Gradients of convolutions inside loops, in the one form that XLA for CPUs computes fast.

XLA's CPU compiler brings convolutions to the layout of its fast kernels outside loops only. The gradients of a
convolution have another layout, and inside `lax.scan` they fall back to plain loops, some 25 times slower
(`benchmarks/loop_convolutions.py`). This pass over a traced program writes them in the fast layout. Values change by
rounding only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

_LOOPS = ("scan", "while")
_REMATERIALISED = ("checkpoint", "remat2")  # names of one primitive


def with_fast_convolutions(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of the same results whose loops hold convolutions in the fast layout; the same off the CPU."""
    if jax.default_backend() != "cpu":
        return function

    def rewritten(*args: Any) -> Any:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        found = _evaluated(closed.jaxpr, closed.consts, jax.tree.leaves(args), in_loop=False)
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return rewritten


def _rewritten(closed: ClosedJaxpr, *, in_loop: bool) -> ClosedJaxpr:
    def evaluated(*args: Any) -> list[Any]:
        return _evaluated(closed.jaxpr, closed.consts, args, in_loop=in_loop)

    return jax.make_jaxpr(evaluated)(*(variable.aval for variable in closed.jaxpr.invars))


def _evaluated(jaxpr: Jaxpr, constants: Any, inputs: Any, *, in_loop: bool) -> list[Any]:
    """Evaluate a program step by step, as JAX does, except for the convolutions of its loops."""
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, constants, strict=True))
    values.update(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for step in jaxpr.eqns:
        operands = [read(atom) for atom in step.invars]
        if in_loop and _is_plain_convolution(step):
            results = [_in_fast_layout(*operands, **step.params)]
        else:
            parameters = _with_rewritten_programs(step, in_loop=in_loop)
            bound: Any = step.primitive.get_bind_params(parameters)
            functions, bound = bound if isinstance(bound, tuple) else ((), bound)  # as before JAX 0.10.2
            results = step.primitive.bind(*functions, *operands, **bound)
            results = results if step.primitive.multiple_results else [results]
        values.update(zip(step.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _with_rewritten_programs(step: JaxprEqn, *, in_loop: bool) -> dict[str, Any]:
    """Return the parameters of a step: bodies of loops, of jitted and of rematerialised functions are rewritten."""
    name, parameters = step.primitive.name, dict(step.params)
    if name in (*_LOOPS, "jit", "pjit"):
        for key, value in parameters.items():
            if isinstance(value, ClosedJaxpr):
                parameters[key] = _rewritten(value, in_loop=in_loop or name in _LOOPS)
    elif name in _REMATERIALISED:
        closed = _rewritten(ClosedJaxpr(parameters["jaxpr"], ()), in_loop=in_loop)
        if not closed.consts:
            parameters["jaxpr"] = closed.jaxpr
    return parameters


def _is_plain_convolution(step: JaxprEqn) -> bool:
    return step.primitive.name == "conv_general_dilated" and (
        step.params["feature_group_count"] == step.params["batch_group_count"] == 1
    )


def _in_fast_layout(x: jax.Array, kernel: jax.Array, *, dimension_numbers: Any, **settings: Any) -> jax.Array:
    """Return a convolution with batch, space and channels in this order, and kernels of space, inputs, outputs."""
    of_x, of_kernel, of_result = dimension_numbers  # each: batch or outputs, channels or inputs, space
    x = jnp.transpose(x, (of_x[0], *of_x[2:], of_x[1]))
    kernel = jnp.transpose(kernel, (*of_kernel[2:], of_kernel[1], of_kernel[0]))
    last = x.ndim - 1
    space = tuple(range(1, last))
    numbers = lax.ConvDimensionNumbers((0, last, *space), (last, last - 1, *(i - 1 for i in space)), (0, last, *space))
    found = lax.conv_general_dilated_p.bind(x, kernel, dimension_numbers=numbers, **settings)
    order = [0] * x.ndim
    for here, there in zip((0, last, *space), of_result, strict=True):
        order[there] = here
    return jnp.transpose(found, order)

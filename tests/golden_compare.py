"""Comparing our modules with a golden case: outputs, and gradients where the case has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np
import pytest

from tests.golden import Arrays, ModuleCase

# (parameters, inputs) by the reference's names -> outputs by its names, alone or with anything else.
Outputs = Callable[[Any, Any], Any]


def compare(
    case: ModuleCase,
    outputs: Outputs,
    *,
    ignore: Iterable[str] = (),
    params: Arrays | None = None,
    tolerance: float = 2e-5,
    tolerances: Mapping[str, float] | None = None,
    absolute: Mapping[str, float] | None = None,
) -> Any:
    """Compare outputs and gradients of a function with those of a case; return what it returns beside the outputs.

    Every output of the case must be computed, unless `ignore` says why not at the call. Gradients are compared as far
    as the case has them: by parameter, and by those inputs that have one.

    Args:
        case: the fixture.
        outputs: from the case's parameters and inputs; jitted, with inputs of float32 traced and others as they are.
        ignore: outputs that the test does not compute.
        params: the parameters to differentiate, where not all of the case's.
        tolerance: of outputs, |a - b| <= tolerance (1 + |b|).
        tolerances: of single outputs.
        absolute: least absolute tolerance of single outputs, such as the reference's own distance to float64.
    """
    try:
        return _compare(case, outputs, set(ignore), params, tolerance, tolerances or {}, absolute or {})
    except (Exception, pytest.fail.Exception) as error:
        if unread := sorted(case.config.keys() - case.read):
            error.add_note(f"options of {case.meta.get('name')} that the test does not read: {', '.join(unread)}")
        raise


def _compare(case, outputs, ignore, params, tolerance, tolerances, absolute):
    params = case.params if params is None else params
    traced = {name: value for name, value in case.inputs.items() if value.dtype == np.float32}
    varied = {name: traced.pop(name) for name in list(traced) if _has_gradient(case, f"in/{name}")}

    def run(params, varied, traced):
        made = outputs(params, case.inputs | traced | varied)
        out, beside = made if isinstance(made, tuple) else (made, None)
        if uncomputed := sorted(case.weights.keys() - out.keys()):
            pytest.fail(f"{case.meta.get('name')}: the gradient is of outputs that are not computed: {uncomputed}")
        return sum((out[name] * weight).sum() for name, weight in case.weights.items()), (out, beside)

    if case.gradients:
        step = jax.jit(jax.value_and_grad(run, argnums=(0, 1), has_aux=True))
        (total, (out, beside)), by = step(params, varied, traced)
    else:
        (total, (out, beside)), by = jax.jit(run)(params, varied, traced), None
    expected = {name: value for name, value in case.outputs.items() if name not in ignore}
    if not case.weights:
        expected.pop("grad_scalar", None)
    if uncomputed := sorted(expected.keys() - out.keys() - {"grad_scalar"}):
        pytest.fail(f"{case.meta.get('name')}: outputs that the test does not compute: {', '.join(uncomputed)}")
    actual = {"grad_scalar": total} | out
    for name, value in expected.items():
        relative = tolerances.get(name, tolerance)
        least = max(relative, absolute.get(name, 0.0))
        np.testing.assert_allclose(actual[name], value, rtol=relative, atol=least, err_msg=name)
    if by is not None:
        assert_gradients_close(named_gradients(*by), case.gradients)
    return beside


def _has_gradient(case: ModuleCase, name: str) -> bool:
    return any(key in case.gradients for key in (name, f"last/{name}", f"rest/{name}"))


def named_gradients(by_param: Arrays, by_input: Arrays) -> Arrays:
    """Return gradients under the names of `ModuleCase.gradients`."""
    return {f"p/{k}": v for k, v in by_param.items()} | {f"in/{k}": v for k, v in by_input.items()}


def assert_outputs_close(actual: Arrays, expected: Arrays, tolerance: float = 2e-5) -> None:
    """Compare every expected output by name: |a - b| <= tolerance (1 + |b|), as the fixtures were made for."""
    for name, value in expected.items():
        np.testing.assert_allclose(actual[name], value, rtol=tolerance, atol=tolerance, err_msg=name)


def assert_gradients_close(actual: Arrays, expected: Arrays, tolerance: float = 2e-4) -> None:
    """Compare every expected gradient by name: max|a - b| <= tolerance (1 + max|b|), also where only sums are given.

    `actual` holds full gradients by `in/<name>` and `p/<name>` in PyTorch's layout.
    """
    for name, value in expected.items():
        if name.startswith("last/"):
            got = np.asarray(actual[name.removeprefix("last/")]).sum(-1)
        elif name.startswith("rest/"):
            full = np.asarray(actual[name.removeprefix("rest/")])
            got = full.sum(tuple(range(full.ndim - 1)))
        else:
            got = np.asarray(actual[name])
        scale = 1.0 + np.abs(value).max(initial=0.0)
        np.testing.assert_allclose(got, value, rtol=0.0, atol=tolerance * scale, err_msg=name)

"""Gradients of convolutions inside loops: same values, and one layout on a CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr

from tflane_jax.training.loop_convolutions import with_fast_convolutions

SHAPES = ("NHWC", "HWIO", "NHWC")
CASES = {
    "stride and dilation": {"window_strides": (2, 1), "padding": "SAME", "rhs_dilation": (1, 2)},
    "valid": {"window_strides": (1, 1), "padding": "VALID"},
}


def gradients(case, *, remat=False):
    def loss(kernel, image):
        found = lax.conv_general_dilated(image, kernel, dimension_numbers=SHAPES, **CASES[case])
        return (found**2).sum()

    loss = jax.checkpoint(loss) if remat else loss

    def function(kernel, images):
        def body(total, image):
            to_kernel, to_image = jax.grad(loss, (0, 1))(kernel, image)
            return total + to_kernel, to_image

        return lax.scan(body, jnp.zeros_like(kernel), images)

    return function


def arguments():
    rng = np.random.default_rng(0)
    return rng.normal(size=(3, 3, 2, 4)).astype(np.float32), rng.normal(size=(2, 1, 6, 7, 2)).astype(np.float32)


def layouts(jaxpr):
    """Return the dimension numbers of all convolutions of a program and of those inside it."""
    found = []
    for step in jaxpr.eqns:
        if step.primitive.name == "conv_general_dilated":
            numbers = step.params["dimension_numbers"]
            found.append((numbers.lhs_spec, numbers.rhs_spec, numbers.out_spec))
        for value in step.params.values():
            inner = value.jaxpr if isinstance(value, ClosedJaxpr) else value
            found += layouts(inner) if isinstance(inner, Jaxpr) else []
    return found


@pytest.mark.parametrize("case", CASES)
def test_values_stay_equal(case):
    function = gradients(case)
    expected, found = jax.jit(function)(*arguments()), jax.jit(with_fast_convolutions(function))(*arguments())
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-5), expected, found)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="a pass for CPUs")
@pytest.mark.parametrize("remat", [False, True])
def test_all_convolutions_of_a_loop_have_the_layout_of_the_fast_kernels(remat):
    function = gradients("valid", remat=remat)
    before, after = (jax.make_jaxpr(f)(*arguments()).jaxpr for f in (function, with_fast_convolutions(function)))
    assert len(layouts(after)) == len(layouts(before)) >= 3
    assert len(set(layouts(before))) > 1
    assert set(layouts(after)) == {((0, 3, 1, 2), (3, 2, 0, 1), (0, 3, 1, 2))}


def test_outside_loops_nothing_changes():
    def once(kernel, images):
        return jax.grad(lambda k: (lax.conv(images[0], k, (1, 1), "SAME") ** 2).sum())(kernel)

    kernel, images = np.ones((4, 2, 3, 3), np.float32), np.ones((1, 1, 2, 6, 6), np.float32)
    before, after = (jax.make_jaxpr(f)(kernel, images).jaxpr for f in (once, with_fast_convolutions(once)))
    assert layouts(after) == layouts(before)

"""Learning-rate factors by path: what a pattern matches, and that an update is that of its factor."""

import jax
import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.training.rate_factors import factor_of_leaves, parameter_names
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.vectors import layout_of, ravel


def tree(value=1.0):
    kernel = lambda *shape: np.full(shape, value, np.float32)  # noqa: E731
    images = {"backbone": {"conv1": {"kernel": kernel(3, 3, 3, 8)}, "bn": {"scale": kernel(8)}}}
    return {"decoder": {"out": {"kernel": kernel(5, 70)}}, "encoder": {"images": images}}


@pytest.mark.parametrize(
    ("factors", "expected"),
    [
        ((), {}),
        ((("encoder/images/backbone", 0.1),), {"conv1/kernel": 0.1, "bn/scale": 0.1}),
        ((("*/bn", 0.0), ("encoder", 0.5)), {"conv1/kernel": 0.5, "bn/scale": 0.0}),
        ((("*kernel", 2.0),), {"conv1/kernel": 2.0, "out/kernel": 2.0}),
    ],
)
def test_the_first_pattern_that_matches_a_path_or_a_module_decides(factors, expected):
    layout = layout_of(tree())
    found = dict(zip(parameter_names(layout), factor_of_leaves(layout, factors), strict=True))
    for name, factor in found.items():
        assert factor == expected.get("/".join(name.split("/")[-2:]), 1.0)


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ((("backbone", 0.1),), "no parameter matches 'backbone'; did you mean encoder/images/backbone?"),
        ((("nothing like it", 0.1),), "'nothing like it'; the modules are decoder, encoder"),
        ((("*", 0.1), ("decoder", 1.0)), "'decoder' matches only parameters of patterns before it"),
    ],
)
def test_a_pattern_that_decides_nothing_is_an_error(factors, message):
    optimizer = make_optimizer(OptimConfig(lr_factors=factors), 1000)
    params = tree()
    with pytest.raises(UserError, match=r"optim\.lr_factors") as error:
        optimizer.init(ravel(params, layout_of(params)))
    assert message in str(error.value)


@pytest.mark.parametrize("factor", [-0.1, float("nan"), float("inf")])
def test_a_factor_out_of_range_is_an_error(factor):
    with pytest.raises(UserError, match=r"lr_factors is .*a finite number of at least 0"):
        make_optimizer(OptimConfig(lr_factors=(("*", factor),)), 1000)


def test_updates_and_weight_decay_are_multiplied():
    params, gradient = ({name: {"kernel": np.full((5, 13), value, np.float32)} for name in "ab"} for value in (1, 0.5))
    vectors, gradient = (ravel(tree, layout_of(params)).padded(3) for tree in (params, gradient))

    def changes(gradient, vectors):
        for factors in ((), (("a", 0.25), ("b", 0.0))):
            optimizer = make_optimizer(OptimConfig(weight_decay=0.5, lr_factors=factors), 1000)
            updates, _ = optimizer.update(gradient, optimizer.init(vectors), vectors)
            yield updates.tree()

    whole, part = jax.jit(lambda *args: list(changes(*args)))(gradient, vectors)
    np.testing.assert_allclose(part["a"]["kernel"], 0.25 * whole["a"]["kernel"], rtol=1e-6)
    assert np.abs(np.asarray(whole["b"]["kernel"])).min() > 0
    assert not np.asarray(part["b"]["kernel"]).any()

"""The class term that hosts share, against loops over queries and classes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared import random_array
from tflane_jax.losses.common import class_losses, focal, quality_focal

QUERY = jnp.asarray([2, 0, 5])  # the third target is unmatched: there are five queries
CATEGORY = jnp.asarray([1, 2, 0])


@pytest.mark.parametrize("quality", [None, [0.25, 0.5, 1.0]])
@pytest.mark.parametrize("category", [CATEGORY, 1])
def test_matched_queries_have_their_class_as_target(quality, category):
    logits = random_array(0, 5, 3)
    target = np.zeros((5, 3), np.float32)
    for i, (query, which) in enumerate(zip([2, 0], np.broadcast_to(category, 3), strict=False)):
        target[query, which] = 1.0 if quality is None else quality[i]
    expected = focal(logits, target, 0.25, 2.0) if quality is None else quality_focal(logits, target, 2.0)
    found = class_losses(logits, QUERY, category, None if quality is None else jnp.asarray(quality), 0.25, 2.0)
    np.testing.assert_array_equal(found, expected)


def test_no_gradient_goes_through_the_quality():
    logits, quality = random_array(1, 5, 3), jnp.asarray([0.25, 0.5, 1.0])
    slope = jax.grad(lambda value: class_losses(logits, QUERY, CATEGORY, value, 0.25, 2.0).sum())(quality)
    np.testing.assert_array_equal(slope, 0.0)

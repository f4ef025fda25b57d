"""Stacking of examples and its inverse."""

import jax
import numpy as np
import pytest

from tests.models.cases import make_example
from tests.shared import assert_same
from tflane_jax.scene import row_of, stack_examples


@pytest.mark.parametrize("on_device", [False, True])
def test_a_row_of_a_batch_is_the_example_as_arrays_on_the_host(on_device):
    examples = [make_example(seed) for seed in (0, 1)]
    batch = stack_examples(examples)
    for index, example in enumerate(examples):
        found = row_of(jax.device_put(batch) if on_device else batch, index)
        assert_same(found, example)
        assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(found))

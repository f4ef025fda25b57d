"""What all datasets share: indices outside of them."""

import pytest

from tflane_jax.datasets.base import checked_index


@pytest.mark.parametrize("index", [0, 2])
def test_an_index_inside_is_returned(index):
    assert checked_index(index, 3, "toy") == index


@pytest.mark.parametrize(("index", "size"), [(-1, 3), (3, 3), (0, 0)])
def test_an_index_outside_is_an_error(index, size):
    with pytest.raises(IndexError, match=f"^toy has {size} examples, no number {index}$"):
        checked_index(index, size, "toy")
    with pytest.raises(IndexError, match=f"^toy has {size} images, no number {index}$"):
        checked_index(index, size, "toy", "images")

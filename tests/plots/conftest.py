"""What tests of pictures draw on."""

import pytest

from tflane_jax.plots.figure import new_figure


@pytest.fixture
def ax():
    return new_figure()[1][0, 0]

"""Logs: the rate of their frames."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.scene.logs import Log


def rate(*times_ns: int) -> float | None:
    log: Any = SimpleNamespace(name="a", timestamps_ns=np.array(times_ns, np.int64))
    return vars(Log)["rate_hz"].fget(log)


def test_the_rate_is_that_of_most_intervals():
    assert rate(0, 500_000_000, 1_000_000_000, 9_000_000_000) == pytest.approx(2.0)
    assert rate(7) is None
    assert rate() is None


@pytest.mark.parametrize("times", [(0, 0, 0, 100), (300, 200, 100)])
def test_times_that_do_not_rise_are_named(times):
    """They gave a division by zero, or a negative rate."""
    with pytest.raises(UserError, match="log a: frame 1 is not later than the frame before it"):
        rate(*times)

"""What a loss of one's own returns is checked by one message that names its class."""

import jax
import jax.numpy as jnp
import pytest

from tflane_jax.errors import UserError
from tflane_jax.losses.common import HostLossConfig, checked_loss

ONE = jnp.ones(())


class MyLossConfig(HostLossConfig):
    """A loss of one's own."""


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (ONE, "returned .*: expected a tuple of the loss and a dict of numbers"),
        ((ONE, None), "expected a tuple"),
        ((ONE, {}, ONE), "expected a tuple"),
        ((ONE[None], {}), r"the loss has shape \(1,\), expected a scalar"),
        ((jnp.ones((), int), {}), "the loss is of type int32, expected a float"),
        ((ONE, {"v": jnp.ones(3)}), r"the number 'v' has shape \(3,\), expected a scalar"),
        ((ONE, {"v": "much"}), "the number 'v' is str, expected a scalar array"),
    ],
)
def test_other_results_are_named(found, said):
    with pytest.raises(UserError, match=rf"MyLossConfig\.loss:? .*{said}|MyLossConfig\.loss {said}"):
        checked_loss(MyLossConfig(), found)


def test_a_loss_and_numbers_pass_as_they_are():
    found = ONE, {"points": ONE, "matched": 3}
    assert checked_loss(MyLossConfig(), found) == found
    assert jax.jit(lambda loss: checked_loss(MyLossConfig(), (loss, {"loss": loss}))[0])(ONE) == 1.0

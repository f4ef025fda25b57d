"""Signals that ask a training to stop."""

import signal

import pytest

from tflane_jax.errors import Interrupted
from tflane_jax.training.interrupt import StopRequest


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_a_request_and_at_once_an_error(number):
    before = signal.getsignal(number)
    with StopRequest() as stop:
        signal.raise_signal(number)
        assert stop.signal == number
        with pytest.raises(Interrupted):
            stop.at_once()
    assert signal.getsignal(number) is before


@pytest.mark.usefixtures("interruptible")
def test_a_signal_that_the_process_ignores_stays_ignored():
    """A shell that starts a training in the background lets it ignore Ctrl-C, which is meant for others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.signal is None
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN

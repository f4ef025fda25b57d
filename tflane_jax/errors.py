"""The errors that the command line shows to its user."""


class LeftOutWarning(UserWarning):
    """Parts of an input that are not used, though a user may think so."""


class UserError(Exception):
    """A mistake that the user can correct. The message names the cause and the remedy.

    The command line prints the message without a traceback and exits with code 2.
    """


def missing_extra(what: str, extra: str) -> UserError:
    """Return the error that a package of an extra is not installed; `what` says which, and what for."""
    return UserError(f"{what}: {install(extra)}")


def install(extra: str) -> str:
    """Return how to install an extra of this package."""
    return f"run `pip install -e '.[{extra}]'` in the checkout of tflane_jax"


class Interrupted(KeyboardInterrupt):
    """A signal ended a command. The command line exits with code 128 + `number`."""

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.number = number

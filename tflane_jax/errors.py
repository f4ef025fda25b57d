"""The errors that the command line shows to its user."""


class UserError(Exception):
    """A mistake that the user can correct. The message names the cause and the remedy.

    The command line prints the message without a traceback and exits with code 2.
    """


class Interrupted(KeyboardInterrupt):
    """A signal ended a command. The command line exits with code 128 + `number`."""

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.number = number

"""The error that the command line shows to its user."""


class UserError(Exception):
    """A mistake that the user can correct. The message names the cause and the remedy.

    The command line prints the message without a traceback and exits with code 2.
    """

"""Errors meant for the person at the keyboard."""


class UserError(Exception):
    """Something that the user can put right: one message that names the thing and the remedy.

    The command line prints the message without a traceback and exits with code 2.
    """

"""The errors that the command line shows to its user."""

# Modules that only extras of this package install, and the extra of each.
_EXTRAS = {"cv2": "images", "grain": "images", "matplotlib": "plot", "pyarrow": "data", "shapely": "data"}


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


def not_installed(error: ModuleNotFoundError) -> UserError | None:
    """Return what to tell the user of a module that an extra of this package installs; None for any other module."""
    module = (error.name or "").partition(".")[0]
    return missing_extra(f"{module} is not installed", _EXTRAS[module]) if module in _EXTRAS else None


class Interrupted(KeyboardInterrupt):
    """A signal ended a command. The command line exits with code 128 + `number`."""

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.number = number

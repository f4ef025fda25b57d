"""The errors that the command line shows to its user."""

import re
from pathlib import Path

# Modules that only extras of this package install, and the extra of each.
_EXTRAS = {"cv2": "images", "grain": "images", "matplotlib": "plot", "pyarrow": "data", "shapely": "data"}
_CHECKOUT = Path(__file__).parents[1] / "pyproject.toml"
_REQUIRED = re.compile(r"""([^;]+); *extra *== *["'](\w+)["'] *""")  # in the metadata of an installed package


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
    """Return how to install an extra of this package: in its checkout, or without one by the names of the packages."""
    if _CHECKOUT.is_file():
        return f"run `pip install -e '.[{extra}]'` in the checkout of tflane_jax"
    import importlib.metadata  # a message needs it, and every command would wait for it

    try:
        required = [_REQUIRED.fullmatch(text) for text in importlib.metadata.requires("tflane_jax") or ()]
    except importlib.metadata.PackageNotFoundError:  # a copy of the folder alone
        return f"install what tflane_jax needs for [{extra}]"
    packages = " ".join(f"'{found[1].strip()}'" for found in required if found is not None and found[2] == extra)
    return f"run `pip install {packages}`"


def not_installed(error: ModuleNotFoundError) -> UserError | None:
    """Return what to tell the user of a module that an extra of this package installs; None for any other module."""
    module = (error.name or "").partition(".")[0]
    return missing_extra(f"{module} is not installed", _EXTRAS[module]) if module in _EXTRAS else None


class Interrupted(KeyboardInterrupt):
    """A signal ended a command. The command line exits with code 128 + `number`."""

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.number = number


def printable(text: str, kept: str = "") -> str:
    """Return a text with escapes for what a terminal would obey and not show, but for characters of `kept`."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)

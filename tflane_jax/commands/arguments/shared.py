"""Common arguments of several commands. Nothing slow is imported here."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

OVERRIDES = """Any setting of the configuration can be changed by its dotted name, for example --optim.lr 1e-3.
`tflane train --config FILE --help` lists them all with their values."""


class SourceName:
    """Type of an argument that names a data source; imports the list of sources only when it is needed.

    Args:
        checked: list only sources whose folder can be checked; for others, the command says why not.
    """

    def __init__(self, *, checked: bool = False):
        self._checked = checked

    def names(self) -> list[str]:
        """Return the names to list."""
        from tflane_jax.datasets.sources import SOURCES

        return [source.name for source in SOURCES if source.check is not None or not self._checked]

    def __call__(self, text: str) -> str:
        if text not in SourceName().names():
            own = "an own one: import its module, --import MODULE"
            raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(self.names())} ({own})")
        return text


class CommandParser(argparse.ArgumentParser):
    """A parser whose help lists the data sources. It imports them, which takes a second, only to print help.

    Options have one spelling: an abbreviated --import would not be found by `own_modules.take_imports`.
    """

    def __init__(self, *positional: Any, allow_abbrev: bool = False, **named: Any):
        super().__init__(*positional, allow_abbrev=allow_abbrev, **named)

    def format_help(self) -> str:
        """Return the help text."""
        for action in self._actions:
            if isinstance(action.type, SourceName):
                action.metavar = f"{{{','.join(action.type.names())}}}"
        return super().format_help()


def command(commands, name: str, text: str, *, function: str, module: str, epilog: str = "", **more):
    """Add a command and return its parser.

    Args:
        commands: result of `add_subparsers`.
        name: name of the command.
        text: description for the help, without capital and full stop.
        function, module: implementation, `tflane_jax.commands.<module>.<function>`.
        epilog: end of the help text, printed verbatim.
        **more: see `argparse.ArgumentParser`.
    """
    parser = commands.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **more,
    )
    parser.add_argument(
        "--import",
        dest="modules",
        metavar="MODULE",
        action="append",
        help="first import this module, or Python file, with own classes (may be repeated; also $TFLANE_IMPORT)",
    )
    parser.set_defaults(module=module, function=function, takes_overrides=False)
    return parser


def stem(text: str) -> Path:
    """Return the STEM of STEM.md and STEM.json, which may be given with either suffix."""
    path = Path(text)
    return path.with_suffix("") if path.suffix.lower() in (".md", ".json") else path


def _checkpoint(text: str) -> int | str:
    if text in ("best", "last"):
        return text
    if text.isdecimal():
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither best, last nor a step")


def model_arguments(parser: argparse.ArgumentParser, inputs: str = "run folder") -> None:
    """Add the arguments that name a trained model."""
    parser.add_argument("inputs", metavar="RUN", nargs="*", type=Path, help=inputs)
    parser.add_argument(
        "--config", metavar="FILE[:NAME]", help="instead of a run: a config file that names published weights"
    )
    parser.add_argument(
        "--weights", metavar="FILE", type=Path, help="with --config: file of the weights (default: the config's)"
    )
    parser.add_argument(
        "--checkpoint",
        metavar="best|last|STEP",
        type=_checkpoint,
        help="default best, or last without evaluations",
    )


def example_arguments(parser: argparse.ArgumentParser, split: str) -> None:
    """Add the arguments that select examples to predict; `split` is the default."""
    split_arguments(parser, split)
    parser.add_argument("--max-instances", type=int, metavar="N", help="use at most N road users; 0: no traffic flow")


def split_arguments(parser: argparse.ArgumentParser, split: str, further: str = "") -> None:
    """Add the arguments that select one split of the data; `split` is the default, `further` is appended to help."""
    # No argparse default: an explicit --split is an error for data without splits, the default split is not.
    parser.add_argument("--split", choices=("train", "val", "test"), help=f"default {split}{further}")
    parser.set_defaults(default_split=split)
    source_arguments(parser)


def source_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that select a data source."""
    parser.add_argument(
        "--data", metavar="NAME", type=SourceName(), help="use this data source instead of the configuration's"
    )
    parser.add_argument("--root", metavar="PATH", help="folder of the data, for sources that are read from a folder")
    parser.add_argument(
        "--openlane", metavar="PATH", help="folder of the OpenLane-V2 split files, which --data argoverse2 can use"
    )
    parser.add_argument(
        "--data-dict",
        metavar="FILE",
        help="OpenLane-V2: split file below the root; 'folders': all frames that are there",
    )

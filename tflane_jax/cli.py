"""`tflane`, the command line: the parser and the call of the chosen command.

`tflane_jax.commands.arguments` says what each command takes, `tflane_jax.commands` what it does. A command's module is
imported when it runs, and nothing slow is imported here, so `tflane --help` is instant.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Sequence

from tflane_jax.commands.arguments import comparisons, data, markers, models
from tflane_jax.commands.arguments.shared import CommandParser
from tflane_jax.errors import UserError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 2 an error of the user's, 128 + n ended by signal n."""
    parser = build_parser()
    options, rest = parser.parse_known_args(arguments)
    if rest and not options.takes_overrides:
        parser.error(f"unknown argument {rest[0]}: see tflane {options.command} --help")
    try:
        command = getattr(importlib.import_module(f"tflane_jax.commands.{options.module}"), options.function)
        return (command(options, rest) if options.takes_overrides else command(options)) or 0
    except UserError as error:
        print(f"tflane: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("tflane: stopped", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:  # `tflane ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = CommandParser(prog="tflane", description="Lane perception with priors, in JAX.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    models.train(commands)
    models.evaluate(commands)
    models.predict(commands)
    models.convert(commands)
    models.export(commands)
    data.data(commands)
    data.cache(commands)
    models.summary(commands)
    comparisons.compare(commands)
    comparisons.tables(commands)
    comparisons.carry_over(commands)
    comparisons.sweep(commands)
    comparisons.score(commands)
    markers.markers(commands)
    comparisons.demo(commands)
    comparisons.bench(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())

"""`tflane cache`."""

from __future__ import annotations

import argparse
import difflib

from tflane_jax.datasets.cache import cache_root
from tflane_jax.datasets.cache_entries import Entry, cache_entries, delete_entry
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table


def show(options: argparse.Namespace) -> int:
    """Print the entries of the cache."""
    root, entries = cache_root(), cache_entries(cache_root())
    if not entries:
        print(f"{root}: nothing is kept")
        return 0
    rows = [
        {"name": one.path.name, "holds": one.kind, "MB": _megabytes(one), "days unused": f"{one.days:.0f}"}
        for one in entries
    ]
    print(format_table(rows, title=f"{root}: {sum(one.size for one in entries) / 1e6:.1f} MB"))
    return 0


def clear(options: argparse.Namespace) -> int:
    """Delete entries of the cache. What a process is building stays; naming it is an error."""
    chosen = _chosen(cache_entries(cache_root()), options)
    if not chosen:
        print("nothing to delete")
    for one in chosen:
        if one.building and not options.names:
            print(f"kept {one.path}: {one.kind}")
            continue
        delete_entry(one)
        print(f"deleted {one.path} ({_megabytes(one)} MB, {one.kind})")
    return 0


def _chosen(entries: list[Entry], options: argparse.Namespace) -> list[Entry]:
    made = [one for one in entries if one.made]  # what a user put there is deleted by name alone
    if options.all:
        return made
    if options.older is not None:
        if not options.older >= 0.0:
            raise UserError(f"--older {options.older:g}: it must be a number of days, at least 0")
        return [one for one in made if one.days >= options.older]
    by_name = {one.path.name: one for one in entries}
    for name in options.names:
        if name not in by_name:
            close = difflib.get_close_matches(name, by_name, 1)
            hint = f"did you mean {close[0]}?" if close else "tflane cache list names all"
            raise UserError(f"the cache {cache_root()} has no entry {name}: {hint}")
    return [by_name[name] for name in dict.fromkeys(options.names)]


def _megabytes(entry: Entry) -> str:
    return f"{entry.size / 1e6:.1f}"

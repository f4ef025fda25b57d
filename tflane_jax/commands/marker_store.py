"""`tflane markers store`: writes the on-board store of a log's markers."""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

import numpy as np

from tflane_jax.commands.outputs import check_output
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, load_log, logs_within
from tflane_jax.datasets.marker_observations import store_of_log
from tflane_jax.errors import UserError
from tflane_jax.markers.store_files import load_store, save_store
from tflane_jax.plots.tables import format_table
from tflane_jax.scene.logs import Log
from tflane_jax.world.simulate import simulate

_LARGEST_RADIUS = 1e5  # metres


def run(options: argparse.Namespace) -> int:
    """Write a store, read it back, and print its content."""
    if not 0.0 < options.radius <= _LARGEST_RADIUS:
        raise UserError(f"--radius must be more than 0 and up to {_LARGEST_RADIUS:g} m, not {options.radius:g}")
    surveyed, expires = day_of(options.surveyed, "--surveyed"), day_of(options.expires, "--expires")
    if surveyed is not None and expires is not None and expires <= surveyed:
        raise UserError(f"--expires {expires} must be after --surveyed {surveyed}: before it, no entry would be valid")
    check_output(options.out, [] if options.log.isdecimal() else [Path(options.log)])
    log = _open_log(options.log)
    store = store_of_log(
        log, radius=options.radius, bike_lanes=options.bike_lanes == "include", surveyed=surveyed, expires=expires
    )
    if not store.markers:
        raise UserError(f"{log.name} has no junction, split or merge, and so no marker: take another --log")
    path = save_store(store, options.out, frame=options.frame)
    rows = []
    for number, marker in load_store(path).markers.items():
        x, y, z = marker.global_from_marker[:3, 3]
        length = np.linalg.norm(np.diff(marker.lanes, axis=1), axis=-1).sum()
        rows.append(
            {
                "marker": number,
                "x [m]": f"{x:.2f}",
                "y [m]": f"{y:.2f}",
                "z [m]": f"{z:.2f}",
                "lanes": len(marker.lanes),
                "joints": int(marker.successor.sum()),
                "lane metres": round(float(length)),
            }
        )
    print(format_table(rows, title=f"{log.name}: markers and the lanes within {options.radius:g} m of each"))
    print(f"\nwritten to {path} ({path.stat().st_size / 1000:.0f} kB)")
    if without := [row["marker"] for row in rows if not row["lanes"]]:
        print(
            f"tflane: warning: {len(without)} of {len(rows)} markers have no lanes (first: {without[0]}), and so give "
            "no prior: is --radius too small?",
            file=sys.stderr,
        )
    return 0


def _open_log(name: str) -> Log:
    """Return a scene of the built-in world by its number, or an Argoverse 2 log by its folder."""
    if name.isdecimal():
        return simulate(int(name))
    if not Path(name).is_dir():
        raise UserError(f"--log {name} is neither a scene number nor a folder: give an Argoverse 2 log or, say, 17")
    folder = Path(name)
    if not (folder / ANNOTATIONS).is_file() and (logs := logs_within(folder)):
        raise UserError(f"--log {name} is a folder of logs, and a store is of one: name it, such as {logs[0]}")
    return load_log(folder)


def day_of(text: str | None, option: str) -> datetime.date | None:
    """Return the day that an option gives, or None; raises UserError for anything else."""
    try:
        return None if text is None else datetime.date.fromisoformat(text)
    except ValueError:
        raise UserError(f"{option} {text} is no day: write it like 2025-07-11") from None

"""`tflane score`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tflane_jax.commands.outputs import check_table
from tflane_jax.errors import UserError
from tflane_jax.files.wording import check_name, named
from tflane_jax.metrics.groups import shown_of_part
from tflane_jax.plots.tables import format_table, save_table, written_to
from tflane_jax.scoring import remarks as about
from tflane_jax.scoring.protocols import ScoringProtocol, find_protocol
from tflane_jax.scoring.scenes import read_scenes, scene_names
from tflane_jax.scoring.score import Scored, check_bootstrap, score

_COUNTED = ("lanes", "lines")
"""Numbers of true lanes, or of lines of a map, that the scores of a part rest on."""

_MOST_DRAWS = 100_000


def run(options: argparse.Namespace) -> int:
    """Score, print the table, and write it as Markdown and JSON."""
    protocol = find_protocol(options.protocol)
    _check(options, protocol)
    drives: Path | None = options.scenes
    scenes = None if drives is None else read_scenes(drives)
    predictions, truth = protocol.read(options.predictions, options.truth)
    scene_of = protocol.scene_of if drives is None or scenes is None else scene_names(scenes, truth, drives)
    files = f"{options.predictions} against {options.truth}"
    if options.bootstrap and truth:
        check_bootstrap(len(set(map(scene_of, truth))))
    # Groups first: they ask for more than the total, and may fail at the first frame.
    grouping = protocol.groups.get(options.by or "")
    groups = None if grouping is None else _scored(files, lambda: score(predictions, truth, grouping, scene_of)).total()
    scored = _scored(files, lambda: score(predictions, truth, protocol.metrics, scene_of))
    remarks = protocol.remarks(predictions, truth)
    if protocol.zero_score and not remarks:  # which may be the reason
        remarks += about.nothing_near(predictions, truth, scored.total().get(protocol.zero_score), protocol.look_at)
    if options.bootstrap and protocol.no_scenes and drives is None:
        remarks.append(f"{protocol.no_scenes}: the intervals are too narrow (name the drives by --scenes FILE)")
    for remark in remarks:
        print(f"tflane: {remark}", file=sys.stderr)
    rows = _rows(scored, options.bootstrap)
    if options.by == "scene":
        rows += [{"part": named(name), **values} for name, values in scored.by_scene(protocol.of_scene).items()]
    rows += [{"part": group} | shown_of_part(values) for group, values in (groups or {}).items() if group != "all"]

    title = f"{options.predictions.name}: {scored.protocol}"
    # What the scores of a part rest on.
    counted = () if options.by is None else _COUNTED
    shown = [name for name in ("part", *protocol.columns, *counted, "frames") if any(name in row for row in rows)]
    meta = {
        "protocol": scored.protocol,
        "predictions": str(options.predictions),
        "ground_truth": str(options.truth),
        "scenes": len(scored.scenes),
        "bootstrap": options.bootstrap,
        "remarks": remarks,
    }
    paths = save_table(options.out, rows, meta, columns=shown, title=title, digits=4)
    print(format_table(rows, shown, title=title, digits=4))
    print(f"\n{written_to(paths)}")
    return 0


def _check(options: argparse.Namespace, protocol: ScoringProtocol) -> None:
    """Raise UserError for options that cannot be followed, before any file is read."""
    if not 0 <= options.bootstrap <= _MOST_DRAWS:
        raise UserError(f"--bootstrap {options.bootstrap}: give a number of draws up to {_MOST_DRAWS:,}, 0 for none")
    if options.by not in (None, "scene", *protocol.groups):
        raise UserError(f"{options.protocol} cannot be reported by {options.by}")
    inputs = [path for path in (options.predictions, options.truth, options.scenes) if path is not None]
    for path in inputs:
        check_name(path)
    if _same(options.predictions, options.truth):
        raise UserError(f"{options.predictions} is given as PREDICTIONS and as GROUND_TRUTH: name the other file too")
    check_table(options.out, inputs)


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return False


def _scored(files: str, run_score: Callable[[], Scored]) -> Scored:
    try:
        return run_score()
    except UserError as error:
        raise UserError(f"{files}: {error}") from None


def _rows(scored: Scored, samples: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = [{"part": "all", **scored.total()}]
    if samples:
        ends = scored.intervals(samples)
        for i, name in enumerate(("low, 2.5 %", "high, 97.5 %")):
            rows.append({"part": name} | {k: v[i] for k, v in ends.items() if isinstance(rows[0].get(k), float)})
    return rows

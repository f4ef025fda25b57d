"""`tflane score`."""

from __future__ import annotations

import argparse
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.scoring.protocols import find_protocol
from tflane_jax.scoring.score import Scored, score


def run(options: argparse.Namespace) -> int:
    """Score, print the table, and write it as Markdown and JSON."""
    protocol = find_protocol(options.protocol)
    if options.bootstrap < 0:
        raise UserError(f"--bootstrap {options.bootstrap}: give a number of draws, 0 for none")
    if options.by not in (None, "scene", *protocol.groups):
        raise UserError(f"{options.protocol} cannot be reported by {options.by}")
    predictions, truth = protocol.read_predictions(options.predictions), protocol.read_truth(options.truth)
    scored = score(predictions, truth, protocol.metrics, protocol.scene_of)
    rows = _rows(scored, options.by, options.bootstrap)
    if (grouping := protocol.groups.get(options.by or "")) is not None:
        grouped = score(predictions, truth, grouping, protocol.scene_of).total()
        rows += [{"part": group, **values} for group, values in grouped.items() if group != "all"]

    title = f"{options.predictions.name}: {scored.protocol}"
    shown = [name for name in ("part", *protocol.columns, "frames") if any(name in row for row in rows)]
    print(format_table(rows, shown, title=title, digits=4))
    meta = {
        "protocol": scored.protocol,
        "predictions": str(options.predictions),
        "ground_truth": str(options.truth),
        "scenes": len(scored.scenes),
        "bootstrap": options.bootstrap,
    }
    paths = save_table(options.out, rows, meta, columns=shown, title=title, digits=4)
    print(f"\nwritten to {paths[0]} and {paths[1]}")
    return 0


def _rows(scored: Scored, by: str | None, samples: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = [{"part": "all", **scored.total()}]
    if samples:
        ends = scored.intervals(samples)
        for i, name in enumerate(("low, 2.5 %", "high, 97.5 %")):
            rows.append({"part": name} | {k: v[i] for k, v in ends.items() if isinstance(rows[0].get(k), float)})
    if by == "scene":
        rows += [{"part": name, **values} for name, values in scored.by_scene().items()]
    return rows

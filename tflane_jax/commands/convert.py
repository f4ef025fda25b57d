"""`tflane convert`: published PyTorch weights to a run folder, for evaluation, prediction and fine-tuning.

Of a torchvision ResNet, the folder holds the backbone of a camera model alone, to start training from.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.config import load_config
from tflane_jax.convert.backbone import PART as BACKBONE
from tflane_jax.convert.backbone import is_backbone, load_backbone
from tflane_jax.convert.published import load_weights
from tflane_jax.convert.torch_file import read_checkpoint
from tflane_jax.convert.weights_files import lane_graph_weights
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import write_weights
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.runtime import configure_jax

_TABLE = "conversion"


def run(options: argparse.Namespace) -> int:
    """Write the run, and a table with the conversion of every tensor."""
    configure_jax()
    table, title, part = convert(options.config, options.out, options.weights, options.edge_weight, options.entry)
    print(format_table(table, title=title))
    count = sum(row["tensor"] != "-" for row in table)
    print(f"\n{count} tensors; run written to {options.out}, table to {options.out / _TABLE}.md")
    if part is not None:
        print(f"it holds {part} alone; train from it: --training.init-from {options.out} --training.init-partly")
    return 0


def convert(
    reference: str,
    out: Path,
    weights: Path | None = None,
    edge_weight: float | None = None,
    entry: str | None = None,
) -> tuple[list[dict[str, Any]], str, str | None]:
    """Write published weights as a run, with a table of what becomes of every tensor.

    Args:
        reference: of a configuration.
        out: folder of the run.
        weights: file, or name of published weights; None for those that the configuration names.
        edge_weight: weight of the selected edge types of a GTN encoder; None for the whole.
        entry: path of the weights in the file, such as "state_dict_ema"; None: found if it is unambiguous.

    Returns:
        The table's rows, its title, and which part of the model the run holds (None for all of it).

    Raises:
        UserError: the folder holds a run, there are no weights, or they do not fit the model.
    """
    if (out / "config.json").exists():
        raise UserError(f"{out} already holds a run: choose another folder with --out, or delete that one")
    config = load_config(reference)
    weights = weights or config.weights
    if weights is None:
        raise UserError(f"{reference} names no weights: add --weights FILE")
    part = None
    if isinstance(config.task, LaneGraphTask) and _is_backbone(lane_graph_weights(weights), entry):
        if edge_weight is not None:
            raise UserError(f"--edge-weight is of GTN encoders: {weights} is a backbone, leave it out")
        part = BACKBONE
        params, table = load_backbone(weights, config.task.model, entry)
        write_weights(config, params, out, part=part)
    else:
        params, table = load_weights(weights, config.task, "fresh", edge_weight, entry)
        write_weights(replace(config, weights=weights), params, out)
    title = f"{weights}: every tensor and what becomes of it"
    save_table(out / _TABLE, table, {"weights": str(weights)}, title=title)
    return table, title, part


def _is_backbone(path: Path, entry: str | None) -> bool:
    checkpoint = read_checkpoint(path, entry)
    return is_backbone(checkpoint.tensors, checkpoint.others)

"""`tflane convert`: published PyTorch weights to a run folder, for evaluation, prediction and fine-tuning.

Of a torchvision ResNet, the folder holds the backbone of a camera model alone, to start training from.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from tflane_jax.config import load_config
from tflane_jax.convert.backbone import PART as BACKBONE
from tflane_jax.convert.backbone import is_backbone, load_backbone
from tflane_jax.convert.published import load_weights
from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table, save_table
from tflane_jax.runs import save_weights
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.runtime import configure_jax


def run(options: argparse.Namespace) -> int:
    """Write the run, and a table with the conversion of every tensor."""
    if (options.out / "config.json").exists():
        raise UserError(f"{options.out} already holds a run: choose another folder with --out, or delete that one")
    configure_jax()
    config = load_config(options.config)
    weights = options.weights or config.weights
    if weights is None:
        raise UserError(f"{options.config} names no weights: add --weights FILE")
    part = None
    if isinstance(config.task, LaneGraphTask) and is_backbone(read_state_dict(weights)):
        if options.edge_weight is not None:
            raise UserError(f"--edge-weight is of GTN encoders: {weights} is a backbone, leave it out")
        part = BACKBONE
        params, table = load_backbone(weights, config.task.model)
        save_weights(config, params, options.out, part=part)
    else:
        params, table = load_weights(weights, config.task, "fresh", options.edge_weight)
        save_weights(replace(config, weights=weights), params, options.out)
    title = f"{weights}: every tensor and what becomes of it"
    print(format_table(table, title=title))
    written = save_table(options.out / "conversion", table, {"weights": str(weights)}, title=title)
    count = sum(row["tensor"] != "-" for row in table)
    print(f"\n{count} tensors; run written to {options.out}, table to {written[0]}")
    if part is not None:
        print(f"it holds {part} alone; train from it: --training.init-from {options.out} --training.init-partly")
    return 0

"""`tflane data export`: a dataset with cameras in OpenLane-V2's layout."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from tflane_jax.commands.sources import lane_graph_source
from tflane_jax.config import apply_overrides, load_config
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table
from tflane_jax.tasks.lane_graph import open_dataset


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Write the splits, check what was written, and print how much it is."""
    config = apply_overrides(load_config(options.config), overrides)
    datasets = {}
    for split in dict.fromkeys(options.splits):
        options.split = split
        datasets[split] = open_dataset(lane_graph_source(config, options))
    out = export_openlane_v2(datasets, options.out, images=options.images)
    found = check_openlane_v2(out, progress=False)
    print(format_table(found.rows, title=f"{out}: OpenLane-V2, subset {found.subset}"))
    if found.faults:
        raise UserError(f"what was written to {out} is not sound: {found.faults[0]}")
    return 0

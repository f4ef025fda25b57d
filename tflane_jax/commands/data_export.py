"""`tflane data export`: writes a dataset with cameras in OpenLane-V2's layout."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from tflane_jax.commands.sources import chosen_source
from tflane_jax.config import apply_overrides, load_config
from tflane_jax.datasets import sources
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.errors import UserError
from tflane_jax.plots.tables import format_table


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Write the splits, check the written files, and print their counts."""
    config = apply_overrides(load_config(options.config), overrides)
    splits = dict.fromkeys(options.splits)
    datasets = {split: sources.open_dataset(chosen_source(config, options, split)) for split in splits}
    out = export_openlane_v2(datasets, options.out, images=options.images)
    found = check_openlane_v2(out, progress=False)
    print(format_table(found.rows, title=f"{out}: OpenLane-V2, subset {found.subset}"))
    if found.faults:
        raise UserError(f"what was written to {out} has faults: {found.faults[0]}")
    return 0

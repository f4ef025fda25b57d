"""`tflane data maps`: a recorded frame of each log beside a simulated one on the same map."""

from __future__ import annotations

import argparse
from dataclasses import replace

from tflane_jax.commands.outputs import check_output
from tflane_jax.datasets.real_maps import RealMapConfig, RealMapDataset
from tflane_jax.datasets.recorded_logs import RecordedConfig, RecordedDataset
from tflane_jax.datasets.road_maps import chosen_maps
from tflane_jax.errors import UserError
from tflane_jax.plots import save_contact_sheet
from tflane_jax.scene import Example
from tflane_jax.world.presets import REAL_MAPS


def run(options: argparse.Namespace) -> int:
    """Draw the frames of recorded logs and of the world on their maps, a row for each log."""
    check_output(options.out, [options.root])
    if options.scene < 0:
        raise UserError(f"--scene is the number of a scene, 0 or more, not {options.scene}")
    logs = [one.name for one in chosen_maps(options.root, options.logs) if one.recorded]
    if not logs:
        raise UserError(f"{options.root} holds maps without recordings: tflane data show --data real-maps draws those")
    as_recorded = replace(REAL_MAPS, mirrored=0.0)
    frames: list[Example] = []
    titles: list[str] = []
    for log in logs:
        recorded = RecordedDataset(RecordedConfig(options.root, (log,)))
        config = RealMapConfig(options.root, (log,), scenes=1, first=options.scene, world=as_recorded)
        simulated = RealMapDataset(config)
        titles += [f"{log[:16]}, recorded", f"{log[:16]}, simulated"]
        frames += [recorded.example(int(len(recorded) * options.moment)), simulated.example(len(simulated) - 1)]
    example = RecordedConfig(options.root).example
    path = save_contact_sheet(options.out, frames, titles, ground=example.ground, view=example.range)
    print(f"written to {path}")
    return 0

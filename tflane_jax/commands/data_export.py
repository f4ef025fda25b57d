"""`tflane data export`: writes a dataset with cameras in OpenLane-V2's layout, and its tracks as the logs behind it.

Seven cameras are subset A, whose logs are Argoverse 2's; six are subset B, whose logs are nuScenes' scenes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tflane_jax.commands.sources import check_used, chosen_source
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import sources
from tflane_jax.datasets.argoverse2_export import export_tracks
from tflane_jax.datasets.base import DrivenDataset, Split
from tflane_jax.datasets.nuscenes_export import export_scenes
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_choice import subset_of
from tflane_jax.datasets.openlane_export import export_openlane_v2, time_offset
from tflane_jax.datasets.openlane_sd_map import sd_records
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder
from tflane_jax.plots.tables import format_table
from tflane_jax.scene import RoadImage
from tflane_jax.scene.logs import Log
from tflane_jax.world.roads.sd_map import sd_lines


def run(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Write the splits, check the written files, and print their counts."""
    before = load_config(options.config)
    config = apply_overrides(before, overrides)
    splits: dict[Split, None] = dict.fromkeys(options.splits)

    def choose(given: RunConfig) -> dict[Split, Any]:
        return {split: chosen_source(given, options, split) for split in splits}

    chosen: dict[Split, Any] = choose(config)
    check_used(overrides, before, config, choose, options.data)
    tracks: Path | None = options.tracks
    _check_folders(options.out, tracks)
    _check_cameras(chosen)
    for split, source in chosen.items():
        chosen[split] = _with_corners(source)
    driven = {} if tracks is None else _driven(chosen)
    datasets: dict[Split, Any] = {split: sources.open_dataset(source) for split, source in chosen.items()}
    out = export_openlane_v2(datasets, options.out, images=options.images, sd_maps=_sd_maps(chosen))
    if tracks is not None:
        if subset_of(out) == "A":
            export_tracks(_drives(driven), tracks, partial(time_offset, "A"))
        else:
            export_scenes((log for _, log in _drives(driven)), tracks, partial(time_offset, "B"))
    found = check_openlane_v2(out, tracks, cameras="some", progress=False)
    print(format_table(found.rows, title=f"{out}: {found.format}"))
    if found.faults:
        raise UserError(f"what was written to {out} has faults: {found.faults[0]}")
    return 0


def _with_corners(source: Any) -> Any:
    """Return a source whose crossings keep their corners, which OpenLane-V2 stores and equally spaced points miss."""
    return replace(source, example=replace(source.example, crossings="sides"))


def _check_folders(out: Path, tracks: Path | None) -> None:
    """Raise UserError before examples are made, which may take an hour, where the folders cannot take them."""
    for folder in (out,) if tracks is None else (out, tracks):
        if folder.is_dir() and any(folder.iterdir()):
            raise UserError(f"{folder} is not empty: choose another folder")
        check_folder(folder)
    if tracks is None:
        return
    if tracks.resolve() == out.resolve():
        raise UserError(f"--out and --tracks are both {out}: the tracks need a folder of their own")
    if tracks.resolve() in out.resolve().parents:
        raise UserError(f"--out {out} is inside of --tracks {tracks}: the tracks need a folder of their own")


def _check_cameras(chosen: Mapping[Split, Any]) -> None:
    for source in chosen.values():
        kind, name = sources.source_of(source), sources.source_name(source)
        if kind.example is RoadImage:
            raise UserError(f"{name} are single images: OpenLane-V2 has six or seven cameras")
        if source.example.cameras is None and getattr(source, "image", None) is None:
            remedy = "choose data with cameras"
            if kind.build is not None:
                remedy = "set data.example.cameras"
            elif hasattr(source, "image"):
                remedy = "name a configuration with cameras (--config)"
            raise UserError(f"{name} has no camera images, which OpenLane-V2 needs: {remedy}")


def _sd_maps(chosen: Mapping[Split, Any]) -> dict[Split, dict[str, Any]]:
    """Return the SD maps of the scenes of each split whose examples have one, where the source has logs."""
    maps: dict[Split, dict[str, Any]] = {}
    for split, source in chosen.items():
        dataset, wanted = sources.make_dataset(source), getattr(source.example, "sd_map", None)
        if wanted is not None and isinstance(dataset, DrivenDataset):
            maps[split] = {log.name: sd_records(*sd_lines(log, wanted)) for log in dataset.drives()}
    return maps


def _driven(chosen: Mapping[Split, Any]) -> dict[Split, DrivenDataset]:
    """Return the datasets that hold the logs of the splits; raise UserError where tracks cannot be written."""
    driven = {}
    for split, source in chosen.items():
        dataset = sources.make_dataset(source)
        if not isinstance(dataset, DrivenDataset):
            raise UserError(f"--tracks: {sources.source_name(source)} has no logs whose tracks could be written")
        cameras = dataset.example(0).cameras  # pyright: ignore[reportAttributeAccessIssue]
        if cameras is not None and len(cameras.valid) not in (6, 7):
            raise UserError(
                "--tracks writes Argoverse 2 logs for subset A with seven cameras, or nuScenes' tables for subset B "
                f"with six; this dataset has {len(cameras.valid)}: choose another ring, data.example.cameras.cameras"
            )
        driven[split] = dataset
    return driven


def _drives(driven: Mapping[Split, DrivenDataset]) -> Iterator[tuple[Split, Log]]:
    for split, dataset in driven.items():
        for log in dataset.drives():
            yield split, log

"""`tflane data show`, `data check`, `data overlap` and `data build`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tflane_jax.commands.sources import lane_graph_source, lane_shape_source, source_name
from tflane_jax.config import FrontViewData, LaneShapeSource, RunConfig, apply_overrides, load_config
from tflane_jax.datasets.argoverse2 import check_log, find_logs, load_log
from tflane_jax.datasets.batches import prepared
from tflane_jax.datasets.front_views import FrontViewConfig
from tflane_jax.datasets.front_views import load_road_images as load_front_views
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.overlap import overlap, read_drives
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.errors import UserError
from tflane_jax.plots import dataset_summary, format_table, save_camera_views, save_table, show_dataset
from tflane_jax.scene import stack_examples
from tflane_jax.tasks import spread
from tflane_jax.tasks.lane_graph import open_dataset
from tflane_jax.tasks.lane_shape import LaneShapeTask, open_images

_FAULTS = 50  # printed


def show(options: argparse.Namespace) -> int:
    """Draw samples and print what they hold."""
    config = RunConfig() if options.config is None else load_config(options.config)
    if isinstance(config.task, LaneShapeTask) or options.data in ("front-views", "tusimple"):
        config = _images(config)
        return _show_images(lane_shape_source(config, options), config, options)
    source = lane_graph_source(config, options)
    # Not from the cache: a few examples are made sooner than all of them.
    dataset = ProceduralDataset(source) if isinstance(source, ProceduralConfig) else open_dataset(source)
    picture = show_dataset(dataset, options.count, options.out, ground=source.example.ground, view=source.example.range)
    indices = spread(len(dataset), options.count)
    examples = stack_examples([dataset.example(index) for index in indices])
    written = [picture]
    if examples.cameras is not None:
        path = options.out.with_stem(f"{options.out.stem}-cameras")
        written.append(save_camera_views(path, examples, ground=source.example.ground, view=source.example.range))
    print(format_table(dataset_summary(examples), title=f"{source_name(source)}: the {len(indices)} examples drawn"))
    print("\nwritten to", *written)
    return 0


def _images(config: RunConfig) -> RunConfig:
    """Return a configuration whose data are images: a task needs no config file to have some shown."""
    return config if isinstance(config.task, LaneShapeTask) else RunConfig(LaneShapeTask(), FrontViewData())


def _show_images(source: LaneShapeSource, config: RunConfig, options: argparse.Namespace) -> int:
    from tflane_jax.plots.images import save_road_images

    dataset = open_images(source)
    if options.count < 1 or len(dataset) == 0:
        raise UserError(f"nothing to show: {dataset.name} has {len(dataset)} images, {options.count} asked for")
    indices = spread(len(dataset), options.count)
    examples = stack_examples([dataset.example(index) for index in indices])
    columns = {"images": examples}
    if (prepare := config.task.prepare(config.data)) is not None:
        columns["augmented"] = prepared(examples, prepare, 0, 0)
    for name, shown in columns.items():
        path = options.out if name == "images" else options.out.with_stem(f"{options.out.stem}-{name}")
        print(f"{name} written to {save_road_images(path, shown, titles=[f'image {index}' for index in indices])}")
    counts = np.bincount(examples.lines.valid.sum(-1))
    rows = [{"lane lines": lines, "images": int(images)} for lines, images in enumerate(counts) if images]
    print("\n" + format_table(rows, title=f"{source_name(source)}: the {len(indices)} images drawn"))
    return 0


def check(options: argparse.Namespace) -> int:
    """Say what a dataset lacks; exit code 2 where it lacks something."""
    if options.format == "openlane-v2":
        return _check_openlane_v2(Path(options.root))
    lacking = 0
    for folder in find_logs(Path(options.root)):
        faults = check_log(folder)
        lacking += bool(faults)
        if faults:
            print(f"{folder}: cannot be read", *(f"  - {fault}" for fault in faults), sep="\n")
            continue
        log = load_log(folder)
        print(
            f"{folder}: ok, {len(log.keyframes)} key frames, {log.tracks.frames} annotated frames, "
            f"{len(log.tracks.uuid)} road users, {len(log.map.segments)} lane segments"
        )
    return 2 if lacking else 0


def _check_openlane_v2(root: Path) -> int:
    found = check_openlane_v2(root)
    print(format_table(found.rows, title=f"{root}: OpenLane-V2, subset {found.subset}"))
    if found.faults:
        print(f"\n{len(found.faults)} faults:", *(f"  - {fault}" for fault in found.faults[:_FAULTS]), sep="\n")
    if len(found.faults) > _FAULTS:
        print(f"  ... and {len(found.faults) - _FAULTS} more")
    return 2 if found.faults else 0


def overlap_of_splits(options: argparse.Namespace) -> int:
    """Print how much of a validation split lies near training frames."""
    train, validation = read_drives(options.train), read_drives(options.validation)
    found = overlap(train, validation)
    title = (
        f"share of {sum(map(len, found.distances))} validation frames ({len(validation)} drives) with a training frame "
        f"({len(train)} drives) nearby"
    )
    print(format_table(found.rows(), title=title))
    if found.worst():
        print("\n" + format_table(found.worst(), title="validation drives that overlap most"))
    if any(drive.area == "unknown" for drive in (*train, *validation)):
        print("\nThese files do not name the city: places of different cities may coincide by chance.")
    if options.out is not None:
        sides = {"train": str(options.train), "validation": str(options.validation)}
        meta = {**sides, "worst": found.worst(len(validation))}
        print("\nwritten to", *save_table(options.out, found.rows(), meta, title=title))
    return 0


def build(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Fill the cache for every split of a configuration."""
    config = RunConfig() if options.config is None else load_config(options.config)
    config = apply_overrides(config, overrides)
    for split in ("train", "val", "test"):
        source = config.data.source(split)
        if isinstance(source, ProceduralConfig):
            print(f"{split}: {len(open_dataset(source))} examples ready")
        elif isinstance(source, FrontViewConfig):
            print(f"{split}: {len(load_front_views(source).image)} images ready")
        else:
            print(f"{split}: real logs are read when they are needed, nothing to build")
    return 0

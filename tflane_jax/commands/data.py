"""`tflane data show`, `data check`, `data overlap` and `data build`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.commands.outputs import check_output, check_table, folders_of
from tflane_jax.commands.sources import check_used, chosen_source, data_name
from tflane_jax.commands.views import with_images
from tflane_jax.config import FrontViewData, RunConfig, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import SPLITS, IndexedExamples, spread
from tflane_jax.datasets.batches import prepared
from tflane_jax.datasets.overlap import has_official_splits, overlap, read_drives
from tflane_jax.errors import UserError, printable
from tflane_jax.files.wording import counted
from tflane_jax.plots import dataset_summary, format_table, save_camera_views, save_contact_sheet, save_table
from tflane_jax.plots.tables import written_to
from tflane_jax.scene import RoadImage, stack_examples
from tflane_jax.tasks.lane_pictures import titles
from tflane_jax.tasks.lane_shape import LaneShapeTask

_PRINTED = 50  # faults, and entries skipped
_FORMAT = "argoverse2"  # of `data check`, by default


def show(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Draw samples of a split, and print counts of their content."""
    check_output(options.out)
    before = RunConfig() if options.config is None else load_config(options.config)
    config = apply_overrides(before, overrides)
    images = options.data is not None and sources.named_source(options.data).example is RoadImage

    def choose(given: RunConfig) -> Any:
        return chosen_source(_images(given) if images else given, options)

    source = choose(config)
    check_used(overrides, before, config, choose, options.data)
    check_output(options.out, folders_of(source))
    if sources.source_of(source).example is RoadImage:
        return _show_images(source, config, options)
    dataset = sources.make_dataset(source)
    indices = _chosen(dataset, options.count, "examples")
    chosen = [dataset.example(index) for index in indices]
    shape = {"ground": source.example.ground, "view": source.example.range}
    numbered = [f"{index}: {dataset.info(index).scene[:16]}" for index in indices]
    written = [save_contact_sheet(options.out, chosen, numbered, **shape)]
    examples = stack_examples(chosen)
    shown, seen = with_images(examples, source, indices)
    if shown:
        path, names = options.out.with_stem(f"{options.out.stem}-cameras"), titles(dataset, indices)
        written.append(save_camera_views(path, seen, titles=[names[i] for i in shown], **shape))
    title = f"{data_name(source, options)}: {_drawn(len(indices), 'example')}"
    print(format_table(dataset_summary(examples), title=title, digits=2))
    print(f"\n{written_to(written)}")
    return 0


def _chosen(dataset: IndexedExamples, count: int, what: str) -> list[int]:
    if indices := spread(len(dataset), count):
        return indices
    raise UserError(f"nothing to show: {dataset.name} has {len(dataset)} {what}, {count} asked for")


def _drawn(count: int, what: str) -> str:
    return f"the {what} drawn" if count == 1 else f"the {count} {what}s drawn"


def _images(config: RunConfig) -> RunConfig:
    """Return a configuration for images, so that --data can show images without a config file."""
    return config if isinstance(config.task, LaneShapeTask) else RunConfig(LaneShapeTask(), FrontViewData())


def _show_images(source: Any, config: RunConfig, options: argparse.Namespace) -> int:
    from tflane_jax.plots.images import save_road_images

    dataset = sources.make_dataset(source)
    indices = _chosen(dataset, options.count, "images")
    examples = stack_examples([dataset.example(index) for index in indices])
    columns = {"images": examples}
    if (prepare := config.task.prepare(config.data)) is not None:
        larger = sources.make_dataset(config.task.training_form(source, config.data))
        taken = stack_examples([larger.example(index) for index in indices])
        columns["augmented"] = prepared(taken, prepare, 0, 0)
    for name, shown in columns.items():
        path = options.out if name == "images" else options.out.with_stem(f"{options.out.stem}-{name}")
        print(f"{name} written to {save_road_images(path, shown, titles=[f'image {index}' for index in indices])}")
    counts = np.bincount(examples.lines.valid.sum(-1))
    rows = [{"lane lines": lines, "images": int(images)} for lines, images in enumerate(counts) if images]
    print("\n" + format_table(rows, title=f"{data_name(source, options)}: {_drawn(len(indices), 'image')}"))
    return 0


def check(options: argparse.Namespace) -> int:
    """Print counts and faults of a dataset's folder; the exit code is 2 if there are faults."""
    source = sources.named_source(options.format or _FORMAT)
    if source.check is None:
        names = ", ".join(one.name for one in sources.SOURCES if one.check is not None)
        raise UserError(
            f"--format {source.name} has no check of a folder: choose one of {names}; a dataset of your own gets one "
            "by `check` of its DataSource"
        )
    wanted: dict[str, Any] = {} if options.tracks is None else {"tracks": options.tracks}
    if wanted and not source.tracks:
        raise UserError("--tracks belongs to --format openlane-v2: other datasets hold their tracks themselves")
    if options.whole_images:
        if not source.tracks:
            raise UserError("--whole-images belongs to --format openlane-v2")
        wanted["images"] = "whole"
    try:
        found = source.check(Path(options.root), **wanted)
    except UserError as error:
        if options.format is not None:
            raise
        others = ", ".join(one.name for one in sources.SOURCES if one.check is not None and one.name != _FORMAT)
        raise UserError(f"{error}; name other data with --format ({others})") from None
    print(format_table(found.rows, title=f"{options.root}: {found.format}"))
    _print_list(counted(len(found.faults), "fault"), found.faults, every=options.all)
    _print_list(f"{len(found.skipped)} skipped", found.skipped, every=options.all)
    return 2 if found.faults else 0


def _print_list(title: str, texts: Sequence[str], *, every: bool) -> None:
    if not texts:
        return
    shown = texts if every else texts[:_PRINTED]
    print(f"\n{title}:", *(f"  - {printable(text)}" for text in shown), sep="\n")
    if len(shown) < len(texts):
        print(f"  ... and {len(texts) - len(shown)} more: --all lists them")


def overlap_of_splits(options: argparse.Namespace) -> int:
    """Print the fraction of a validation split that lies near training frames."""
    if options.out is not None:
        check_table(options.out, [options.train, options.validation])
    official = options.train.resolve() == options.validation.resolve() and has_official_splits(options.train)
    train = read_drives(options.train, "train" if official else None)
    validation = read_drives(options.validation, "val" if official else None)
    found = overlap(train, validation)
    title = (
        f"fraction of {sum(map(len, found.distances))} validation frames ({len(validation)} drives) near a training "
        f"frame ({len(train)} drives)"
    )
    print(format_table(found.rows(), title=title))
    if found.worst():
        print("\n" + format_table(found.worst(), title="validation drives that overlap most"))
    if official:
        print("\nBoth sides are one folder: its scenes of nuScenes' official splits, train against val.")
    if any(not drive.area for drive in (*train, *validation)):
        print("\nThese files do not name the city, so places of different cities may coincide by chance.")
    if options.out is not None:
        sides = {"train": str(options.train), "validation": str(options.validation)}
        meta = {**sides, "worst": found.worst(len(validation))}
        print(f"\n{written_to(save_table(options.out, found.rows(), meta, title=title))}")
    return 0


def build(options: argparse.Namespace, overrides: Sequence[str]) -> int:
    """Generate the examples of every split of a configuration, if its source generates examples."""
    config = RunConfig() if options.config is None else load_config(options.config)
    config = apply_overrides(config, overrides)
    for split in SPLITS:
        source = config.data.source(split)
        build = sources.source_of(source).build
        if build is None:
            print(f"{split}: {sources.source_name(source)} is read on demand, nothing to build")
        else:
            print(f"{split}: {build(source, True)} examples ready")
    return 0

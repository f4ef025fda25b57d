"""The model and the data that a command's options name."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from tflane_jax.config import LaneGraphSource, LaneShapeSource, RunConfig, Source, load_config
from tflane_jax.datasets.argoverse2 import Argoverse2Config
from tflane_jax.datasets.front_views import FrontViewConfig
from tflane_jax.datasets.openlane_frames import subset_of
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.datasets.tusimple import TuSimpleConfig
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, TOPONET_SUBSET_B
from tflane_jax.errors import UserError
from tflane_jax.runs import Run, open_run, open_weights
from tflane_jax.tasks.lane_graph import LaneGraphTask, limit_instances
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.world.cameras.ring import CameraRigConfig


def opened(options: argparse.Namespace) -> tuple[Run, list[Path]]:
    """Return the model that is named, by --config (published weights) or as first input (a run), and further inputs."""
    if options.config is not None:
        config = load_config(options.config)
        return open_weights(replace(config, weights=options.weights or config.weights)), options.inputs
    if options.weights is not None:
        raise UserError("--weights are those of a configuration: add --config FILE")
    if not options.inputs:
        raise UserError("say which model: a run folder, or --config FILE with published weights")
    return open_run(options.inputs[0], options.checkpoint), options.inputs[1:]


def limited_task(run: Run, options: argparse.Namespace) -> Any:
    """Return the run's task with the road users that --max-instances leaves; None where it is not given."""
    if options.max_instances is None:
        return None
    if not isinstance(run.config.task, LaneGraphTask):
        raise UserError("--max-instances limits traffic flow, and this model takes none")
    return limit_instances(run.config.task, options.max_instances)


def chosen_source(config: RunConfig, options: argparse.Namespace) -> Source:
    """Return the source that --split, --data, --root and --openlane name, of the kind that the task takes."""
    if isinstance(config.task, LaneShapeTask):
        return lane_shape_source(config, options)
    return lane_graph_source(config, options)


def lane_graph_source(config: RunConfig, options: argparse.Namespace) -> LaneGraphSource:
    """Return the source of lanes around the vehicle that is named; capacities stay as configured."""
    configured = config.data.source(options.split)
    if not isinstance(configured, LaneGraphSource):
        raise UserError("this configuration's data are images, but its task wants lanes around the vehicle")
    kept = (Argoverse2Config, OpenLaneV2Config)
    if options.data is None and options.root is not None and not isinstance(configured, kept):
        raise UserError("--root is the folder of real data: add --data argoverse2 or --data openlane-v2")
    if options.data == "procedural":
        if isinstance(configured, ProceduralConfig):
            return configured
        return ProceduralConfig(split=options.split, scenes=100, example=configured.example)
    real = options.data is None and options.root is not None
    if options.data == "openlane-v2" or (real and isinstance(configured, OpenLaneV2Config)):
        if options.root is None:
            raise UserError("--data openlane-v2 needs --root PATH, its folder")
        if isinstance(configured, OpenLaneV2Config):
            return replace(configured, root=Path(options.root))
        subset = subset_of(Path(options.root))
        image = TOPONET_SUBSET_A if subset == "A" else TOPONET_SUBSET_B
        return OpenLaneV2Config(Path(options.root), options.split, subset, image=image, example=configured.example)
    if options.data == "world-cameras":
        rig = configured.example.cameras or CameraRigConfig(scale=0.3)
        example = replace(configured.example, cameras=rig)
        return ProceduralConfig(split=options.split, scenes=100, example=example)
    if options.data == "argoverse2" or real:
        if options.root is None:
            raise UserError("--data argoverse2 needs --root PATH, a log or a folder of logs")
        openlane = None if options.openlane is None else Path(options.openlane)
        return Argoverse2Config(Path(options.root), openlane=openlane, example=configured.example)
    if options.data is not None:
        raise UserError(f"--data {options.data} are images: this model takes procedural, argoverse2 or openlane-v2")
    return configured


def lane_shape_source(config: RunConfig, options: argparse.Namespace) -> LaneShapeSource:
    """Return the source of front-view images that is named."""
    configured = config.data.source(options.split)
    if not isinstance(configured, LaneShapeSource):
        raise UserError("this configuration's data are no images, but its task wants some")
    if options.data is None and options.root is not None and not isinstance(configured, TuSimpleConfig):
        raise UserError("--root is TuSimple's folder: add --data tusimple")
    if options.data == "tusimple" or (options.data is None and options.root is not None):
        if options.root is None:
            raise UserError("--data tusimple needs --root PATH, the folder with clips and label files")
        return TuSimpleConfig(options.root)
    if options.data == "front-views":
        return configured if isinstance(configured, FrontViewConfig) else FrontViewConfig(options.split, images=100)
    if options.data is not None:
        raise UserError(f"--data {options.data} are no images: this model takes front-views or tusimple")
    return configured


def source_name(source: Source) -> str:
    """Return a name for titles and files."""
    if isinstance(source, FrontViewConfig):
        return f"front-views-{source.split}"
    if isinstance(source, TuSimpleConfig):
        return f"tusimple-{source.split}"
    if isinstance(source, ProceduralConfig):
        return f"procedural-{source.split}"
    if isinstance(source, OpenLaneV2Config):
        return f"openlane-v2-{source.subset}-{source.split}"
    return "argoverse2"


def make_folder(folder: Path) -> None:
    """Make a folder for what a command writes; raises UserError where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror or error}") from error

"""Lane graphs around the vehicle: the systems of TF-Lane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tflane_jax.config import LaneGraphSource, RunConfig
from tflane_jax.datasets.argoverse2 import Argoverse2Dataset
from tflane_jax.datasets.base import Dataset
from tflane_jax.datasets.cache import CachedDataset, cached
from tflane_jax.datasets.loading import TRAINING_PARTS, keep, load_arrays
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset, nominal_example
from tflane_jax.datasets.photometric import PhotometricConfig, augment_example
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.datasets.streaming import Prepare, Streamed
from tflane_jax.errors import UserError
from tflane_jax.evaluation.evaluate import Sightings, evaluate_lanes, predictions
from tflane_jax.files.openlane import ATTRIBUTES
from tflane_jax.metrics.openlane_v2 import GroupedCenterlineMetrics
from tflane_jax.models.bevformer import check_capacity
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.scene import ElementPrediction, Example, LanePrediction, shapes_of, stack_examples
from tflane_jax.tasks.base import Evaluation, Model, spread
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.batches import first_example
from tflane_jax.training.loop import Draw
from tflane_jax.training.records import Record
from tflane_jax.training.task import Params

_COMPARED_EXAMPLES = 6
IN_MEMORY = 6 * 2**30
"""Bytes of training examples that are held in memory; more are read from the disk while training."""


class LaneGraphSystem:
    """See `tasks.base.System`."""

    columns: tuple[str, ...] = (
        "lanes of",
        "seed",
        "OLS",
        "DET_l",
        "DET_t",
        "TOP_ll",
        "TOP_lt",
        "DET_l@1.0",
        "DET_l@2.0",
        "DET_l@3.0",
        "lanes",
        "frames",
    )
    compared: tuple[str, ...] = (
        "all/OLS",
        "all/DET_t",
        "all/TOP_lt",
        *(
            f"{group}/{name}"
            for name in ("DET_l", "TOP_ll", "recall")
            for group in ("all", "occluded", "clear", *Sightings.groups)
        ),
    )
    errors: tuple[str, ...] = ()

    def load(self, source: LaneGraphSource, *, progress: bool = True) -> Example | Streamed:
        """Return the examples of a source, stacked; those of OpenLane-V2, and of a large world, are read while used."""
        dataset = open_dataset(source, progress=progress)
        select = partial(keep, parts=TRAINING_PARTS)
        if isinstance(source, OpenLaneV2Config):
            return Streamed(dataset, source.loading, select)
        if isinstance(dataset, CachedDataset) and dataset.nbytes(TRAINING_PARTS) > IN_MEMORY:
            return Streamed(dataset, select=select)
        return load_arrays(dataset, parts=TRAINING_PARTS, progress=progress)

    def examples(self, config: RunConfig, data: Example | Streamed) -> Example | Streamed:
        """Return the examples themselves, or the clips that they are in."""
        task = config.task
        assert isinstance(task, LaneGraphTask)
        return data if task.clip == 1 else clips(data, task.clip)

    def shapes(self, config: RunConfig) -> Example:
        """Return shapes of the training parts of an example."""
        source = _source(config, "train")
        if isinstance(source, OpenLaneV2Config) and not source.root.is_dir():
            example = nominal_example(source)
        else:
            # Not from the cache: one example is made sooner than all of them.
            made = isinstance(source, ProceduralConfig)
            example = (ProceduralDataset(source) if made else open_dataset(source)).example(0)
        return shapes_of(keep(example, TRAINING_PARTS))

    def check(self, config: RunConfig, data: Example | Streamed) -> None:
        """Raise UserError where a camera sees more BEV cells than it can serve."""
        encoder, cameras = config.task.model.encoder, first_example(data).cameras
        if isinstance(encoder, CameraEncoderConfig) and cameras is not None:
            check_capacity(encoder.bev, cameras)

    def prepare(self, config: RunConfig) -> Prepare | None:
        """Return the photometric augmentation of the configuration's data, if it has one."""
        augmentation = getattr(config.data, "augmentation", None)
        if augmentation is None:
            return None
        return partial(_augmented, augmentation)

    def evaluate(self, task: Any, params: Params, data: Example | Streamed, batch_size: int) -> Evaluation:
        """Return OpenLane-V2's centerline metrics for all, occluded and clear lanes."""
        metrics = evaluate_lanes(task, params, data, batch_size)
        return Evaluation(metrics.protocol, metrics.compute())

    def score_names(self, config: RunConfig) -> set[str]:
        """Return OpenLane-V2's centerline metrics by group, with those of traffic elements if the model has them."""
        task = config.task
        assert isinstance(task, LaneGraphTask)
        marked = _source(config, "val").example.markers is not None
        groups = Sightings.groups if marked else ()
        names = set(Evaluation("", GroupedCenterlineMetrics(frame_groups=groups).compute()).scores())
        if task.model.elements is not None:
            of_elements = ("OLS", "TOP_lt", "DET_t", *(f"DET_t@{i}" for i in range(ATTRIBUTES)))
            names |= {f"{group}/{name}" for group in ("all", *groups) for name in of_elements}
        return names

    def drawing(self, config: RunConfig) -> Draw:
        """Return the function that draws a few validation examples from above and in their camera images."""
        from tflane_jax.plots import save_camera_views, save_examples

        source = _source(config, "val")
        dataset = open_dataset(source)
        indices = spread(len(dataset), config.evaluation.pictures)

        def draw(folder: Path, step: int, params: Params, records: list[Record]) -> None:
            if indices:
                examples, lanes, elements = predict_examples(config.task, params, dataset, indices)
                path, names = folder / "pictures" / f"step_{step:08d}.png", titles(dataset, indices)
                ground, view = source.example.ground, source.example.range
                save_examples(path, examples, {f"step {step}": lanes}, titles=names, ground=ground, view=view)
                if examples.cameras is not None:
                    path = path.with_stem(f"{path.stem}_cameras")
                    save_camera_views(path, examples, lanes, elements, titles=names, ground=ground, view=view)

        return draw

    def inference_variants(self, task: Any) -> dict[str, Any]:
        """Return a model with traffic flow once more without any (TF-Lane, Table 7)."""
        if task.traffic_flow is None:
            return {}
        return {"no traffic flow at inference": limit_instances(task, 0)}

    def remarks(self, model: Model) -> dict[str, str]:
        """Return nothing."""
        return {}

    def quoted(self) -> list[dict[str, str]]:
        """Return nothing: the papers' numbers are of real data."""
        return []

    def draw_comparison(
        self, models: Mapping[str, Model], source: LaneGraphSource, data: Example | Streamed, path: Path
    ) -> Path:
        """Draw the test frames with the most hidden lanes (of streamed data, any), every model beside the truth."""
        from tflane_jax.plots import save_examples

        dataset = open_dataset(source)
        if isinstance(data, Streamed):
            indices = spread(len(data), _COMPARED_EXAMPLES)
        else:
            hidden = (data.lanes.valid & (data.lanes.visibility < 0.5)).sum(-1)
            indices = np.argsort(-hidden, kind="stable")[:_COMPARED_EXAMPLES].tolist()
        examples = stack_examples([dataset.example(index) for index in indices])
        lanes = {
            name: predict_examples(model.task, model.params, dataset, indices)[1] for name, model in models.items()
        }
        return save_examples(
            path,
            examples,
            lanes,
            titles=titles(dataset, indices),
            ground=source.example.ground,
            view=source.example.range,
        )


def open_dataset(source: LaneGraphSource, *, progress: bool = True) -> Dataset:
    """Return the dataset of a source; the built-in world is built once and then read from its cache."""
    if isinstance(source, ProceduralConfig):
        return cached(ProceduralDataset(source), progress=progress)
    return OpenLaneV2Dataset(source) if isinstance(source, OpenLaneV2Config) else Argoverse2Dataset(source)


def _augmented(config: PhotometricConfig, example: Example, key: tuple[int, int, int]) -> Example:
    return augment_example(example, config, key)


def limit_instances(task: LaneGraphTask, count: int) -> LaneGraphTask:
    """Return the task with at most `count` instances of traffic flow, the heaviest; 0 is inference without.

    The parameters stay the same. Raises UserError where the model takes no traffic flow or has fewer slots.
    """
    traffic = task.traffic_flow
    if traffic is None:
        raise UserError("this run is a baseline without traffic flow: --max-instances has nothing to limit")
    if not 0 <= count <= traffic.prior.max_instances:
        raise UserError(f"--max-instances {count} is outside 0 to {traffic.prior.max_instances}, the model's slots")
    prior = replace(traffic.prior, top_instances=count)
    return replace(task, model=replace(task.model, traffic_flow=replace(traffic, prior=prior)))  # pyright: ignore


def predict_examples(
    task: Any, params: Params, dataset: Dataset, indices: Sequence[int]
) -> tuple[Example, LanePrediction, ElementPrediction | None]:
    """Return some examples whole, with truth and all, and what is predicted for them; all stacked, numpy.

    A task of clips goes through each example's scene up to it.
    """
    examples = stack_examples([dataset.example(index) for index in indices])
    if task.clip == 1:
        ((_, answer),) = predictions(task, params, examples, len(indices))
    else:
        every = [_streamed(task, params, dataset, index) for index in indices]
        answer = jax.tree.map(lambda *leaves: np.concatenate(leaves), *every)
    return examples, answer.lanes, answer.elements


def _streamed(task: Any, params: Params, dataset: Dataset, index: int) -> Any:
    """Return the answer for an example, as a stack of one, from the stream that its scene is."""
    frames = [dataset.example(index)]
    while frames[0].has_previous:
        frames.insert(0, dataset.example(index - len(frames)))
    *_, (_, answer) = predictions(task, params, stack_examples(frames), 1)
    return answer


def titles(dataset: Dataset, indices: Sequence[int]) -> list[str]:
    """Return a title for the picture of each example."""
    infos = [dataset.info(index) for index in indices]
    return [f"{info.scene} at {info.timestamp_ns / 1e9:.1f} s" for info in infos]


def clips(data: Example | Streamed, length: int) -> Example:
    """Return the examples of a split as clips of `length` successive frames, another axis behind the first.

    Raises UserError where the clips would not lie within scenes, or the data are read while they are used.
    """
    if isinstance(data, Streamed):
        raise UserError("clips are made of data in memory, and these are too many for it: train with fewer scenes")
    frames = len(data.has_previous)
    begins = ~np.asarray(data.has_previous)
    inner = np.arange(frames) % length > 0
    if frames % length or (begins & inner).any():
        raise UserError(
            f"scenes do not split into clips of {length} frames: set data.world.keyframes to a multiple of task.clip"
        )
    return jax.tree.map(lambda leaf: leaf.reshape(frames // length, length, *leaf.shape[1:]), data)


def _source(config: RunConfig, split) -> LaneGraphSource:
    return config.data.source(split)  # pyright: ignore[reportReturnType]

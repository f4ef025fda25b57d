"""Lane lines in one image: the systems of the GTN paper, measured by TuSimple's metric."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tflane_jax.config import LaneShapeSource, RunConfig
from tflane_jax.datasets.augmentation import augment
from tflane_jax.datasets.front_views import FrontViewConfig, FrontViewDataset
from tflane_jax.datasets.front_views import load_road_images as load_front_views
from tflane_jax.datasets.tusimple import TuSimpleDataset, row_lanes
from tflane_jax.datasets.tusimple import load_road_images as load_tusimple
from tflane_jax.evaluation.evaluate import predict_batch, predictions
from tflane_jax.files.images import HEIGHT as INPUT_HEIGHT
from tflane_jax.files.images import WIDTH as INPUT_WIDTH
from tflane_jax.losses.lane_shape import lane_shape_loss, lane_shape_targets
from tflane_jax.metrics import image_lanes
from tflane_jax.metrics.tusimple import RowLanes, TuSimpleMetrics
from tflane_jax.scene import LaneLines, LaneShapePrediction, RoadImage, shapes_of, stack_examples
from tflane_jax.tasks.base import Evaluation, Model, spread
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.batches import Prepare
from tflane_jax.training.loop import Draw
from tflane_jax.training.records import Record
from tflane_jax.training.task import Params
from tflane_jax.world.front_view.lines import CAPACITY, ROWS

# The metric's image: rows and columns of TuSimple.
HEIGHT, WIDTH = 720, 1280
_COMPARED_EXAMPLES = 6
_TIMED_FRAMES = 30

# Table 1 of the GTN paper, on the 2,782 test images of TuSimple; percent, as our own rows.
_TABLE_1 = (
    ("SCNN", 7, 96.53, 6.17, 1.80),
    ("PINet", 30, 96.70, 2.94, 2.63),
    ("FastDraw", 90, 95.20, 7.60, 4.50),
    ("GTN paper", 420, 96.21, 2.93, 4.02),
)


@dataclass(frozen=True)
class LabelledImages:
    """A split in memory.

    Attributes:
        images: stacked.
        truth: the labels of each, as the metric wants them.
    """

    images: RoadImage
    truth: tuple[RowLanes, ...]


class LaneShapeSystem:
    """See `tasks.base.System`."""

    columns: tuple[str, ...] = ("seed", "Accuracy", "FP", "FN", "loss", "frames")
    compared: tuple[str, ...] = ("all/Accuracy", "all/FP", "all/FN")
    errors: tuple[str, ...] = ("all/FP", "all/FN")

    def load(self, source: LaneShapeSource, *, progress: bool = True) -> LabelledImages:
        """Return the images of a source, stacked, with their labels."""
        if isinstance(source, FrontViewConfig):
            images = load_front_views(source, progress=progress)
            lines = (jax.tree.map(lambda leaf, i=i: leaf[i], images.lines) for i in range(len(images.image)))
            return LabelledImages(images, tuple(row_lanes(each, HEIGHT, WIDTH) for each in lines))
        dataset = TuSimpleDataset(source)
        images = load_tusimple(dataset, progress=progress)
        return LabelledImages(images, tuple(dataset.truth(index) for index in range(len(dataset))))

    def examples(self, config: RunConfig, data: LabelledImages) -> RoadImage:
        """Return the images with their lines."""
        return data.images

    def shapes(self, config: RunConfig) -> RoadImage:
        """Return shapes of images at the network's resolution."""
        lines = LaneLines.empty(CAPACITY, len(ROWS))
        size = (INPUT_HEIGHT, INPUT_WIDTH)
        return shapes_of(RoadImage(np.zeros((*size, 3), np.uint8), np.zeros(size, bool), lines))

    def check(self, config: RunConfig, data: LabelledImages) -> None:
        """Raise nothing: the model takes all images."""

    def prepare(self, config: RunConfig) -> Prepare | None:
        """Return the augmentation of the configuration's data."""
        augmentation = getattr(config.data, "augmentation", None)
        if augmentation is None:
            return None

        def prepare(example: RoadImage, key: tuple[int, int, int]) -> RoadImage:
            return augment(example, augmentation, key)

        return prepare

    def evaluate(self, task: Any, params: Params, data: LabelledImages, batch_size: int) -> Evaluation:
        """Return TuSimple's metrics, and the loss of the last decoder layer as validation loss."""
        metrics, losses = TuSimpleMetrics(), []
        for indices, answer in predictions(task, params, data.images, batch_size):
            lines = jax.tree.map(lambda leaf, i=indices: leaf[i.start : i.stop], data.images.lines)
            losses += [float(_loss(task, answer, lines))] * len(indices)
            for row, index in enumerate(indices):
                truth, found = data.truth[index], jax.tree.map(lambda leaf, i=row: leaf[i], answer)
                metrics.update(found_lanes(found, truth), truth)
        return Evaluation(metrics.protocol, {"all": metrics.compute() | {"loss": float(np.mean(losses))}})

    def score_names(self, config: RunConfig) -> set[str]:
        """Return TuSimple's metrics and the loss."""
        return {f"all/{name}" for name in ("Accuracy", "FP", "FN", "loss")}

    def drawing(self, config: RunConfig) -> Draw:
        """Return the function that draws lanes over a few validation images."""
        from tflane_jax.plots.images import save_road_images

        dataset = open_images(config.data.source("val"))  # pyright: ignore[reportArgumentType]
        indices = spread(len(dataset), config.evaluation.pictures)
        examples = stack_examples([dataset.example(index) for index in indices]) if indices else None

        def draw(folder: Path, step: int, params: Params, records: list[Record]) -> None:
            if examples is not None:
                answer = predict(config.task, params, examples)
                save_road_images(folder / "pictures" / f"step_{step:08d}.png", examples, {f"step {step}": answer})

        return draw

    def inference_variants(self, task: Any) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def remarks(self, model: Model) -> dict[str, str]:
        """Return how many images a second the model takes on this machine, one at a time."""
        return {"fps": f"{frames_per_second(model):.0f}", "source": "this run"}

    def quoted(self) -> list[dict[str, str]]:
        """Return Table 1 of the paper."""
        return [
            {
                "model": name,
                "all/Accuracy": f"{accuracy:.1f}",
                "all/FP": f"{fp:.1f}",
                "all/FN": f"{fn:.1f}",
                "fps": str(fps),
                "source": "quoted: GTN paper, TuSimple test, its GPU",
            }
            for name, fps, accuracy, fp, fn in _TABLE_1
        ]

    def draw_comparison(
        self, models: Mapping[str, Model], source: LaneShapeSource, data: LabelledImages, path: Path
    ) -> Path:
        """Draw a few test images, every model beside the truth."""
        from tflane_jax.plots.images import save_road_images

        images = data.images
        examples = jax.tree.map(lambda leaf: leaf[spread(len(images.image), _COMPARED_EXAMPLES)], images)
        answers = {name: predict(model.task, model.params, examples) for name, model in models.items()}
        return save_road_images(path, examples, answers)


def open_images(source: LaneShapeSource) -> FrontViewDataset | TuSimpleDataset:
    """Return the images of a source one by one."""
    return FrontViewDataset(source) if isinstance(source, FrontViewConfig) else TuSimpleDataset(source)


def found_lanes(prediction: LaneShapePrediction, truth: RowLanes) -> RowLanes:
    """Return the lanes of one prediction at the rows of the truth."""
    assert truth.rows is not None, "labels have rows"
    return image_lanes.row_lanes(prediction, truth.rows, height=HEIGHT, width=WIDTH)


def truth_of(dataset: FrontViewDataset | TuSimpleDataset, index: int) -> RowLanes:
    """Return the labels of one image as the metric wants them."""
    if isinstance(dataset, TuSimpleDataset):
        return dataset.truth(index)
    return row_lanes(dataset.example(index).lines, HEIGHT, WIDTH)


def name_of(dataset: FrontViewDataset | TuSimpleDataset, index: int) -> str:
    """Return the name of one image."""
    return dataset.raw_file(index) if isinstance(dataset, TuSimpleDataset) else dataset.info(index).scene


def predict(task: Any, params: Params, examples: RoadImage) -> LaneShapePrediction:
    """Return the predictions for stacked images, numpy."""
    ((_, answer),) = predictions(task, params, examples, len(examples.image))
    return answer


def frames_per_second(model: Model, height: int = INPUT_HEIGHT, width: int = INPUT_WIDTH) -> float:
    """Return how many images a second a model takes one at a time, from uint8 image to curves, compilation apart."""
    image = np.random.default_rng(0).integers(0, 256, (1, height, width, 3), np.uint8)
    lines = jax.tree.map(lambda leaf: leaf[None], LaneLines.empty(1, 1))
    batch = jax.device_put(RoadImage(image, np.ones((1, height, width), bool), lines))
    params, seconds = jax.device_put(model.params), []
    for _ in range(_TIMED_FRAMES):
        began = time.perf_counter()
        jax.block_until_ready(predict_batch(model.task, params, batch))
        seconds.append(time.perf_counter() - began)
    return 1.0 / float(np.median(seconds[1:]))


@partial(jax.jit, static_argnums=0)
def _loss(task: LaneShapeTask, answer: LaneShapePrediction, lines: Any) -> jax.Array:
    one_layer = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None], answer)
    targets = lane_shape_targets(lines, shared_horizon=task.losses.shared_horizon)
    return lane_shape_loss(one_layer, targets, task.losses)[0]

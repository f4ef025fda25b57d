"""The lane-shape task: lane lines in one image by the LSTR family (GTN paper), with TuSimple's metric."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tflane_jax.datasets import sources
from tflane_jax.datasets.augmentation import augment
from tflane_jax.datasets.base import spread
from tflane_jax.datasets.batches import chosen_examples, count
from tflane_jax.datasets.data_source import SplitData
from tflane_jax.datasets.front_views import FrontViewConfig
from tflane_jax.datasets.lane_rows import LabelledImages
from tflane_jax.datasets.photos import HEIGHT as INPUT_HEIGHT
from tflane_jax.datasets.photos import WIDTH as INPUT_WIDTH
from tflane_jax.datasets.streaming import Prepare, Streamed
from tflane_jax.datasets.tusimple import TuSimpleConfig, TuSimpleData
from tflane_jax.evaluation import lane_shapes
from tflane_jax.evaluation.by_scene import summed_ratio
from tflane_jax.evaluation.predict import (
    FOR_PICTURES,
    FOR_SCORES,
    PREDICTION,
    Predictor,
    predict_batch,
    predicted_batches,
    predictions,
)
from tflane_jax.evaluation.results import Evaluation, EvaluationConfig
from tflane_jax.files.tusimple import SIZE, RowLanes
from tflane_jax.layers.batch_norm import BATCH_AXIS, STATISTICS
from tflane_jax.limits import SettingError
from tflane_jax.losses.lane_shape import LaneShapeLossConfig, lane_shape_loss, lane_shape_targets
from tflane_jax.metrics.tusimple import TuSimpleMetrics
from tflane_jax.models.auxiliary import AUXILIARY, auxiliary_outputs
from tflane_jax.models.lstr import LstrConfig, normalise
from tflane_jax.models.lstr_init import lstr_init
from tflane_jax.models.parameters import Params, joined_statistics, split_statistics
from tflane_jax.scene import CurvePrediction, LaneLines, Prediction, RoadImage, shapes_of, stack_examples
from tflane_jax.tasks.base import Draw, Model, Recorded, Task
from tflane_jax.tasks.edge_types import save_edge_types
from tflane_jax.world.front_view.lines import CAPACITY, ROW_FRACTIONS

_COMPARED_EXAMPLES = 6
_TIMED_FRAMES = 30

# Table 1 of the GTN paper, on TuSimple; it names neither the split nor the hardware. Name, frames/s, accuracy, FP and
# FN in percent.
GTN_TABLE_1 = (
    ("SCNN", 7, 96.53, 6.17, 1.80),
    ("PINet", 30, 96.70, 2.94, 2.63),
    ("FastDraw", 90, 95.20, 7.60, 4.50),
    ("GTN paper", 420, 96.21, 2.93, 4.02),
)

ImageSource = FrontViewConfig | TuSimpleConfig


@dataclass(frozen=True)
class LaneShapeTask(Task[RoadImage, LabelledImages, ImageSource, None]):
    """A network of the LSTR family with its loss.

    Attributes:
        model: the network.
        losses: weights of matching costs and losses.
    """

    model: LstrConfig = LstrConfig()
    losses: LaneShapeLossConfig = LaneShapeLossConfig()

    columns: ClassVar[tuple[str, ...]] = ("lanes of", "seed", "Accuracy", "FP", "FN", "loss", "frames")
    compared: ClassVar[tuple[str, ...]] = ("all/Accuracy", "all/FP", "all/FN")

    def init(self, key: jax.Array, example: RoadImage) -> Params:
        """Return initial parameters; only the shapes of `example` are used."""
        image = normalise(example.image, example.image_valid)
        params = joined_statistics(self.model.build().init(key, image, example.image_valid))
        return lstr_init(params, key) if self.model.init == "lstr" else params

    def loss(self, params: Params, batch: RoadImage, key: jax.Array) -> tuple[Float[Array, ""], Recorded]:
        """Return the loss of a batch (leading axis on every leaf) and its terms; norms use batch statistics.

        Raises ValueError for anything but a batch.
        """
        if len(shape := np.shape(batch.image)) != 4:
            raise ValueError(f"expected a batch (image of shape (batch, h, w, 3)), but it is of shape {shape}")
        learned, statistics = split_statistics(params)
        module, keys = self.model.build(), jax.random.split(key, len(batch.image))

        def one(image, valid, key):
            variables = {"params": learned} | statistics
            curves, state = module.apply(
                variables, image, valid, train=True, mutable=[STATISTICS, AUXILIARY], rngs={"dropout": key}
            )
            return curves, auxiliary_outputs(state), state[STATISTICS]

        images = normalise(batch.image, batch.image_valid)
        train: Any = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, 0, None))
        curves, auxiliary, updated = train(images, batch.image_valid, keys)
        loss, report = self.losses.loss(Prediction(curves=curves), auxiliary, batch, self.model)
        return loss, report | {STATISTICS: updated}

    def predict(self, params: Params, example: RoadImage) -> Prediction:
        """Return the last decoder layer's prediction for one example; its lane lines are not read."""
        learned, statistics = split_statistics(params)
        image = normalise(example.image, example.image_valid)
        layers = self.model.build().apply({"params": learned} | statistics, image, example.image_valid)
        return Prediction(curves=jax.tree.map(lambda leaf: leaf[-1], layers))

    def start(self) -> None:
        """Return None: images have no memory."""

    def load(self, source: ImageSource, *, progress: bool = True) -> LabelledImages:
        """Return the images of a source, in memory or streamed, with their labels."""
        return sources.load(source, progress=progress)

    def training_form(self, source: ImageSource, data: SplitData) -> ImageSource:
        """Return a split with full frames of TuSimple where they are augmented: one warp crops and resizes them.

        Images of other cameras are resized to TuSimple's size before.
        """
        if isinstance(source, TuSimpleConfig) and _cropped(data):
            return replace(source, height=SIZE[0], width=SIZE[1])
        return source

    def examples(self, data: LabelledImages) -> RoadImage | Streamed:
        """Return the images with their lane lines."""
        return data.images

    def shapes(self, data: SplitData) -> RoadImage:
        """Return shapes of images at the network's resolution."""
        lines = LaneLines.empty(CAPACITY, len(ROW_FRACTIONS))
        size = (INPUT_HEIGHT, INPUT_WIDTH)
        return shapes_of(RoadImage(np.zeros((*size, 3), np.uint8), np.zeros(size, bool), lines))

    def check_settings(self, data: SplitData) -> None:
        """Raise UserError if images do not shrink by whole blocks."""
        side = self.model.shrink
        if INPUT_HEIGHT % side or INPUT_WIDTH % side:
            whole = f"a divisor of {INPUT_HEIGHT} and {INPUT_WIDTH}, the height and width of images"
            raise SettingError("task.model.shrink", side, whole)

    def prepare(self, data: SplitData) -> Prepare | None:
        """Return the augmentation of the data, None for none."""
        augmentation = getattr(data, "augmentation", None)
        if augmentation is None:
            return None
        size = (INPUT_HEIGHT, INPUT_WIDTH) if _cropped(data) else None

        def prepare(example: RoadImage, key: tuple[int, int, int]) -> RoadImage:
            return augment(example, augmentation, key, size)

        return prepare

    def evaluate(
        self, params: Params, data: LabelledImages, config: EvaluationConfig, frame_groups: Sequence[str] = ()
    ) -> Evaluation:
        """Return TuSimple's metrics, and the loss of the last decoder layer, its mean over images."""
        metrics, losses = TuSimpleMetrics(), []
        of_group = {group: TuSimpleMetrics() for group in sorted(set(frame_groups))}
        predicted = predicted_batches(
            self, params, data.images, config.batch_size, lambda b: b.replace(image=None), what=FOR_SCORES
        )
        for indices, batch, answer in predicted:
            lines = jax.tree.map(lambda leaf, i=indices: leaf[: len(i)], batch.lines)
            losses += np.asarray(_losses(self, answer.curves, lines)).tolist()
            for row, index in enumerate(indices):
                truth, found = data.truth[index], jax.tree.map(lambda leaf, i=row: leaf[i], answer.curves)
                lanes = found_lanes(found, truth)
                metrics.update(lanes, truth)
                if of_group:
                    of_group[frame_groups[index]].update(lanes, truth)
        # An image is a scene: in the built-in world each shows another road, of TuSimple's clips one image is labelled.
        ratios = {f"all/{name}": summed_ratio(parts, np.arange(len(parts))) for name, parts in metrics.means().items()}
        groups = {"all": metrics.compute() | {"loss": float(np.mean(losses))}}
        groups |= {group: part.compute() for group, part in of_group.items()}
        return Evaluation(metrics.protocol, groups, ratios=ratios)

    def score_names(self, data: SplitData, config: EvaluationConfig) -> set[str]:
        """Return TuSimple's metrics and the loss."""
        return {f"all/{name}" for name in ("Accuracy", "FP", "FN", "loss")}

    def drawing(self, data: SplitData, config: EvaluationConfig) -> Draw:
        """Return the function that draws lanes over a few validation images."""
        from tflane_jax.plots.images import save_road_images

        dataset = sources.open_dataset(data.source("val"))
        indices = spread(len(dataset), config.pictures)
        examples = stack_examples([dataset.example(index) for index in indices]) if indices else None

        def draw(folder: Path, step: int, params: Params) -> None:
            if examples is not None:
                answer = predict_curves(self, params, examples, at_once=config.batch_size, what=FOR_PICTURES)
                save_road_images(folder / "pictures" / f"step_{step:08d}.png", examples, {f"step {step}": answer})

        return draw

    def draw_comparison(
        self, models: Mapping[str, Model], source: ImageSource, data: LabelledImages, path: Path
    ) -> Path:
        """Draw a few test images, every model beside the ground truth, and the edge types of graph encoders."""
        from tflane_jax.plots.images import save_road_images

        examples = chosen_examples(data.images, spread(count(data.images), _COMPARED_EXAMPLES))
        save_edge_types(models, examples, path.with_name("edge_types"))
        answers = {
            name: predict_curves(model.task, model.params, examples, at_once=model.batch_size, what=FOR_PICTURES)
            for name, model in models.items()
        }
        return save_road_images(path, examples, answers)

    def remarks(self, params: Params) -> dict[str, str]:
        """Return the images per second of the model on this machine, at batch size 1."""
        return {"fps": f"{frames_per_second(self, params):.0f}", "source": "this run"}

    def quoted(self) -> list[dict[str, str]]:
        """Return Table 1 of the paper."""
        return [
            {
                "model": name,
                "all/Accuracy": f"{accuracy:.1f}",
                "all/FP": f"{fp:.1f}",
                "all/FN": f"{fn:.1f}",
                "fps": str(fps),
                "source": "quoted: GTN paper, TuSimple, hardware not given",
            }
            for name, fps, accuracy, fp, fn in GTN_TABLE_1
        ]


def _cropped(data: SplitData) -> bool:
    """Return whether augmentation takes full frames, larger than the network's input."""
    return isinstance(data, TuSimpleData) and data.augmentation is not None


def found_lanes(prediction: CurvePrediction, truth: RowLanes, threshold: float | None = None) -> RowLanes:
    """Return the lanes of one prediction at the rows of the truth; `threshold` as of `lane_shapes.detected`."""
    assert truth.rows is not None, "labels have rows"
    height, width = truth.size
    return lane_shapes.detections_of_curves(prediction, truth.rows, height=height, width=width, threshold=threshold)


def predict_curves(
    task: Predictor, params: Params, examples: RoadImage, *, at_once: int | None = None, what: str = PREDICTION
) -> CurvePrediction:
    """Return the curves predicted for stacked images, as numpy arrays; raise ValueError for a task without them.

    Args:
        task, params: the model.
        examples: B of them, stacked.
        at_once: images of one call of the model, which needs memory for the activations of all; None: B. With the
            batch size of an evaluation, its compiled program is used.
        what: see `evaluation.predict.predictions`.
    """
    at_once = at_once or len(examples.image)
    every = [answer for _, answer in predictions(task, params, examples, at_once, what=what)]
    answer = jax.tree.map(lambda *leaves: np.concatenate(leaves), *every)
    if answer.curves is None:
        raise ValueError("this task predicts no lane shapes")
    return answer.curves


def frames_per_second(task: Predictor, params: Params) -> float:
    """Return the images per second at batch size 1, from uint8 image to curves, without compilation (median)."""
    size = (1, INPUT_HEIGHT, INPUT_WIDTH)
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    lines = jax.tree.map(lambda leaf: leaf[None], LaneLines.empty(1, 1))
    batch = jax.device_put(RoadImage(image, np.ones(size, bool), lines))
    params, seconds = jax.device_put(params), []
    for _ in range(_TIMED_FRAMES):
        began = time.perf_counter()
        jax.block_until_ready(predict_batch(task, params, batch))
        seconds.append(time.perf_counter() - began)
    return 1.0 / float(np.median(seconds[1:]))


@partial(jax.jit, static_argnums=0)
def _losses(task: LaneShapeTask, answer: CurvePrediction, lines: Any) -> Float[Array, " b"]:
    """Return the loss of each image on its own: the loss of a batch weights its lanes by those of the other images."""
    one_layer = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None, None], answer)
    targets = lane_shape_targets(lines, shared_horizon=task.losses.shared_horizon)
    alone = jax.tree.map(lambda leaf: leaf[:, None], targets)
    return jax.vmap(lambda curves, lanes: lane_shape_loss(curves, lanes, task.losses)[0])(one_layer, alone)

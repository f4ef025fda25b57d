"""The lane-graph task: lanes and traffic elements around the vehicle, with loss, data, metrics and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.datasets import sources
from tflane_jax.datasets.base import spread
from tflane_jax.datasets.batches import first_example
from tflane_jax.datasets.clips import as_clips
from tflane_jax.datasets.data_source import LaneGraphSource, SplitData
from tflane_jax.datasets.empty_frames import without_empty
from tflane_jax.datasets.loading import TRAINING_PARTS, keep
from tflane_jax.datasets.photometric import PhotometricConfig, augment_example
from tflane_jax.datasets.streaming import Prepare, Streamed
from tflane_jax.evaluation.interventions import traffic_interventions, with_traffic
from tflane_jax.evaluation.lane_graph import evaluate_lanes
from tflane_jax.evaluation.results import Evaluation, EvaluationConfig
from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.batch_norm import BATCH_AXIS, STATISTICS
from tflane_jax.layers.camera_queries import LOST
from tflane_jax.limits import Count, SettingError
from tflane_jax.losses.common import HostLossConfig, checked_loss
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.auxiliary import AUXILIARY, auxiliary_outputs
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.host import HostConfig, HostMemory
from tflane_jax.models.parameters import Params, joined_statistics, split_statistics
from tflane_jax.models.priors import ByPrior, observe, observe_clip
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import Example, Prediction, shapes_of, stack_examples
from tflane_jax.tasks import score_names
from tflane_jax.tasks.base import Draw, Model, Recorded, Task
from tflane_jax.tasks.fit import (
    check_augmentation,
    check_fit,
    check_raster,
    check_settings_fit,
    frozen_modules,
    reads_traffic,
    warn_of_lanes_beyond,
)
from tflane_jax.tasks.lane_pictures import draw_differences, draw_examples, draw_hidden_lanes

T = TypeVar("T")


@dataclass(frozen=True)
class LaneGraphTask(Task[Example, Example | Streamed, LaneGraphSource, HostMemory | None]):
    """A host with its loss.

    Attributes:
        model: the host, with or without priors.
        losses: weights of the host's matching costs and losses.
        clip: number of successive frames that training processes with memory. A training example is then a clip, with a
            leading axis on every leaf, and evaluation streams through the scenes. 1: single frames.
        time: how training passes through the frames of a clip. "unrolled": the program holds every frame, and
            compiling takes as much longer; "scan": it holds one. Losses are equal up to rounding. A host that carries
            no BEV features from frame to frame takes all frames at once, or with "scan" one after the other, which
            needs less memory; dropout and the batch statistics of norms differ between the two.
        empty_frames: "skip" trains without frames that have none of the lanes or crossings of the host's ground truth
            (`HostConfig.wanted_truth`), as TopoNet and LaneSegNet do.
    """

    model: HostConfig = TopoNetConfig()
    losses: HostLossConfig = TopoNetLossConfig()
    clip: Count = 1
    time: Literal["unrolled", "scan"] = "unrolled"
    empty_frames: Literal["keep", "skip"] = "keep"

    columns: ClassVar[tuple[str, ...]] = score_names.COLUMNS
    compared: ClassVar[tuple[str, ...]] = score_names.COMPARED
    shown: ClassVar[Sequence[str]] = score_names.SHOWN
    notices: ClassVar[Mapping[str, str]] = {
        f"{LOST}/camera_cells": "BEV cells that a camera sees do without it, because it sees more than `capacity` of "
        "BevFormerConfig: raise that, or leave it None"
    }

    # -----------------------------------------------------------------------------------------------------------------
    # Learning

    @property
    def frames(self) -> int:
        """Number of frames of a clip."""
        return self.clip

    @property
    def loops(self) -> bool:
        """Whether the frames of a clip pass through the model in a loop."""
        return self.clip > 1 and self.time == "scan"

    @property
    def unrolled(self) -> LaneGraphTask:
        """The same task with a program that holds every frame of a clip."""
        return replace(self, time="unrolled")

    @property
    def frozen(self) -> tuple[str, ...]:
        """Frozen stages of the image encoder's backbone."""
        return frozen_modules(self.model)

    def init(self, key: jax.Array, example: Example) -> Params:
        """Return initial parameters; only the shapes of `example`, or of a clip, are used."""
        if self.clip > 1:
            example = jax.tree.map(lambda leaf: leaf[0], example)
        return joined_statistics(self.model.build().init(key, example))

    def loss(self, params: Params, batch: Example, key: jax.Array) -> tuple[Float[Array, ""], Recorded]:
        """Return the loss of a batch (leading axis on every leaf) and its terms; `key` is for dropout.

        Raises ValueError for anything but a batch.
        """
        wanted = ("batch", 4, 4) if self.clip == 1 else ("batch", self.clip, 4, 4)
        if len(shape := np.shape(batch.previous_from_ego)) != len(wanted):
            sizes = ", ".join(map(str, wanted))
            raise ValueError(f"expected a batch (previous_from_ego of shape ({sizes})), but it is of shape {shape}")
        learned, statistics = split_statistics(params)
        module, start = self.model.build(), self.start()
        observations = jax.vmap(self._observations)(batch)

        def run_frame(bev, statistics, example, observations, key):
            """Return the BEV memory, the new statistics, and outputs, auxiliary outputs and counts of one frame."""
            variables, streams = {"params": learned} | statistics, {"dropout": key}
            kept, method = [STATISTICS, AUXILIARY, LOST], type(module).answer
            (outputs, bev), state = module.apply(
                variables, example, bev, observations, train=True, method=method, mutable=kept, rngs=streams
            )
            updated = {name: value for name, value in state.items() if name == STATISTICS}
            return bev, updated, (outputs, auxiliary_outputs(state), _lost(state))

        def train_frame(example, observations, key):
            _, updated, found = run_frame(None, statistics, example, observations, key)
            return found, updated

        def train_clip(examples, observations, key):
            def body(carry, now):
                bev, updated, found = run_frame(*carry, *now)
                return (bev, updated), found

            frames = examples, observations, jax.random.split(key, self.clip)
            unroll = self.clip if self.time == "unrolled" else 1
            (_, updated), found = lax.scan(body, (start.bev, statistics), frames, unroll=unroll)
            return found, updated

        # Frames of a clip run one after the other if they share BEV features, or if the program is to hold one of them.
        through_clips = self.clip > 1 and (self.time == "scan" or start.bev is not None)
        if self.clip > 1 and not through_clips:
            # Without BEV memory, only the priors connect frames, and they have been observed already.
            batch, observations = _clips_as_frames((batch, observations))
        keys = jax.random.split(key, len(jax.tree.leaves(batch)[0]))
        train: Any = jax.vmap(train_clip if through_clips else train_frame, axis_name=BATCH_AXIS, out_axes=(0, None))
        (outputs, auxiliary, lost), updated = train(batch, observations, keys)
        if through_clips:
            outputs, auxiliary, batch = _clips_as_frames((outputs, auxiliary, batch))
        loss, report = checked_loss(self.losses, self.losses.loss(outputs, auxiliary, batch, self.model))
        return loss, report | {name: count.mean() for name, count in lost.items()} | updated

    def _observations(self, example: Example) -> ByPrior:
        """Return the priors' observations of a frame, or of each frame of a clip; they depend on no parameters."""
        priors = self.model.build_priors()
        return observe(priors, example, {})[0] if self.clip == 1 else observe_clip(priors, example)

    # -----------------------------------------------------------------------------------------------------------------
    # Predicting

    @property
    def streams(self) -> bool:
        """Models trained on clips are evaluated on streams."""
        return self.clip > 1

    def predict(self, params: Params, example: Example) -> Prediction:
        """Return the last decoder layer's prediction for one example, without memory of earlier frames."""
        return self.step(params, None, example)[1]

    def start(self) -> HostMemory:
        """Return the memory before the first frame of a sequence."""
        return self.model.start()

    def step(self, params: Params, memory: HostMemory | None, example: Example) -> tuple[HostMemory, Prediction]:
        """Return the memory for the next frame, and the prediction for this one.

        For live streams: `memory, prediction = step(params, memory, example)`, from `start()` on. For examples with a
        leading axis: `lax.scan(partial(task.step, params), task.start(), examples)`, with equal results. Without a
        memory (None), a frame stands alone: priors remember nothing of it, nor of the frames after it.
        """
        # The barrier keeps XLA from hoisting parameter-only terms out of a scan, which would change their rounding.
        params, example = lax.optimization_barrier((params, example))
        learned, statistics = split_statistics(params)
        module = self.model.build()
        variables = {"params": learned} | statistics
        result: Any = module.apply(variables, example, memory, method=type(module).step)
        outputs, following = result
        return following, jax.tree.map(lambda layers: layers[-1], outputs)

    # -----------------------------------------------------------------------------------------------------------------
    # Data

    def load(self, source: LaneGraphSource, *, progress: bool = True) -> Example | Streamed:
        """Return the examples of a source, see `datasets.sources.load`."""
        return sources.load(source, progress=progress, parts=self.parts)

    @property
    def parts(self) -> tuple[str, ...]:
        """Fields of `Example` that training and evaluation read."""
        further = {name for prior in self.model.build_priors().values() for name in prior.reads}.union(self.model.truth)
        return (*TRAINING_PARTS, *sorted(further - set(TRAINING_PARTS)))

    def examples(self, data: Example | Streamed) -> Example | Streamed:
        """Return the examples themselves, or the clips that they form."""
        data = data if self.clip == 1 else as_clips(data, self.clip)
        if self.empty_frames == "keep":
            return data
        return without_empty(data, self.model.wanted_truth, self.model.line_classes)

    def shapes(self, data: SplitData) -> Example:
        """Return shapes of the training parts of an example."""
        return shapes_of(keep(sources.sample(data.source("train")), self.parts))

    def check(self, data: SplitData, train: Example | Streamed) -> None:
        """Raise UserError where data and model do not fit together, see `tasks.fit`."""
        self.check_settings(data)
        source, example = data.source("train"), first_example(train)
        if not sources.is_shipped(sources.source_of(source)):
            check_raster(source, example)
            warn_of_lanes_beyond(source, example if isinstance(train, Streamed) else train)
        check_fit(self.model, example)

    def check_evaluation(self, data: Example | Streamed, config: EvaluationConfig) -> None:
        """Raise UserError if the examples cannot give the traffic flow that an evaluation asks for."""
        with_traffic(data, config.traffic)

    def check_settings(self, data: SplitData) -> None:
        """Raise UserError where settings of data and model do not fit together, see `tasks.fit`."""
        source, world = data.source("train"), getattr(data, "world", None)
        images = source.example.cameras or getattr(source, "image", None)
        check_settings_fit(self.model, source.example, image_scale=None if images is None else images.scale)
        check_augmentation(self.model, getattr(data, "augmentation", None))
        if self.time == "scan" and not self.loops:
            raise SettingError("task.time", self.time, "'unrolled', without clips (task.clip above 1)")
        if world is not None and world.keyframes % self.clip:
            raise SettingError("data.world.keyframes", world.keyframes, f"a multiple of task.clip ({self.clip})")

    def prepare(self, data: SplitData) -> Prepare | None:
        """Return the photometric augmentation of the data, or None."""
        augmentation = getattr(data, "augmentation", None)
        return None if augmentation is None else partial(_augmented, augmentation)

    # -----------------------------------------------------------------------------------------------------------------
    # Numbers and pictures

    def evaluate(
        self, params: Params, data: Example | Streamed, config: EvaluationConfig, frame_groups: Sequence[str] = ()
    ) -> Evaluation:
        """Return the metrics of all parts that the host predicts and the examples label."""
        metrics = evaluate_lanes(self, params, data, config, ground=self._ground, frame_groups=frame_groups)
        return Evaluation(metrics.protocol, metrics.compute(), ratios=metrics.ratios(), samples=metrics.samples)

    @property
    def _ground(self) -> PerceptionRange | None:
        """The range of the BEV evidence that the model sees; None for a model with cameras."""
        encoder = self.model.encoder
        return encoder.range if isinstance(encoder, EvidenceEncoderConfig) else None

    def score_names(self, data: SplitData, config: EvaluationConfig) -> set[str]:
        """Return the names of the host's metrics by group, with those of traffic elements if it predicts them."""
        example = data.source("val").example
        return score_names.score_names(self.model, example, config, grouped=self._ground is not None)

    def drawing(self, data: SplitData, config: EvaluationConfig) -> Draw:
        """Return the function that draws a few validation examples from above and in their camera images."""
        source = data.source("val")
        dataset = sources.open_dataset(source)
        indices = spread(len(dataset), config.pictures)

        def draw(folder: Path, step: int, params: Params) -> None:
            if indices:
                model = Model(self, params, config.batch_size)
                draw_examples(model, source, dataset, indices, folder / "pictures", step)

        return draw

    def draw_comparison(
        self, models: Mapping[str, Model], source: LaneGraphSource, data: Example | Streamed, path: Path
    ) -> Path:
        """Draw the test frames in which the first two models differ most, see `lane_pictures.draw_differences`.

        Their lanes are those that a prior from traffic should help with if any model has it, else occluded lanes. A
        single model is drawn on the frames with the most occluded lanes.
        """
        if len(models) < 2:
            return draw_hidden_lanes(models, source, data, path)
        tasks = [model.task for model in models.values() if isinstance(model.task, LaneGraphTask)]
        traffic = any(task.model.priors.traffic_flow is not None for task in tasks)
        known = traffic and self._ground is not None
        return draw_differences(models, source, data, path, "hidden+traffic" if known else "occluded")

    # -----------------------------------------------------------------------------------------------------------------
    # Comparing

    def interventions(self, data: Example | Streamed, config: EvaluationConfig) -> dict[str, EvaluationConfig]:
        """Return the evaluations of a model with traffic flow without it (TF-Lane, Table 7) and with that of others."""
        return traffic_interventions(data, config) if reads_traffic(self.model) else {}


def _augmented(config: PhotometricConfig, example: Example, key: tuple[int, int, int]) -> Example:
    if np.ndim(example.has_previous) == 0:
        return augment_example(example, config, key)
    frames = [jax.tree.map(lambda leaf, i=i: leaf[i], example) for i in range(len(example.has_previous))]
    return stack_examples([augment_example(frame, config, (*key, i)) for i, frame in enumerate(frames)])


def _lost(state: Any) -> dict[str, Float[Array, ""]]:
    """Return what the layers of a model left out, by name: the most of any layer."""
    counts: dict[str, Any] = {}
    flat: Any = flatten_dict(state.get(LOST, {}))
    for path, sown in flat.items():
        counts.setdefault(f"{LOST}/{path[-1]}", []).extend(sown)
    return {name: jnp.stack(of_layers).max().astype(jnp.float32) for name, of_layers in counts.items()}


def _clips_as_frames(clips: T) -> T:
    """Return a batch of clips as a batch of frames: merge the two leading axes."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), clips)

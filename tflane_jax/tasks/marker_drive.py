"""A drive with fiducial markers, frame by frame: images -> markers -> store -> confidence -> memory -> model.

Each step is a function of another file; this one only calls them in order, so that a live system can do the same.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.native_views import fitted_views
from tflane_jax.datasets.openlane_example import blank
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.geometry import relative_pose
from tflane_jax.markers.image_search import ImageMarkers
from tflane_jax.markers.observe import frame_before
from tflane_jax.markers.reader import MarkerReader, ReaderConfig, Reading
from tflane_jax.models.marker_fusion import MarkerFusionConfig, MarkerPrior, as_fused
from tflane_jax.models.parameters import Params
from tflane_jax.models.prior import HostSpec
from tflane_jax.priors.marker_memory import MarkerGuidance, MarkerMemory, MarkerMemoryConfig, reads_bank
from tflane_jax.priors.markers import marker_confidence, select_marker_lanes
from tflane_jax.scene import CameraViews, MarkerObservations, Prediction
from tflane_jax.tasks.fit import reads_traffic
from tflane_jax.tasks.lane_graph import LaneGraphTask

# Gate and memory that are shown without a model, and the paper's distance of frames, seconds.
SHOWN = MarkerFusionConfig(memory=MarkerMemoryConfig(lanes=32))
INTERVAL = 0.5
# A drive whose frames are more than this fraction nearer or farther apart than in training is warned of.
_OFF = 0.5


class MissingPriorWarning(UserWarning):
    """A model reads a prior that a drive does not have."""


class FrameRateWarning(UserWarning):
    """The frames of a drive are not as far apart as those that a model was trained on."""


@dataclass(frozen=True)
class DriveModel:
    """A trained model for a drive.

    Attributes:
        task, params: the model.
        source: configuration of a split that it was trained on.
    """

    task: LaneGraphTask
    params: Params
    source: Any

    @property
    def interval(self) -> float:
        """Seconds between the frames of training; the paper's if the data have no fixed rate."""
        return source_of(self.source).interval(self.source) or INTERVAL


class DriveStep(NamedTuple):
    """What one frame of a drive gives.

    Attributes:
        reading: detections, and the prior.
        confidence: (M,) of each marker of the prior as the model computes it, Eq. (2) by default; 0 where not valid.
        guidance: prior tokens after gate and memory, as they enter Eq. (3): the frame's lanes, or remembered ones.
        remembered: lanes of earlier frames are among them.
        prediction: of the model; None without one.
    """

    reading: Reading
    confidence: Float[np.ndarray, " m"]
    guidance: MarkerGuidance
    remembered: bool
    prediction: Prediction | None


class MarkerDrive:
    """The markers of a drive and a model's lanes, frame by frame.

    Memory counts frames: give them as far apart as in training (`interval`). A pause longer than the memory, T of those
    intervals, is the start of another drive. As in evaluation, a model that was trained on single frames has no memory,
    neither of markers nor of BEV features.

    Args:
        reader: of the store.
        model: with or without a marker prior; None shows the prior alone.

    `step` raises UserError for a model that cannot run on these images.
    """

    def __init__(self, reader: MarkerReader, model: DriveModel | None = None):
        self.model = model
        self.interval = INTERVAL if model is None else model.interval
        sizes = ExampleConfig(range=reader.config.range) if model is None else model.source.example
        self._sizes: ExampleConfig = sizes
        configured = None if model is None else model.task.model.priors.markers
        spec = HostSpec(1, sizes.range, sizes.range) if model is None else model.task.model.spec
        self._prior = MarkerPrior(configured or SHOWN, spec)
        self._model_remembers = model is not None and model.task.streams
        self._prior_remembers = configured is None or self._model_remembers
        self._observe = jax.jit(self._prior.observe)
        self._step = None if model is None else jax.jit(model.task.step)
        memory = self._prior.config.memory or MarkerMemoryConfig()
        self._longest_ns = 1e9 * memory.frames * self.interval
        self._last: tuple[int, Float[np.ndarray, "4 4"]] | None
        self.restart(reader)

    @property
    def remembers(self) -> bool:
        """Whether earlier frames count, so that the rate of frames does; always without a model."""
        return self.model is None or self._model_remembers

    @property
    def most_lanes(self) -> int:
        """How many lanes of a frame's markers the prior takes, those of the most trusted markers first."""
        return self._prior.config.prior.lanes

    def restart(self, reader: MarkerReader) -> None:
        """Begin another drive, with its own store, without compiling the model again."""
        self.reader, self._last = reader, None
        self._bank = self._prior.start() if self._prior_remembers else None
        self._memory = self.model.task.start() if self.model is not None and self._model_remembers else None

    def step(
        self,
        views: CameraViews,
        timestamp_ns: int,
        global_from_ego: Float[np.ndarray, "4 4"],
        found: Sequence[ImageMarkers] | None = None,
    ) -> DriveStep:
        """Return the markers and lanes of the next frame; arguments as of `MarkerReader.read`."""
        continues = self._last is not None and timestamp_ns - self._last[0] <= self._longest_ns
        if not continues:
            self.reader.forget()
        reading = self.reader.read(views, timestamp_ns, global_from_ego, found)
        markers = reading.observed.markers
        before = self._last[1] if self._last is not None and continues else global_from_ego
        example = replace(
            blank(self._sizes, governed="lanes", views=None, traffic=True),
            markers=markers,
            previous_from_ego=relative_pose(before, global_from_ego).astype(np.float32),
            has_previous=np.asarray(continues),
        )
        self._last = timestamp_ns, np.asarray(global_from_ego, np.float64)
        guidance, self._bank = self._observe(example, self._bank)
        guidance = jax.device_get(as_fused(guidance, self._prior.config))
        prediction = None
        if self.model is not None and self._step is not None:
            example = replace(example, cameras=fitted_views(views, self.model.source))
            following, prediction = self._step(self.model.params, self._memory, example)
            self._memory = following if self._model_remembers else None
            prediction = jax.device_get(prediction)
        confidence = np.asarray(marker_confidence(markers, self._prior.config.prior))
        remembered = bool(guidance.valid.any()) and _reads_memory(markers, self._bank, self._prior.config)
        return DriveStep(reading, confidence, guidance, remembered, prediction)


def _reads_memory(markers: MarkerObservations, bank: MarkerMemory | None, config: MarkerFusionConfig) -> bool:
    """Return whether a frame uses lanes of earlier frames; `bank` is the memory for the next frame."""
    if bank is None or config.memory is None or not np.asarray(bank.valid)[1:].any():
        return False
    return bool(reads_bank(select_marker_lanes(markers, config.prior), config.memory))


def as_trained(config: ReaderConfig, model: DriveModel | None) -> ReaderConfig:
    """Return the configuration with the capacities and the residual that a model was trained with."""
    markers = None if model is None else model.source.example.markers
    if markers is None:
        return config
    sizes = {name: getattr(markers, name) for name in ("markers", "lanes", "points")}
    residual = {name: getattr(markers.simulation, name) for name in ("residual_interval", "first_residual")}
    return replace(config, **sizes, **residual)


def check_rate(times_ns: Sequence[int], interval: float | None, residual_interval: float | None) -> None:
    """Warn (`FrameRateWarning`) of a drive at a rate at which memory or residual do not mean what they should.

    Args:
        times_ns: of the frames.
        interval: seconds between frames in training, for a model that remembers; the drive's may differ by 50 %. The
            median counts: a missing frame or a pause does not. None: rates do not matter to the model.
        residual_interval: see `ReaderConfig`; most frames need another one about as long before them.
    """
    if len(times_ns) < 2:
        return
    times = np.asarray(times_ns, np.int64)
    found, told, dense = float(np.median(np.diff(times))) / 1e9, [], False
    if interval is not None and abs(found - interval) > _OFF * interval:
        dense = found < interval
        told.append(
            f"in training {interval:.3g} s: memory counts frames, so that it lasts {found / interval:.2g} times as "
            "long as it should"
        )
    if residual_interval is not None and found > residual_interval:
        alone = sum(frame_before(times[:i], times[i], residual_interval) is None for i in range(1, len(times)))
        if 2 * alone > len(times) - 1:
            told.append(
                f"{alone + 1} of {len(times)} frames have none about {residual_interval:.3g} s before them to compare "
                "boards with: their residual is 0, so that a board read at a wrong place is trusted like any other"
            )
    if told:
        remedy = f"take frames {interval:.3g} s apart (--interval)" if dense else "give frames that are less far apart"
        warnings.warn(f"frames are {found:.3g} s apart; {'; '.join(told)}; {remedy}", FrameRateWarning, stacklevel=2)


def check_model(task: Any) -> LaneGraphTask:
    """Return the task of a model for drives; raises UserError for one that predicts no lanes around the vehicle.

    Warns (`MissingPriorWarning`) of a model with another prior than markers, which finds it empty in every frame, and
    of one that reads no markers.
    """
    if not isinstance(task, LaneGraphTask):
        raise UserError("the model reads single photos: give --model a run of a host with cameras")
    found = {"an SD map": task.model.priors.sd_map is not None, "traffic flow": reads_traffic(task.model)}
    if absent := " and ".join(name for name, there in found.items() if there):
        warnings.warn(
            f"the model reads {absent}, and a drive has none: its lanes may be worse than in its evaluation",
            MissingPriorWarning,
            stacklevel=2,
        )
    if task.model.priors.markers is None:
        warnings.warn(
            "the model reads no markers: boards, memory and their lanes are shown, and its own lanes do not depend on "
            "them",
            MissingPriorWarning,
            stacklevel=2,
        )
    return task

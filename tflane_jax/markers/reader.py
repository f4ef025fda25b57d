"""One path from the images of a drive to the marker prior: detect, look up, compare with half a second ago.

Frames come in order of time. What the model adds, gate and memory, is in `priors`.
"""

from __future__ import annotations

import datetime
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, relative_pose
from tflane_jax.markers.detection import DetectedMarkers, detect, locate
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers
from tflane_jax.markers.observe import Observed, frame_before, observe
from tflane_jax.markers.store import MarkerStore
from tflane_jax.scene import CameraViews


@dataclass(frozen=True)
class ReaderConfig:
    """Settings of a reader.

    `tflane markers run` reads with today's date, and searches partly hidden boards by the ids of the store:
    `ReaderConfig(DetectorConfig(search="all", ids=tuple(store.markers)), today=datetime.date.today())`.

    Attributes:
        detector: how images are searched; the store's sizes replace its own.
        range: lanes are cut at this box, metres.
        markers, lanes, points: capacities of the prior, as in `MarkerConfig`.
        residual_interval, first_residual: of the residual, as in `MarkerSimulationConfig`; an interval of None compares
            with the frame before.
        today: entries of the store that are out of date on this day give no prior; None ignores dates.
        max_age_days: see `look_up`.
    """

    detector: DetectorConfig = DetectorConfig()
    range: PerceptionRange = PerceptionRange()
    markers: int = 2
    lanes: int = 48
    points: int = 11
    residual_interval: float | None = 0.5
    first_residual: float = 0.0
    today: datetime.date | None = None
    max_age_days: int | None = None


class Reading(NamedTuple):
    """What one frame gives: all detections, and the prior with what became of each detection."""

    detected: DetectedMarkers
    observed: Observed


class MarkerReader:
    """The markers of a drive, frame by frame."""

    def __init__(self, store: MarkerStore, config: ReaderConfig = ReaderConfig()):
        self.store, self.config = store, config
        self._past: deque[_Past] = deque()

    def read(
        self,
        views: CameraViews,
        timestamp_ns: int,
        global_from_ego: Float[np.ndarray, "4 4"],
        found: Sequence[ImageMarkers] | None = None,
    ) -> Reading:
        """Return the markers of the next frame.

        Args:
            views: calibrated images at native size.
            timestamp_ns: time of the frame; later than that of the frame before.
            global_from_ego: pose of the vehicle, metres. Only motion between frames matters.
            found: markers of each valid view, where the images have been searched before; None searches them.

        Raises UserError for a frame that is not later, and like `detect`.
        """
        config = self.config
        if self._past and timestamp_ns <= self._past[-1].timestamp_ns:
            raise UserError(
                f"frame at {timestamp_ns} ns follows one at {self._past[-1].timestamp_ns} ns: put frames in order"
            )
        sizes = self.store.sizes
        if found is None:
            detected = detect(views, config.detector, sizes)
        else:
            detected = locate(views, found, config.detector, sizes)
        before = self._earlier(timestamp_ns)
        observed = observe(
            detected,
            self.store,
            config.range,
            markers=config.markers,
            lanes=config.lanes,
            points=config.points,
            previous=None if before is None else before.detected,
            now_from_previous=None if before is None else relative_pose(global_from_ego, before.global_from_ego),
            first_residual=config.first_residual,
            today=config.today,
            max_age_days=config.max_age_days,
        )
        self._past.append(_Past(timestamp_ns, np.asarray(global_from_ego, np.float64), detected))
        # A frame later than 1.5 intervals ago may still be the earlier one of the next frame.
        reach = 0.0 if config.residual_interval is None else 1.5e9 * config.residual_interval
        while timestamp_ns - self._past[0].timestamp_ns > reach:
            self._past.popleft()
        return Reading(detected, observed)

    def forget(self) -> None:
        """Begin another drive: the residuals of the next frame compare with none before it."""
        self._past.clear()

    def _earlier(self, timestamp_ns: int) -> _Past | None:
        """Return the frame that the residual compares with, None without one."""
        interval = self.config.residual_interval
        if interval is None:
            return self._past[-1] if self._past else None
        number = frame_before([past.timestamp_ns for past in self._past], timestamp_ns, interval)
        return None if number is None else self._past[number]


class _Past(NamedTuple):
    timestamp_ns: int
    global_from_ego: Float[np.ndarray, "4 4"]
    detected: DetectedMarkers

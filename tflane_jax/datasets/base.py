"""What every dataset offers, the names of splits, and the sizes of an `Example`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np

from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.limits import Count, Positive, SettingError, counted
from tflane_jax.markers.pixels import PixelConfig
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.scene import Example, RoadImage
from tflane_jax.scene.logs import Log
from tflane_jax.world.bev.sensor import BevSensorConfig
from tflane_jax.world.cameras.ring import CameraRigConfig
from tflane_jax.world.roads.sd_map import SdMapConfig

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@dataclass(frozen=True)
class ExampleConfig:
    """Sizes and ranges of an `Example`.

    The default capacities suit Argoverse 2: the largest counts in two of its logs were 58 lane segments, 28
    centerlines, 11 areas and 39 road users near the vehicle. What does not fit is left out, farthest first, with a
    `TruncationWarning`.

    Attributes:
        range: region in which lanes, areas and elements are ground truth.
        sensor: bird's-eye-view evidence; None leaves it out.
        cameras: camera ring of the built-in world; None leaves it out. With cameras, the traffic elements are those
            visible in the first camera, with their boxes in its image, as in OpenLane-V2.
        markers: fiducial-marker prior with simulated detections (marker paper, section IV-A), or with those in native
            images: `MarkerConfig(pixels=PixelConfig())`, for which "pixels" is short. None leaves it out.
        lanes, lane_points: merged centerlines and points on each.
        segments, segment_points: lane segments and points on each.
        areas, area_points: crossings with road boundaries and points on each.
        crossings: points of a pedestrian crossing: "ring" takes them along its closed outline, "sides" half of them
            along each of its two long sides, see `areas.crossing_sides`. LaneSegNet learns and measures "sides".
        history: frames N of traffic flow before the key frame.
        history_hz: rate of these frames: at 2 Hz, 20 frames look back 10 s, and the latest is 0.5 s before the key
            frame, as in nuScenes and OpenLane-V2. It must divide the rate of the log's tracks. None takes every track
            frame: 2 s at the 10 Hz of the built-in world and of Argoverse 2.
        tracks: instances K of traffic flow.
        elements: traffic lights and signs.
        elements_of: what they govern: merged centerlines (`TrafficElements.lane`), as TopoNet learns, or lane segments
            (`TrafficElements.segment`), as LaneSegNet's map-element-bucket variant.
        bike_lanes: whether bicycle lanes are ground truth.
        sd_map: coarse map of the roads of the built-in world; None leaves it out.
        map_lines: lines of a vector map, the truth of MapTR and MapTRv2; None leaves them out.
    """

    range: PerceptionRange = PerceptionRange()
    sensor: BevSensorConfig | None = BevSensorConfig()
    cameras: CameraRigConfig | None = None
    markers: MarkerConfig | None = None
    lanes: Count = 48
    lane_points: Annotated[int, counted(2)] = 11
    segments: Count = 96
    segment_points: Annotated[int, counted(2)] = 10
    areas: Count = 32
    area_points: Annotated[int, counted(2)] = 20
    crossings: Literal["ring", "sides"] = "ring"
    history: Count = 20
    history_hz: Positive | None = None
    tracks: Count = 96
    elements: Count = 24
    elements_of: Literal["centerlines", "segments"] = "centerlines"
    bike_lanes: Literal["include", "exclude"] = "include"
    sd_map: SdMapConfig | None = None
    map_lines: MapLinesConfig | None = None

    def __post_init__(self) -> None:
        """Replace the short form "pixels" of `markers`."""
        if isinstance(self.markers, str):
            if self.markers != "pixels":
                raise SettingError("markers", self.markers, "a MarkerConfig, 'pixels' or None")
            object.__setattr__(self, "markers", MarkerConfig(pixels=PixelConfig()))

    @property
    def ground(self) -> PerceptionRange:
        """The ground area that the rasters of an example and its pictures cover."""
        return BevGrid().range if self.sensor is None else self.sensor.grid.range

    def history_stride(self, rate_hz: float) -> int:
        """Return every how many track frames of a log with this rate the history has one.

        Raises UserError if `history_hz` does not divide the rate up to 5 %, the jitter of real timestamps.
        """
        if self.history_hz is None:
            return 1
        ratio = rate_hz / self.history_hz if self.history_hz > 0.0 else 0.0
        stride = round(ratio)
        if stride < 1 or abs(ratio - stride) > 0.05 * stride:
            raise UserError(
                f"history_hz = {self.history_hz:g} does not divide the {rate_hz:.3g} Hz of the log's tracks: choose "
                f"{rate_hz:.3g} / n for a whole n, or None for every frame"
            )
        return stride


class TruncationWarning(UserWarning):
    """An example has more items in range than its capacity; some were left out."""


class TrafficRateWarning(UserWarning):
    """The traffic flow of examples is not at the rate at which a model learned, or there is none."""


class MissingTracksWarning(UserWarning):
    """Frames whose source log is not at hand were left out, or have an empty traffic flow."""


@dataclass(frozen=True)
class FrameInfo:
    """Where an example comes from.

    Attributes:
        source: dataset name.
        scene: log or scene name.
        timestamp_ns: moment.
        global_from_ego: (4, 4) float64 pose.
        area: place, such as a city, in whose coordinates the pose is; "" if the source does not tell.
    """

    source: str
    scene: str
    timestamp_ns: int
    global_from_ego: np.ndarray
    area: str = ""


class IndexedExamples(Protocol):
    """Indexed examples of one kind as numpy arrays without a batch axis, all of the same shapes."""

    name: str

    def __len__(self) -> int:
        """Return the number of examples."""
        ...

    def example(self, index: int) -> Example | RoadImage:
        """Return one example; the same index always gives the same bits."""
        ...

    def info(self, index: int) -> FrameInfo:
        """Return where an example comes from, without making it."""
        ...


def made(dataset: IndexedExamples, index: int) -> Any:
    """Return an example; an error that its dataset raises gets a note that names the example."""
    try:
        return dataset.example(index)
    except Exception as error:
        error.add_note(f"(raised by example {index} of {dataset.name})")
        raise


def checked_index(index: int, size: int, name: str, what: str = "examples") -> int:
    """Return the index of an example; raise IndexError where the dataset `name` of that size has none."""
    if not 0 <= index < size:
        raise IndexError(f"{name} has {size} {what}, no number {index}")
    return index


def spread(size: int, count: int) -> list[int]:
    """Return `count` indices spread evenly over `size` (all of them if there are fewer); none for less than one."""
    return np.unique(np.linspace(0, size - 1, min(max(count, 0), size)).round().astype(int)).tolist()


class Dataset(IndexedExamples, Protocol):
    """Lane graphs around the vehicle."""

    def example(self, index: int) -> Example:
        """Return one example; the same index always gives the same bits."""
        ...


@runtime_checkable
class DrivenDataset(Protocol):
    """A dataset whose examples are key frames of logs."""

    def drives(self) -> Iterator[Log]:
        """Yield the logs, each once, in the order of the examples."""
        ...

"""What every dataset offers, and the sizes of the examples that it makes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.scene import Example, RoadImage
from tflane_jax.world.bev.sensor import BevSensorConfig
from tflane_jax.world.cameras.ring import CameraRigConfig
from tflane_jax.world.roads.sd_map import SdMapConfig


@dataclass(frozen=True)
class ExampleConfig:
    """Sizes and ranges of an `Example`.

    The capacities hold the two Argoverse 2 logs at hand with room to spare (58 lane segments, 28 centerlines, 11
    areas, 39 instances near the vehicle); what does not fit is left out, farthest first, with a
    `TruncationWarning`.

    Attributes:
        range: in which lanes, areas and elements are truth.
        sensor: bird's-eye-view evidence; None leaves it out.
        cameras: ring of cameras of the built-in world; None leaves them out. With cameras the traffic elements are
            those that the first one sees, with their boxes in its image, as OpenLane-V2 annotates them.
        markers: fiducial-marker prior with simulated detections (marker paper, section IV-A); None leaves it out.
        lanes, lane_points: merged centerlines and points on each.
        segments, segment_points: lane segments and points on each.
        areas, area_points: crossings with road boundaries and points on each.
        history: frames N of traffic flow before the key frame.
        tracks: instances K of traffic flow.
        elements: traffic lights and signs.
        bike_lanes: whether lanes closed to motor vehicles are truth.
        sd_map: coarse map of the roads of the built-in world; None leaves it out.
    """

    range: PerceptionRange = PerceptionRange()
    sensor: BevSensorConfig | None = BevSensorConfig()
    cameras: CameraRigConfig | None = None
    markers: MarkerConfig | None = None
    lanes: int = 48
    lane_points: int = 11
    segments: int = 96
    segment_points: int = 10
    areas: int = 32
    area_points: int = 20
    history: int = 20
    tracks: int = 96
    elements: int = 24
    bike_lanes: Literal["include", "exclude"] = "include"
    sd_map: SdMapConfig | None = None

    @property
    def ground(self) -> PerceptionRange:
        """The ground that rasters of the example cover, and that pictures of it are drawn on."""
        return BevGrid().range if self.sensor is None else self.sensor.grid.range


class TruncationWarning(UserWarning):
    """Something in range found no room in an example."""


@dataclass(frozen=True)
class FrameInfo:
    """Where an example comes from.

    Attributes:
        source: dataset name.
        scene: log or scene name.
        timestamp_ns: moment.
        global_from_ego: (4, 4) float64 pose.
    """

    source: str
    scene: str
    timestamp_ns: int
    global_from_ego: np.ndarray


class Source(Protocol):
    """Indexed examples of one task as numpy arrays without a batch axis, all of one shape."""

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


class Dataset(Source, Protocol):
    """Indexed examples of what is around the vehicle."""

    def example(self, index: int) -> Example:
        """Return one example; the same index always gives the same bits."""
        ...

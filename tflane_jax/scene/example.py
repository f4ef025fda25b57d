"""Examples: inputs and ground truth of one frame, or of one image."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, UInt8

from tflane_jax.scene.arrays import Array, check_shapes
from tflane_jax.scene.priors import MarkerObservations, SdMap, TrafficFlow
from tflane_jax.scene.truth import Areas, LaneGraph, LaneLines, MapLines, TrafficElements
from tflane_jax.scene.views import CameraViews

TreeT = TypeVar("TreeT")


@struct.dataclass
class Example:
    """One frame: sensor data, priors and ground truth.

    A prior or sensor that a dataset lacks is None; one that is absent in this frame is all invalid. Models treat both
    alike.

    Attributes:
        bev: (H, W, C) uint8 evidence in [0, 255] per `BevChannel`; row 0 is at the smallest y, column 0 at the smallest
            x, as in BEVFormer.
        hidden: (H, W) bool, ground out of line of sight. Only for evaluation and pictures, never a model input.
        traffic_flow: prior of TF-Lane.
        markers: prior of marker fusion (Wu and Hu).
        sd_map: prior of SMERF.
        lanes: ground truth, merged centerlines (OpenLane-V2 `lane_centerline`).
        segments: ground truth, lane segments (OpenLane-V2 `lane_segment`).
        areas: ground truth, crossings and road boundaries.
        traffic_elements: ground truth, traffic lights and signs.
        previous_from_ego: (4, 4) pose of this ego frame in the previous frame's ego frame.
        has_previous: () the previous frame belongs to the same scene.
        cameras: calibrated images.
        map_lines: ground truth, lines of a vector map; None if the dataset does not label them.
    """

    bev: UInt8[Array, "h w c"] | None
    hidden: Bool[Array, "h w"] | None
    traffic_flow: TrafficFlow | None
    markers: MarkerObservations | None
    sd_map: SdMap | None
    lanes: LaneGraph
    segments: LaneGraph
    areas: Areas
    traffic_elements: TrafficElements | None
    previous_from_ego: Float[Array, "4 4"]
    has_previous: Bool[Array, ""]
    cameras: CameraViews | None = None
    map_lines: MapLines | None = None

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)
        if (elements := self.traffic_elements) is None:
            return
        for name, governed, lanes in (
            ("lane", elements.lane, self.lanes),
            ("segment", elements.segment, self.segments),
        ):
            if governed is not None and len(governed) != len(lanes.valid):
                expected = f"one for each of {len(lanes.valid)} {name}s"
                raise AssertionError(f"traffic_elements.{name} has {len(governed)} rows, expected {expected}")


@struct.dataclass
class RoadImage:
    """One front-view image and the lane lines in it: an example of the monocular task.

    Attributes:
        image: (H, W, 3) uint8, RGB.
        image_valid: (H, W) False in padding, such as that of augmentation.
        lines: ground truth.
    """

    image: UInt8[Array, "h w 3"]
    image_valid: Bool[Array, "h w"]
    lines: LaneLines

    def validate(self) -> None:
        """Raise AssertionError naming the first field whose shape does not fit."""
        check_shapes(self)


def stack_examples(examples: list[Any]) -> Any:
    """Stack pytrees of equal structure into one batch with a leading axis (numpy, host)."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def row_of(stacked: TreeT, index: int) -> TreeT:
    """Return one example of a batch, or one row of any pytree with a leading axis, as arrays (numpy, host)."""
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]), stacked)


def shapes_of(example: Any, *leading: int) -> Any:
    """Return shapes and types of the leaves of a pytree, with `leading` axes in front."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape), leaf.dtype), example)

"""One frame as a model and its loss take it."""

from __future__ import annotations

from typing import Any

import chex
import jax
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, UInt8

from tflane_jax.scene.arrays import Array
from tflane_jax.scene.priors import MarkerObservations, SdMap, TrafficFlow
from tflane_jax.scene.truth import Areas, LaneGraph, LaneLines, MapLines, TrafficElements
from tflane_jax.scene.views import CameraViews


@struct.dataclass
class Example:
    """One frame: what the sensors and the priors say, and the truth.

    A prior or sensor that a dataset does not offer at all is None; one that is absent in this frame is all invalid.
    Both mean the same to a model.

    Attributes:
        bev: (H, W, C) uint8 evidence in [0, 255] per `BevChannel`; row 0 lies at the least y, column 0 at the least x
            (BEVFormer's grid).
        hidden: (H, W) bool, ground that no ray reaches. Never a model input: it is there for evaluation and pictures.
        traffic_flow: prior of TF-Lane.
        markers: prior of marker fusion.
        sd_map: prior of SMERF.
        lanes: truth, merged centerlines (OpenLane-V2 `lane_centerline`).
        segments: truth, lane segments (OpenLane-V2 `lane_segment`).
        areas: truth, crossings and road boundaries.
        traffic_elements: truth.
        previous_from_ego: (4, 4) pose of this ego frame in the previous frame's ego frame.
        has_previous: () the previous frame belongs to the same scene.
        cameras: what the cameras see.
        map_lines: truth, lines of a vector map; None where a dataset has none of its own.
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
        """Validate every part; raise AssertionError naming the first field that does not fit."""
        parts = (
            self.traffic_flow,
            self.markers,
            self.sd_map,
            self.lanes,
            self.segments,
            self.areas,
            self.traffic_elements,
            self.cameras,
            self.map_lines,
        )
        for part in parts:
            if part is not None:
                part.validate()
        chex.assert_shape(self.previous_from_ego, (4, 4))


@struct.dataclass
class RoadImage:
    """One front-view image and the lane lines in it: an example of the monocular task.

    Attributes:
        image: (H, W, 3) uint8, RGB.
        image_valid: (H, W) false where augmentation left no image.
        lines: truth.
    """

    image: UInt8[Array, "h w 3"]
    image_valid: Bool[Array, "h w"]
    lines: LaneLines

    def validate(self) -> None:
        """Validate every part; raise AssertionError naming the first field that does not fit."""
        h, w = self.image_valid.shape
        chex.assert_shape(self.image, (h, w, 3))
        self.lines.validate()


def stack_examples(examples: list[Any]) -> Any:
    """Stack pytrees of equal structure into one batch with a leading axis (numpy, host)."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def shapes_of(example: Any, *leading: int) -> Any:
    """Return shapes and types of the leaves of a pytree, with `leading` axes in front."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape), leaf.dtype), example)

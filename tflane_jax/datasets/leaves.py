"""Examples as flat, named arrays ("lanes.points"), as they are stored, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from tflane_jax.scene import (
    Areas,
    CameraViews,
    Example,
    LaneGraph,
    LaneLines,
    MapLines,
    MarkerObservations,
    RoadImage,
    SdMap,
    TrafficElements,
    TrafficFlow,
)

# Fields of `Example` that are containers; its other fields are arrays.
PARTS = {
    "traffic_flow": TrafficFlow,
    "markers": MarkerObservations,
    "sd_map": SdMap,
    "lanes": LaneGraph,
    "segments": LaneGraph,
    "areas": Areas,
    "traffic_elements": TrafficElements,
    "cameras": CameraViews,
    "map_lines": MapLines,
}

# The same of `RoadImage`.
IMAGE_PARTS = {"lines": LaneLines}


def example_leaves(example: Example | RoadImage) -> dict[str, np.ndarray]:
    """Return the example's arrays by name in the order of the fields; what is None has no entry."""
    parts = IMAGE_PARTS if isinstance(example, RoadImage) else PARTS
    leaves = {}
    for field in fields(example):
        value = getattr(example, field.name)
        if value is None:
            continue
        if field.name in parts:
            for inner in fields(parts[field.name]):
                if (leaf := getattr(value, inner.name)) is not None:
                    leaves[f"{field.name}.{inner.name}"] = np.asarray(leaf)
        else:
            leaves[field.name] = np.asarray(value)
    return leaves


def example_from_leaves(leaves: Mapping[str, np.ndarray]) -> Example:
    """Return the example whose arrays these are, with or without leading axes; absent parts become None."""
    return Example(**_gathered(Example, PARTS, leaves))


def image_from_leaves(leaves: Mapping[str, np.ndarray]) -> RoadImage:
    """Return the road image whose arrays these are, with or without leading axes; absent parts become None."""
    return RoadImage(**_gathered(RoadImage, IMAGE_PARTS, leaves))


def _gathered(kind: type, containers: Mapping[str, type], leaves: Mapping[str, np.ndarray]) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for field in fields(kind):
        container = containers.get(field.name)
        if container is None:
            parts[field.name] = leaves.get(field.name)
            continue
        inner = {f.name: leaves.get(f"{field.name}.{f.name}") for f in fields(container)}
        absent = all(value is None for value in inner.values())
        parts[field.name] = None if absent else container(**inner)
    return parts

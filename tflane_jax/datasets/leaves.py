"""Examples as flat, named arrays ("lanes.points"), the form in which they are stored, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from tflane_jax.scene import (
    Areas,
    Example,
    LaneGraph,
    MarkerObservations,
    SdMap,
    TrafficElements,
    TrafficFlow,
)

# The parts of an example that are containers of their own; its other fields are arrays.
PARTS = {
    "traffic_flow": TrafficFlow,
    "markers": MarkerObservations,
    "sd_map": SdMap,
    "lanes": LaneGraph,
    "segments": LaneGraph,
    "areas": Areas,
    "traffic_elements": TrafficElements,
}


def example_leaves(example: Example) -> dict[str, np.ndarray]:
    """Return the example's arrays by name in the order of the fields; a part that is None has no entry."""
    leaves = {}
    for field in fields(Example):
        value = getattr(example, field.name)
        if value is None:
            continue
        if field.name in PARTS:
            for inner in fields(PARTS[field.name]):
                leaves[f"{field.name}.{inner.name}"] = np.asarray(getattr(value, inner.name))
        else:
            leaves[field.name] = np.asarray(value)
    return leaves


def example_from_leaves(leaves: Mapping[str, np.ndarray]) -> Example:
    """Return the example whose arrays these are, with or without leading axes; absent parts become None."""
    parts = {}
    for field in fields(Example):
        container = PARTS.get(field.name)
        if container is None:
            parts[field.name] = leaves.get(field.name)
            continue
        inner = {f.name: leaves.get(f"{field.name}.{f.name}") for f in fields(container)}
        absent = all(value is None for value in inner.values())
        parts[field.name] = None if absent else container(**inner)
    return Example(**parts)

"""Examples as flat, named arrays ("lanes.points"), as they are stored, and back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
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
    VehicleState,
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


# Containers in a container, by the field that holds them.
_WITHIN: Mapping[type, Mapping[str, type]] = {
    Example: PARTS,
    RoadImage: IMAGE_PARTS,
    CameraViews: {"vehicle": VehicleState},
}


def example_leaves(example: Example | RoadImage) -> dict[str, np.ndarray]:
    """Return the example's arrays by name in the order of the fields; what is None has no entry."""
    return dict(_named(example, ""))


Form = Mapping[str, tuple[tuple[int, ...], np.dtype]]
"""Shape and type of every array of an example, by name."""


def form_of(leaves: Mapping[str, np.ndarray]) -> Form:
    """Return the form of an example's arrays."""
    return {name: (leaf.shape, leaf.dtype) for name, leaf in leaves.items()}


def check_form(dataset: str, index: int, leaves: Mapping[str, np.ndarray], first: Form) -> None:
    """Raise UserError where an example has other arrays, shapes or types than the dataset's first one.

    Arrays of all examples are stacked: without this, another type would be converted, and an absent array be garbage.
    """
    found = form_of(leaves)
    for name in sorted(found.keys() | first.keys()):
        if found.get(name) != first.get(name):
            there, other = (_told(form.get(name)) for form in (first, found))
            raise UserError(
                f"{dataset}: {name} is {other} in example {index} and {there} in example 0; all examples of a dataset "
                "have the same arrays, with padding where one holds less"
            )


def _told(form: tuple[tuple[int, ...], np.dtype] | None) -> str:
    return "absent" if form is None else f"{form[1]} of shape {form[0]}"


def example_from_leaves(leaves: Mapping[str, np.ndarray]) -> Example:
    """Return the example whose arrays these are, with or without leading axes; absent parts become None."""
    return Example(**_gathered(Example, leaves, ""))


def image_from_leaves(leaves: Mapping[str, np.ndarray]) -> RoadImage:
    """Return the road image whose arrays these are, with or without leading axes; absent parts become None."""
    return RoadImage(**_gathered(RoadImage, leaves, ""))


def _named(value: Any, prefix: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and array of each leaf of a container."""
    within = _WITHIN.get(type(value), {})
    for field in fields(value):
        inner, name = getattr(value, field.name), f"{prefix}{field.name}"
        if inner is not None and field.name in within:
            yield from _named(inner, f"{name}.")
        elif inner is not None:
            yield name, np.asarray(inner)


def _gathered(kind: type, leaves: Mapping[str, np.ndarray], prefix: str) -> dict[str, Any]:
    """Return the fields of a container whose leaves have names that begin with `prefix`."""
    within, parts = _WITHIN.get(kind, {}), {}
    for field in fields(kind):
        name = f"{prefix}{field.name}"
        if field.name not in within:
            parts[field.name] = leaves.get(name)
            continue
        container, there = within[field.name], any(leaf.startswith(f"{name}.") for leaf in leaves)
        parts[field.name] = container(**_gathered(container, leaves, f"{name}.")) if there else None
    return parts

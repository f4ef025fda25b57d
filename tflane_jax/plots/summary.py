"""A table of a dataset: amounts per frame, how much is hidden, how often capacities are full."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Shaped
from numpy.typing import ArrayLike

from tflane_jax.scene import AreaType, Example, LineClass

# A lane or line with a smaller visibility counts as out of sight.
_HIDDEN_BELOW = 0.5


def dataset_summary(arrays: Example) -> list[dict[str, Any]]:
    """Return rows for `format_table`: mean, minimum and maximum of each quantity over the examples, and its capacity.

    "full" is the fraction of examples that use every slot, so that something may have been left out. Quantities that
    the dataset does not have are omitted.

    Args:
        arrays: examples stacked along a leading axis.
    """
    lanes, areas, flow = arrays.lanes, arrays.areas, arrays.traffic_flow
    links = lanes.successor & lanes.valid[:, :, None] & lanes.valid[:, None]
    rows = [
        _slots("lanes", lanes.valid),
        _subset("- out of sight", lanes.valid & (lanes.visibility < _HIDDEN_BELOW)),
        _subset("- in intersections", lanes.valid & lanes.is_connector),
        _row("- fraction in line of sight", _mean_of(lanes.visibility, lanes.valid)),
        _row("- topology links", links.sum((1, 2))),
        _slots("lane segments", arrays.segments.valid),
        _slots("areas", areas.valid),
        _subset("- crossings", areas.valid & (areas.category == AreaType.PEDESTRIAN_CROSSING)),
        _subset("- road boundaries", areas.valid & (areas.category == AreaType.ROAD_BOUNDARY)),
    ]
    if (lines := arrays.map_lines) is not None:
        rows.append(_slots("map lines", lines.valid))
        rows += [_subset(f"- {kind.name.lower()}", lines.valid & (lines.category == kind)) for kind in LineClass]
        if lines.visibility is not None:
            rows.append(_subset("- lines out of sight", lines.valid & (lines.visibility < _HIDDEN_BELOW)))
    if flow is not None:
        known = flow.valid.any(-1)
        rows += [
            _slots("road users", known),
            _row("- frames of each", _mean_of(flow.valid.sum(-1), known)),
            _row("- fraction of boxes not seen", _mean_of(flow.occluded, flow.valid)),
        ]
    if arrays.traffic_elements is not None:
        rows.append(_slots("traffic lights and signs", arrays.traffic_elements.valid))
    if arrays.hidden is not None:
        rows.append(_row("fraction of ground out of sight", arrays.hidden.mean((1, 2))))
    return rows


def _slots(quantity: str, valid: Bool[Array, "b n"]) -> dict[str, Any]:
    capacity = valid.shape[1]
    full = float((valid.sum(1) == capacity).mean()) if capacity else None
    return _row(quantity, valid.sum(1)) | {"capacity": capacity, "full": full}


def _subset(quantity: str, chosen: Bool[Array, "b n"]) -> dict[str, Any]:
    return _row(quantity, chosen.sum(1))


def _row(quantity: str, values: ArrayLike) -> dict[str, Any]:
    """Return the statistics over the examples with a finite value; None if there are none."""
    numbers = np.asarray(values, np.float64)
    numbers = numbers[np.isfinite(numbers)]
    mean, least, most = (numbers.mean(), numbers.min(), numbers.max()) if len(numbers) else (None, None, None)
    return {"quantity": quantity, "mean": mean, "least": least, "most": most, "capacity": None, "full": None}


def _mean_of(values: Shaped[Array, "b *n"], valid: Bool[Array, "b *n"]) -> Float[np.ndarray, " b"]:
    """Return each example's mean over its valid entries, NaN if it has none."""
    axes = tuple(range(1, valid.ndim))
    number = valid.sum(axes)
    total = np.where(valid, values, 0.0).sum(axes)
    return np.divide(total, number, out=np.full(len(total), np.nan), where=number > 0)

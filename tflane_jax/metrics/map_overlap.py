"""Overlap of the buffers of polylines, MapTR's optional measure (needs shapely)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.errors import missing_extra
from tflane_jax.metrics.chamfer import PaddedLines

OVERLAP_THRESHOLDS = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
# 1 - IoU; what rounding adds must not miss a threshold, which counts.
OVERLAP_DISTANCES = tuple(1.0 - threshold + 1e-12 for threshold in OVERLAP_THRESHOLDS)
OVERLAP_BUFFER = 1.0  # metres to each side of a line


def map_overlap(true: PaddedLines, found: PaddedLines, same: Bool[np.ndarray, "g p"]) -> Float[np.ndarray, "g p"]:
    """Return the IoU of the lines' buffers (1 m to each side, flat ends, mitred bends); 0 where `same` is false.

    Raises UserError if shapely is not installed.
    """
    shapely: Any
    try:
        import shapely
    except ImportError as error:
        raise missing_extra("the IoU of lines needs shapely", "data") from error
    i, j = np.nonzero(same)
    overlap = np.zeros(same.shape)
    if len(i):
        a, b = (_buffers(shapely, lines.points[..., :2]) for lines in (true, found))
        meets = shapely.intersects(a[i], b[j])
        i, j = i[meets], j[meets]
        common = shapely.area(shapely.intersection(a[i], b[j]))
        whole = shapely.area(a[i]) + shapely.area(b[j]) - common
        overlap[i, j] = np.where(whole > 0.0, common / np.where(whole > 0.0, whole, 1.0), 0.0)
    return overlap


def _buffers(shapely: Any, lines: Float[np.ndarray, "l n 2"]) -> Any:
    return shapely.buffer(shapely.linestrings(lines), OVERLAP_BUFFER, cap_style="flat", join_style="mitre")

"""Polygons of shapely, which an extra installs: the import, and the rings of a polygon.

Readers differ in the rest on purpose: which way rings run, and whether polygons that touch or cross themselves are
repaired, left out or kept.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tflane_jax.errors import missing_extra


def import_shapely(purpose: str) -> Any:
    """Return the package; raise UserError, which says that `purpose` needs it, if it is not installed."""
    try:
        import shapely
    except ImportError as error:
        raise missing_extra(f"{purpose} needs shapely", "data") from error
    return shapely


def flat_rings(polygon: Any) -> list[np.ndarray]:
    """Return the rings (n, 2) of a polygon, the exterior first, as they run; each repeats its first point."""
    return [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]

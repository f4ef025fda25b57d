"""Closed rings around the drivable area, assembled from road boundaries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# Ends of a line nearer than this make it a closed ring, metres.
_CLOSED = 0.05


def road_rings(boundaries: Sequence[Float[np.ndarray, "_ 3"]]) -> list[Float[np.ndarray, "_ 2"]]:
    """Return rings that bound the drivable area by the even-odd rule: outlines and islands.

    An open boundary has the road on its left and ends at the border of the map. The next one begins there, on the other
    side of the same street, so each end is joined to the nearest start.
    """
    lines = [np.asarray(line, np.float64)[:, :2] for line in boundaries if len(line) > 1]
    rings = [line for line in lines if np.linalg.norm(line[0] - line[-1]) < _CLOSED]
    left = [line for line in lines if np.linalg.norm(line[0] - line[-1]) >= _CLOSED]
    while left:
        chain = [left.pop(0)]
        while left:
            end = chain[-1][-1]
            gaps = [float(np.linalg.norm(line[0] - end)) for line in left]
            nearest = int(np.argmin(gaps))
            if float(np.linalg.norm(chain[0][0] - end)) <= gaps[nearest]:
                break
            chain.append(left.pop(nearest))
        rings.append(np.concatenate(chain))
    return rings

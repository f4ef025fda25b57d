"""Colours of a board's cells from their brightness, in one light or on both sides of a shadow edge.

Part of step 4 of `occluded_search`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.markers.occluded_quads import BLACK, CONTRAST, WHITE, rings

LEAST_QUALITY = 0.55
"""Least fraction of margin and border cells that read as such."""
# What a shadow edge must add to that fraction: one that is not there adds some, too.
_EDGE_COST = 0.06
# With a board in one light that reads so well, no shadow edge is looked for.
_WELL_READ = 0.93


class CellLevels(NamedTuple):
    """Cells of a quad, the margin included.

    Attributes:
        colours: 1 for white cells, -1 for black and 0 for unknown ones.
        quality: fraction of margin and border that reads as such; a shadow edge costs `_EDGE_COST`.
        shaded: cells in a shadow.
    """

    colours: Float[np.ndarray, "m m"]
    quality: float
    shaded: Bool[np.ndarray, "m m"]


class Side(NamedTuple):
    """The cells on one side of a shadow edge, or all of a board: indices of the m * m cells, row by row.

    Attributes:
        cells: all of them.
        margin, border: those in the white margin, and in the black border.
    """

    cells: Int[np.ndarray, " c"]
    margin: Int[np.ndarray, " w"]
    border: Int[np.ndarray, " b"]


def cell_levels(seen: Float[np.ndarray, "m m"]) -> CellLevels | None:
    """Return the colours of cells; None if margin and border do not read as white and black.

    Of one light and of all shadow edges, those colours count whose margin and border read best.
    """
    best: CellLevels | None = None
    for sides in splits(len(seen)):
        found = _colours(seen, sides)
        if found is None:
            continue
        if best is None or found.quality > best.quality:
            best = found
        if len(sides) == 1 and found.quality > _WELL_READ:
            break
    return None if best is None or best.quality < LEAST_QUALITY else best


def _colours(seen: Float[np.ndarray, "m m"], sides: tuple[Side, ...]) -> CellLevels | None:
    """Return the colours of cells with levels of black and white on each side; None if a side has no contrast.

    The levels are medians over the border and the margin of the side.
    """
    flat, m = seen.ravel(), len(seen)
    colours, whites = np.zeros(m * m), []
    for side in sides:
        white, black = _median(flat[side.margin]), _median(flat[side.border])
        if white - black < CONTRAST:
            return None
        whites.append(white)
        fraction = (flat[side.cells] - black) / (white - black)
        bright, dark = (fraction > WHITE[0]) & (fraction < WHITE[1]), (fraction > BLACK[0]) & (fraction < BLACK[1])
        colours[side.cells] = bright * 1.0 - dark * 1.0
    margin, border = (ring.ravel() for ring in rings(m))
    right = np.count_nonzero(colours[margin] > 0.0) + np.count_nonzero(colours[border] < 0.0)
    quality = right / (np.count_nonzero(margin) + np.count_nonzero(border)) - _EDGE_COST * (len(sides) - 1)
    shaded = np.zeros(m * m, bool)
    if len(sides) > 1:
        shaded[sides[int(np.argmin(whites))].cells] = True
    return CellLevels(colours.reshape(m, m), quality, shaded.reshape(m, m))


def _median(values: Float[np.ndarray, " n"]) -> float:
    """Return the median, of an even number of values the upper of the two in the middle."""
    return np.sort(values)[len(values) // 2]


@lru_cache(maxsize=8)
def splits(m: int) -> tuple[tuple[Side, ...], ...]:
    """Return the whole board as one side, then both sides of each straight edge across it."""
    at = (np.arange(m) + 0.5) / m - 0.5
    y, x = (axis.ravel() for axis in np.meshgrid(at, at, indexing="ij"))
    margin, border = (ring.ravel() for ring in rings(m))

    def part(side: np.ndarray) -> Side:
        return Side(np.flatnonzero(side), np.flatnonzero(side & margin), np.flatnonzero(side & border))

    found: list[tuple[Side, ...]] = [(part(np.ones(m * m, bool)),)]
    for angle in np.arange(8) * np.pi / 8:
        for offset in (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3):
            first = x * np.cos(angle) + y * np.sin(angle) > offset
            both = part(first), part(~first)
            if all(len(side.margin) >= 4 and len(side.border) >= 3 for side in both):
                found.append(both)
    return tuple(found)

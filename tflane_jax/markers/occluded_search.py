"""Markers whose outline is broken: behind a post or a leaf, dirty, or half in the shadow.

OpenCV needs the whole outline of the black square and nearly all cells. Here a square is a hypothesis of two opposite
edges, each of which may be a fragment:

1. Line segments (LSD), each with its dark side.
2. Pairs of opposite segments that face each other with their dark sides. Each pair gives some quads: from the ends of
   both, of one of them, or of their union, also prolonged.
3. A quad is kept if most cells of the margin are brighter than the cells of the black border beside them. This compares
   neighbours only, so a shadow changes little.
4. Its corners are fitted to border and margin (`corner_refinement`), its cells are read with levels of black and white
   from the margin and the border beside them, on both sides of a possible shadow edge. A cell near neither level is
   unknown.
5. The id is the one whose cells match best. It must be ahead of the number of possible ids and rotations by some
   bits, and of the second best id: the fewer ids are possible, the more cells may be hidden.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.files.images import opencv
from tflane_jax.markers.cell_levels import LEAST_QUALITY, CellLevels, cell_levels, splits
from tflane_jax.markers.corner_refinement import refine_corners
from tflane_jax.markers.occluded_quads import CONTRAST, rings, square_quads
from tflane_jax.scene.marker_patterns import MarkerFamily, cells_across, marker_cells, marker_count

# Bits by which an id must be ahead of chance, where `LEAST_QUALITY` of margin and border read as such and where `_SURE`
# of them do, and of the second best id; cost of a cell that reads wrong, bits.
_SURE, _AHEAD, _SECOND, _WRONG = 0.8, (9.0, 4.0), 4.0, 4.0
# Least fraction of a board's points that are as bright as printed; less is enough (dirt) if nearly all cells of margin
# and border, and all inner ones but a few, read right.
_EXPLAINED, _DIRTY, _CLEAN, _FEW = 0.72, 0.6, 0.85, 3
_INNER = 0.63  # the same of inner cells in sight: 0.57 on signs with a bent arrow, 0.69 and more on damaged boards
# From this fraction on, the corners are not searched again; how often they are below it.
_CERTAIN, _AGAIN = 0.9, 4
# Standard deviation of the blur of lens and pixels, pixels.
_BLUR = 0.8


class OccludedMarker(NamedTuple):
    """A marker.

    Attributes:
        marker_id: identity.
        corners: pixels.
        wrong_bits: cells that do not read as printed, those of the border and hidden ones included.
        explained: fraction of the board that is as bright as printed.
    """

    marker_id: int
    corners: Float[np.ndarray, "4 2"]
    wrong_bits: int
    explained: float


def find_occluded(
    grey: UInt8[np.ndarray, "h w"], family: MarkerFamily, least_pixels: float, ids: Collection[int] | None = None
) -> list[OccludedMarker]:
    """Return the markers of an image, each once; corners in the order of `ImageMarkers`.

    Args:
        grey: image.
        family: dictionary of the markers.
        least_pixels: smallest side of a square, pixels.
        ids: that are possible; None: all of the family. Others are not found.
    """
    possible = tuple(range(marker_count(family))) if ids is None else tuple(sorted(set(ids)))
    if not possible or min(grey.shape) < least_pixels + 4:
        return []
    found: list[OccludedMarker] = []
    again: list[int] = []
    for quad in square_quads(grey, cells_across(family), least_pixels):
        here = [k for k, each in enumerate(found) if _inside(quad.mean(0), each.corners)]
        # Another quad of a board whose corners are doubtful may have better ones.
        if here and (found[here[0]].explained >= _CERTAIN or again.count(here[0]) == _AGAIN):
            continue
        again += here
        marker = _identify(grey, quad, family, possible)
        if marker is None:
            continue
        if not here:
            found.append(marker)
        elif marker.explained > found[here[0]].explained:
            found[here[0]] = marker
    return found


def _identify(
    grey: UInt8[np.ndarray, "h w"], quad: Float[np.ndarray, "4 2"], family: MarkerFamily, ids: tuple[int, ...]
) -> OccludedMarker | None:
    """Return the marker in a quad; None if none is certain."""
    n = cells_across(family)
    ring, corners, levels = np.ones((n, n), bool), quad, None
    ring[1:-1, 1:-1] = False
    for _ in range(2):
        shaded = None if levels is None else levels.shaded
        corners = refine_corners(grey, corners, np.zeros((n, n), bool), ring, shaded)
        levels = cell_levels(_cell_means(grey, corners, n))
        if levels is None or not levels.shaded.any():
            break
    decoded = None if levels is None else _decoded(levels, family, ids)
    if decoded is None:
        return None
    # Once more with the printed cells, whose edges fix the corners where the outline is hidden.
    cells, tried = marker_cells(family, decoded.marker_id), []
    for start in (np.roll(corners, -decoded.turns, 0), np.roll(quad, -decoded.turns, 0)):
        for shaded in (None, _best_shade(grey, start, cells)):
            final = refine_corners(grey, start, cells, None, shaded)
            tried.append((_explained(grey, final, cells, _best_shade(grey, final, cells)), final))
    explained, final = max(tried, key=lambda pair: pair[0])
    levels = cell_levels(_cell_means(grey, final, n))
    again = None if levels is None else _decoded(levels, family, ids)
    if levels is None or again is None or (again.marker_id, again.turns) != (decoded.marker_id, 0):
        return None
    dirty = explained >= _DIRTY and levels.quality >= _CLEAN and again.wrong <= _FEW
    certain = explained >= _EXPLAINED or dirty
    if not certain or _inner_explained(grey, final, cells, levels) < _INNER:
        return None
    of_border = int((rings(n + 2)[1] & (levels.colours >= 0.0)).sum())
    return OccludedMarker(decoded.marker_id, final, again.wrong + of_border, explained)


def _inside(point: Float[np.ndarray, "2"], corners: Float[np.ndarray, "4 2"]) -> bool:
    side = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1).mean()
    return bool(np.linalg.norm(point - corners.mean(0)) < 0.5 * side)


# ---------------------------------------------------------------------------------------------------------------------
# Cells


class _Decoded(NamedTuple):
    """An id, the quarter turns of its pattern in the quad, and how many inner cells do not read as printed."""

    marker_id: int
    turns: int
    wrong: int


def _decoded(levels: CellLevels, family: MarkerFamily, ids: tuple[int, ...]) -> _Decoded | None:
    """Return the id of the cells in a quad; None if none is certain."""
    colours, quality = levels.colours, levels.quality
    codes, names, turns = _codes(family, ids)
    doubt = np.clip((_SURE - quality) / (_SURE - LEAST_QUALITY), 0.0, 1.0)
    needed = np.log2(len(codes)) + _AHEAD[1] + doubt * (_AHEAD[0] - _AHEAD[1])
    for hidden in (np.zeros_like(colours, bool), _between_faults(colours)):
        inner = np.where(hidden, 0.0, colours)[2:-2, 2:-2].ravel()
        # A bit for each cell that reads as printed, minus the cost of each that reads the other way.
        agree = np.maximum(codes * inner, 0.0).sum(-1)
        evidence = agree - _WRONG * np.maximum(-codes * inner, 0.0).sum(-1)
        best = int(np.argmax(evidence))
        second = evidence[names != names[best]].max(initial=-np.inf)
        if evidence[best] >= needed and evidence[best] >= second + _SECOND:
            return _Decoded(int(names[best]), int(turns[best]), int(len(inner) - agree[best]))
    return None


def _between_faults(read: Float[np.ndarray, "m m"]) -> Bool[np.ndarray, "m m"]:
    """Return the cells between those of margin and border that do not read as such: behind what hides these."""
    m = len(read)
    margin, border = rings(m)
    faults = np.argwhere((margin & (read <= 0.0)) | (border & (read >= 0.0))).astype(float)
    cells = np.argwhere(np.ones((m, m), bool)).astype(float)
    i, j = np.triu_indices(len(faults), 1)
    start, step = faults[i], faults[j] - faults[i]
    far = np.hypot(*step.T) > 2.0
    start, step = start[far], step[far]
    if not len(start):
        return np.zeros((m, m), bool)
    away = cells[None] - start[:, None]
    along = np.clip((away * step[:, None]).sum(-1) / (step**2).sum(-1)[:, None], 0.0, 1.0)
    distance = np.linalg.norm(away - along[..., None] * step[:, None], axis=-1)
    return (distance.min(0) < 0.6).reshape(m, m)


def _cell_means(grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], n: int) -> Float[np.ndarray, "m m"]:
    """Return the brightness of the middles of all cells, the margin included."""
    seen = _flattened(grey, corners, n, 6)
    return seen.reshape(n + 2, 6, n + 2, 6)[:, 2:4, :, 2:4].mean((1, 3))


def _flattened(
    grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], n: int, fine: int
) -> UInt8[np.ndarray, "k k"]:
    """Return a board and its margin seen from the front, `fine` points for a cell."""
    cv2 = opencv()
    square = fine * np.array([(1, 1), (n + 1, 1), (n + 1, n + 1), (1, n + 1)], np.float32) - 0.5
    flat = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), square)
    size = fine * (n + 2)
    return cv2.warpPerspective(grey, flat, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _best_shade(
    grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], cells: Bool[np.ndarray, "n n"]
) -> Bool[np.ndarray, "m m"]:
    """Return the cells on one side of the shadow edge with which the printed cells explain most of the image."""
    m = len(cells) + 2
    shades = [np.zeros((m, m), bool)]
    for sides in splits(m)[1:]:
        shade = np.zeros(m * m, bool)
        shade[sides[0].cells] = True
        shades.append(shade.reshape(m, m))
    seen, board = _fine(grey, corners, cells, 3)
    explained = [_fraction_explained(seen, board, shade) for shade in shades]
    best = int(np.argmax(explained))
    # A shadow edge must explain more than one that is not there.
    return shades[best] if explained[best] > explained[0] + 0.03 else shades[0]


def _explained(
    grey: UInt8[np.ndarray, "h w"],
    corners: Float[np.ndarray, "4 2"],
    cells: Bool[np.ndarray, "n n"],
    shaded: Bool[np.ndarray, "m m"],
) -> float:
    """Return the fraction of a board's points, margin included, that are as bright as the printed cells."""
    return _fraction_explained(*_fine(grey, corners, cells, 6), shaded)


def _inner_explained(
    grey: UInt8[np.ndarray, "h w"],
    corners: Float[np.ndarray, "4 2"],
    cells: Bool[np.ndarray, "n n"],
    levels: CellLevels,
) -> float:
    """Return the fraction of the points of inner cells in sight, or else of all, that are as bright as printed."""
    right = _as_printed(*_fine(grey, corners, cells, 6), _best_shade(grey, corners, cells))[12:-12, 12:-12]
    sight = np.kron(~_between_faults(levels.colours)[2:-2, 2:-2], np.ones((6, 6), bool))
    return float(right[sight].mean() if sight.any() else right.mean())


def _fine(
    grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], cells: Bool[np.ndarray, "n n"], fine: int
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k"]]:
    """Return the image in the frame of a board, `fine` points for a cell, and the printed cells as blurred there."""
    cv2, n = opencv(), len(cells)
    seen = _flattened(grey, corners, n, fine).astype(np.float64)
    cell = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1).mean() / n
    board = np.kron(np.pad(cells, 1, constant_values=True), np.ones((fine, fine))).astype(np.float32)
    return seen, cv2.GaussianBlur(board, (0, 0), _BLUR * fine / cell, borderType=cv2.BORDER_REPLICATE)


def _fraction_explained(
    seen: Float[np.ndarray, "k k"], board: Float[np.ndarray, "k k"], shaded: Bool[np.ndarray, "m m"]
) -> float:
    return float(_as_printed(seen, board, shaded).mean())


def _as_printed(
    seen: Float[np.ndarray, "k k"], board: Float[np.ndarray, "k k"], shaded: Bool[np.ndarray, "m m"]
) -> Bool[np.ndarray, "k k"]:
    """Return the points that are as bright as printed, in the shadow and out of it; none if either has no contrast."""
    fine, right = len(seen) // len(shaded), np.zeros(seen.shape, bool)
    dark = np.kron(shaded, np.ones((fine, fine), bool))
    for side in (dark, ~dark) if shaded.any() else (~dark,):
        whites, blacks = seen[side & (board > 0.85)], seen[side & (board < 0.15)]
        white, black = (np.median(some) if len(some) else np.nan for some in (whites, blacks))
        if not white - black >= CONTRAST:
            return np.zeros(seen.shape, bool)
        right |= side & (np.abs(seen - (black + (white - black) * board)) < 0.2 * (white - black))
    return right


@lru_cache(maxsize=32)
def _codes(family: MarkerFamily, ids: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inner cells as +1 and -1 for each id and quarter turn, the ids, and the turns.

    Turn k: the first corner of the pattern as printed is corner k of the quad.
    """
    codes, names, turns = [], [], []
    for number in ids:
        inner = np.where(marker_cells(family, number)[1:-1, 1:-1], 1.0, -1.0)
        for turn in range(4):
            codes.append(np.rot90(inner, -turn).ravel())
            names.append(number)
            turns.append(turn)
    return np.array(codes), np.array(names), np.array(turns)

"""Refining the corners of a marker by fitting its printed cells to the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.files.images import opencv

# Standard deviation of the blur of lens and pixels, pixels; most steps; largest shift of a corner, cells; residual that
# halves a weight, as a fraction of the contrast.
_SPREAD, _STEPS, _REACH, _DOUBT = 0.8, 12, 0.6, 0.15


def refine_corners(
    grey: UInt8[np.ndarray, "h w"],
    corners: Float[np.ndarray, "4 2"],
    cells: Bool[np.ndarray, "n n"],
    known: Bool[np.ndarray, "n n"] | None = None,
    shaded: Bool[np.ndarray, "m m"] | None = None,
) -> Float[np.ndarray, "4 2"]:
    """Return the corners (pixels) of the black square for which its cells fit the image best.

    Gauss-Newton with Cauchy weights on a + b T(q) - I(H(q)) over points q of the marker and half a cell around it: T
    is the blurred pattern of the cells, H the homography given by the four corners, a and b brightness and contrast
    (solved for in each step). All edges of all cells contribute, not only the four corners. The input corners are
    returned if the iteration does not converge or moves a corner by more than 0.6 cells (at least 1 pixel).

    Args:
        grey: image.
        corners: a first guess, in the order of `ImageMarkers`.
        cells: of the marker, as `marker_cells`.
        known: cells that count; None: all.
        shaded: cells in a shadow, those of the margin included, which have a brightness and contrast of their own.
    """
    cell = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1).mean() / len(cells)
    board = _board(cells, known, shaded, cell)
    window, low = _window(grey, corners, 3.0 * board.spread + 2.0 * cell)
    if not window.size:
        return corners
    picture = _as_blurred(window, board.spread)
    now, weight = corners.astype(np.float64), board.counted
    for _ in range(_STEPS):
        unknown, brightness = _equations(board, picture, low, now)
        weighted = (unknown * weight[:, None]).T
        matrix = weighted @ unknown
        if np.linalg.matrix_rank(matrix) != len(matrix):
            return corners
        step = np.linalg.solve(matrix, -weighted @ brightness)
        contrast = step[-board.lights.shape[1] :]
        if not contrast.min() > 0.0:
            return corners
        now = now + step[:8].reshape(4, 2)
        if np.abs(now - corners).max() > max(_REACH * cell, 1.0) or not np.isfinite(now).all():
            return corners
        # Occluded parts of the board have large residuals and get small weights.
        weight = board.counted / (1.0 + ((unknown @ step + brightness) / (_DOUBT * (board.lights @ contrast))) ** 2)
        # cv2.remap interpolates at steps of 1/32 pixel.
        if np.abs(step[:8]).max() < 0.02:
            return now
    return corners


@dataclass(frozen=True)
class _Board:
    """What is fitted, at points of the marker and half a cell around it.

    Attributes:
        s, t: (p,) fractions of the square, from its upper left corner.
        template: (p,) T, the blurred pattern of the cells, 0 to 1.
        counted: (p,) 1 for points of cells that count.
        lights: (p, 1 or 2) 1 for the points of each light: in the sun and, if there is a shadow, in it.
        spread: standard deviation of the blur, pixels.
    """

    s: Float[np.ndarray, " p"]
    t: Float[np.ndarray, " p"]
    template: Float[np.ndarray, " p"]
    counted: Float[np.ndarray, " p"]
    lights: Float[np.ndarray, "p k"]
    spread: float


def _board(
    cells: Bool[np.ndarray, "n n"],
    known: Bool[np.ndarray, "n n"] | None,
    shaded: Bool[np.ndarray, "m m"] | None,
    cell: float,
) -> _Board:
    """Return what is fitted to cells of `cell` pixels; the other arguments are those of `refine_corners`."""
    fine = int(np.clip(np.ceil(cell / 2.0) * 2.0, 4, 8))  # points along a cell
    edge = fine // 2

    def at_points(values: np.ndarray) -> np.ndarray:
        return values[edge:-edge, edge:-edge].ravel()

    def enlarged(values: np.ndarray) -> np.ndarray:
        return np.kron(values, np.ones((fine, fine)))

    # Pattern and image are blurred until an edge is wider than the spacing of the points, so that any shift changes the
    # residual.
    spread = max(_SPREAD, cell / fine)
    pattern = enlarged(np.pad(cells, 1, constant_values=True)).astype(np.float32)
    blurred = opencv().GaussianBlur(pattern, (0, 0), spread * fine / cell, borderType=opencv().BORDER_REPLICATE)
    fraction = (np.arange(edge, len(pattern) - edge) + 0.5 - fine) / (len(cells) * fine)
    s, t = (axis.ravel() for axis in np.meshgrid(fraction, fraction))
    counted = np.ones_like(s) if known is None else at_points(enlarged(np.pad(known, 1, constant_values=True)))
    lights = np.ones((len(s), 1))
    if shaded is not None and shaded.any() and not shaded.all():
        dark = at_points(enlarged(shaded))
        lights = np.stack([1.0 - dark, dark], -1)
    return _Board(s, t, at_points(blurred).astype(np.float64), counted, lights, spread)


def _window(
    grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], around: float
) -> tuple[Float[np.ndarray, "u v"], Int[np.ndarray, "2"]]:
    """Return the part of the image up to `around` pixels from the corners, and the pixel of its first value."""
    low = np.maximum(np.floor(corners.min(0) - around), 0).astype(int)
    high = np.maximum(np.ceil(corners.max(0) + around), low + 1).astype(int)
    return grey[low[1] : high[1], low[0] : high[0]].astype(np.float32), low


def _as_blurred(window: Float[np.ndarray, "u v"], spread: float) -> Float[np.ndarray, "u v"]:
    """Return the image with the blur of `spread`: what lens and pixels lack of it is added."""
    if spread <= 1.1 * _SPREAD:
        return window
    lacking = float(np.sqrt(spread**2 - _SPREAD**2))
    return opencv().GaussianBlur(window, (0, 0), lacking, borderType=opencv().BORDER_REPLICATE)


def _equations(
    board: _Board,
    picture: Float[np.ndarray, "u v"],
    low: Int[np.ndarray, "2"],
    now: Float[np.ndarray, "4 2"],
) -> tuple[Float[np.ndarray, "p k"], Float[np.ndarray, " p"]]:
    """Return the linear equations of a step, unknown @ step + brightness = 0.

    The unknowns are shifts of the four corners `now`, brightness and contrast of each light; `brightness` is the
    image at the points.
    """
    cv2 = opencv()
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], np.float32)
    image_from_square = cv2.getPerspectiveTransform(square, now.astype(np.float32))
    top = image_from_square @ np.stack([board.s, board.t, np.ones_like(board.s)])
    pixels = top[:2] / top[2]
    u, v = (pixels - low[:, None] - 0.5).astype(np.float32)

    def seen(du: float, dv: float) -> np.ndarray:
        moved = u + np.float32(du), v + np.float32(dv)
        found = cv2.remap(picture, *moved, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return found.ravel().astype(np.float64)

    # The image's gradient, from half a pixel to either side.
    slope = np.stack([seen(0.5, 0.0) - seen(-0.5, 0.0), seen(0.0, 0.5) - seen(0.0, -0.5)])
    # Derivatives of a point's pixel by the eight entries of the homography, and of these by the corners.
    moves = _homography_slopes(board.s, board.t, pixels) / top[2]
    at_corners = (
        _homography_slopes(square[:, 0], square[:, 1], now.T)
        / (image_from_square @ np.vstack([square.T, np.ones(4)]))[2]
    )
    by_corner = np.linalg.inv(at_corners.transpose(2, 0, 1).reshape(8, 8))
    along = np.einsum("cp,ckp->pk", slope, moves) @ by_corner
    unknown = np.column_stack([along, -board.lights, -board.template[:, None] * board.lights])
    return unknown, seen(0.0, 0.0)


def _homography_slopes(
    s: Float[np.ndarray, " p"], t: Float[np.ndarray, " p"], pixels: Float[np.ndarray, "2 p"]
) -> Float[np.ndarray, "2 8 p"]:
    """Return derivatives of the pixel of (s, t) by a homography's first eight entries, times its third coordinate."""
    one, none = np.ones(len(s)), np.zeros(len(s))
    u, v = pixels
    return np.array(
        [
            [s, t, one, none, none, none, -u * s, -u * t],
            [none, none, none, s, t, one, -v * s, -v * t],
        ]
    )

"""Refining the corners of a marker by fitting its printed cells to the image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

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
    cv2 = opencv()
    n = len(cells)
    cell = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1).mean() / n
    # Points as fractions of the square, from its upper left corner; the blur in points.
    fine = int(np.clip(np.ceil(cell / 2.0) * 2.0, 4, 8))
    board = np.kron(np.pad(cells, 1, constant_values=True), np.ones((fine, fine))).astype(np.float32)
    # Both are blurred until an edge is wider than the spacing of the points, so that any shift changes the residual.
    spread = max(_SPREAD, cell / fine)
    blurred = cv2.GaussianBlur(board, (0, 0), spread * fine / cell, borderType=cv2.BORDER_REPLICATE)
    edge = fine // 2
    template = blurred[edge:-edge, edge:-edge].ravel().astype(np.float64)
    fraction = (np.arange(edge, (n + 2) * fine - edge) + 0.5 - fine) / (n * fine)
    s, t = (axis.ravel() for axis in np.meshgrid(fraction, fraction))
    points = np.stack([s, t, np.ones_like(s)])
    around = 3.0 * spread + 2.0 * cell
    low = np.maximum(np.floor(corners.min(0) - around), 0).astype(int)
    high = np.maximum(np.ceil(corners.max(0) + around), low + 1).astype(int)
    picture = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if not picture.size:
        return corners
    if spread > 1.1 * _SPREAD:
        extra = float(np.sqrt(spread**2 - _SPREAD**2))
        picture = cv2.GaussianBlur(picture, (0, 0), extra, borderType=cv2.BORDER_REPLICATE)
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], np.float32)
    # 1 for the points of each light: two columns of unknowns.
    lights = np.ones((len(s), 1))
    if shaded is not None and shaded.any() and not shaded.all():
        dark = np.kron(shaded, np.ones((fine, fine)))[edge:-edge, edge:-edge].ravel()
        lights = np.stack([1.0 - dark, dark], -1)
    counted = np.ones_like(s)
    if known is not None:
        counted = np.kron(np.pad(known, 1, constant_values=True), np.ones((fine, fine)))[edge:-edge, edge:-edge].ravel()
    now, weight = corners.astype(np.float64), counted
    for _ in range(_STEPS):
        # The image and its gradient, at the points and at half a pixel to either side.
        image_from_square = cv2.getPerspectiveTransform(square, now.astype(np.float32))
        top = image_from_square @ points
        pixels = top[:2] / top[2]
        u, v = (pixels - low[:, None] - 0.5).astype(np.float32)

        def seen(du: float, dv: float, u: np.ndarray = u, v: np.ndarray = v) -> np.ndarray:
            return (
                cv2.remap(
                    picture, u + np.float32(du), v + np.float32(dv), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
                .ravel()
                .astype(np.float64)
            )

        slope = np.stack([seen(0.5, 0.0) - seen(-0.5, 0.0), seen(0.0, 0.5) - seen(0.0, -0.5)])
        # Derivatives of a point's pixel by the eight entries of the homography, and of these by the corners.
        moves = _homography_slopes(s, t, pixels) / top[2]
        at_corners = (
            _homography_slopes(square[:, 0], square[:, 1], now.T)
            / (image_from_square @ np.vstack([square.T, np.ones(4)]))[2]
        )
        by_corner = np.linalg.inv(at_corners.transpose(2, 0, 1).reshape(8, 8))
        along = np.einsum("cp,ckp->pk", slope, moves) @ by_corner
        unknown = np.column_stack([along, -lights, -template[:, None] * lights])
        brightness = seen(0.0, 0.0)
        weighted = (unknown * weight[:, None]).T
        matrix = weighted @ unknown
        if np.linalg.matrix_rank(matrix) != len(matrix):
            return corners
        step = np.linalg.solve(matrix, -weighted @ brightness)
        contrast = step[-lights.shape[1] :]
        if not contrast.min() > 0.0:
            return corners
        now = now + step[:8].reshape(4, 2)
        if np.abs(now - corners).max() > max(_REACH * cell, 1.0) or not np.isfinite(now).all():
            return corners
        # Occluded parts of the board have large residuals and get small weights.
        weight = counted / (1.0 + ((unknown @ step + brightness) / (_DOUBT * (lights @ contrast))) ** 2)
        # cv2.remap interpolates at steps of 1/32 pixel.
        if np.abs(step[:8]).max() < 0.02:
            return now
    return corners


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

"""Flat patterns in space, such as the cells of a fiducial marker, drawn in perspective.

Pixels are supersampled: each one gets the mean of the pattern and of the background within it, so that a distant
pattern fades without aliasing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.world.render.camera import NEAR, PinholeCamera

# Samples per pixel along each side, least and most; target number of samples of a small pattern, and largest number of
# samples of a large one.
_COARSE, _FINE, _LOOKS, _MOST = 4, 32, 300_000, 4_000_000


def paint_picture(
    image: UInt8[np.ndarray, "h w 3"],
    corners: Float[np.ndarray, "4 3"],
    picture: Float[np.ndarray, "r c"],
    camera: PinholeCamera,
    tones: Float[np.ndarray, "2 3"],
) -> None:
    """Draw a pattern in perspective, in place; one that reaches nearer than `NEAR` is skipped.

    Args:
        image: drawn so far.
        corners: of a parallelogram in the ego frame, metres: lower left, lower right, upper right, upper left as seen
            from the front.
        picture: 0 to 1, top row first.
        camera: of the image.
        tones: display colours of 0 and of 1, 0 to 255.
    """
    pixels, depth = camera.image_of(corners)
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(0)), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)), 0, size).astype(int)
    if depth.min() <= NEAR or (high <= low).any():
        return
    (left, top), (right, bottom) = low, high
    area = (right - left) * (bottom - top)
    fine = int(np.clip(np.sqrt(_LOOKS / area), max(min(_COARSE, np.sqrt(_MOST / area)), 1), _FINE))
    # Homography from (s, t, 1), fractions of the way from the lower left corner to the right and up, to the pixel.
    spans = np.stack([corners[1] - corners[0], corners[3] - corners[0], corners[0]], -1)
    spans = camera.camera_from_ego[:3, :3] @ spans
    spans[:, 2] += camera.camera_from_ego[:3, 3]
    back = np.linalg.inv(camera.intrinsics @ spans)
    u = left + (np.arange(fine * (right - left)) + 0.5) / fine
    v = (top + (np.arange(fine * (bottom - top)) + 0.5) / fine)[:, None]
    across, up, scale = (((row[0] * u + row[2]) + row[1] * v).astype(np.float32) for row in back)
    across, up = across / scale, up / scale
    inside = (across >= 0.0) & (across < 1.0) & (up >= 0.0) & (up < 1.0)
    rows, columns = picture.shape
    row = np.where(inside, (1.0 - up) * rows, 0.0).astype(int).clip(0, rows - 1)
    column = np.where(inside, across * columns, 0.0).astype(int).clip(0, columns - 1)
    light = np.where(inside, picture[row, column], 0.0)
    fraction, light = (
        part.reshape(bottom - top, fine, right - left, fine).mean((1, 3))[..., None]
        for part in (inside.astype(np.float32), light.astype(np.float32))
    )
    behind = image[top:bottom, left:right]
    seen = (1.0 - fraction) * behind + (fraction - light) * tones[0] + light * tones[1]
    image[top:bottom, left:right] = np.round(np.clip(seen, 0.0, 255.0)).astype(np.uint8)

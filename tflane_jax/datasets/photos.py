"""A photograph of any size and camera, fitted to the view that LSTR was trained on: TuSimple's, 360 x 640 pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv, resize

HEIGHT, WIDTH = 360, 640
"""Size of the network's input, pixels (LSTR: Liu et al. 2021; docs/reference/lstr.md)."""

# TuSimple's camera, as fractions of its 1280 x 720 image. Horizon: median row in which the straight lines of a frame
# meet, over the 574 of 2,858 label records with three or more of them (row 238.7; 90 % within 227 to 249).
HORIZON = 0.331
# Assumed, not measured: 714 pixels of 1280, the calibration of TuSimple's velocity benchmark as others quote it.
# TuSimple publishes none for its lane images, and the labels do not determine it: flat straight lanes look alike at
# every focal length, and the dashes in the ten frames at hand are too faint to measure their period.
# The built-in world's front views are drawn with 900 to 1100 pixels (`world.render.camera`), which was not measured
# either.
FOCAL = 714.15 / 1280

# How far off the aspect of a view may be, a factor: 4:3 and 21:9 pass.
_ALIKE = 1.5
# If TuSimple's view is a smaller fraction of the photo's width than this, the focal length is in wrong units.
_LEAST_SEEN = 0.1


@dataclass(frozen=True)
class PhotoCamera:
    """What is known of the camera of a photo; None is unknown.

    Attributes:
        focal: focal length, pixels of this photo: its width times the focal length in millimetres over the sensor's
            width (36 mm for a "35 mm equivalent").
        horizon: row of the horizon, pixels.
        column: column straight ahead, pixels; the middle one where it is not known.
    """

    focal: float | None = None
    horizon: float | None = None
    column: float | None = None


@dataclass(frozen=True)
class Placement:
    """The part of a photo that the network sees, pixels.

    Attributes:
        left, top: its corner; `top` is negative where rows above the photo are seen, which are black.
        width, height: its size.
    """

    left: int
    top: int
    width: int
    height: int

    def to_photo(self, points: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Return points (u, v), fractions of the network's image, as columns and rows of the photo."""
        return np.asarray(points, np.float64) * (self.width, self.height) + (self.left, self.top)


class FittedPhoto(NamedTuple):
    """A photo as the network's input: image, valid pixels (all), and the placement that maps points back."""

    image: UInt8[np.ndarray, "360 640 3"]
    image_valid: Bool[np.ndarray, "360 640"]
    placement: Placement


def fit_photo(image: UInt8[np.ndarray, "h w 3"], camera: PhotoCamera | Placement | None = None) -> FittedPhoto:
    """Return the network's view of a photo of any size: what a camera tells, or a part of the photo.

    Without a camera the whole photo is stretched to the network's size, as by the reference. A known camera removes
    what TuSimple's camera would not have seen. A horizon cuts rows off the top, or adds black ones, until it has
    TuSimple's height. A focal length shorter than TuSimple's cuts the sides and, with a horizon, the bottom.

    The aspect is not kept. With the published LSTR weights on TuSimple frames cut to other shapes (ten frames, all seen
    in training), padding and cutting to 16:9 did worse than stretching in most shapes (1280 x 540 from the top:
    accuracy 0.71 padded, 0.90 with the sides cut, 0.93 stretched), and cutting above a known horizon did better than
    not in 8 of 9 (880 x 500: 0.97 against 0.92). A short focal length could not be tried in this way. Of frames whose
    upper 150 rows were cut off, 71 % of the labelled points were found without rows in their place, and 98 % with
    black ones; the colour made no difference.

    Reductions to less than half are averaged over areas, because thin lane paint would otherwise fall between pixels.

    Raises UserError for a photo without pixels, or camera numbers that cannot be pixels of this photo.
    """
    height, width = image.shape[:2]
    if not height or not width:
        raise UserError(f"a photo of {width} x {height} pixels shows nothing: give another")
    seen = camera if isinstance(camera, Placement) else _seen(height, width, camera or PhotoCamera())
    part = image[max(seen.top, 0) : seen.top + seen.height, seen.left : seen.left + seen.width]
    if seen.top < 0:
        part = np.pad(part, ((-seen.top, 0), (0, 0), (0, 0)))
    if seen.width > 2 * WIDTH or seen.height > 2 * HEIGHT:
        cv2 = opencv()
        fitted = cv2.resize(part, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    else:
        fitted = resize(part, HEIGHT, WIDTH)
    return FittedPhoto(fitted, np.ones((HEIGHT, WIDTH), bool), seen)


def _seen(height: int, width: int, camera: PhotoCamera) -> Placement:
    """Return the part of a photo that TuSimple's camera would have seen, as far as that is known."""
    columns, ahead = float(width), width / 2 if camera.column is None else camera.column
    if not 0.0 <= ahead <= width:
        raise UserError(f"the column straight ahead, {ahead:g}, is outside a photo {width} pixels wide")
    if camera.focal is not None:
        if not math.isfinite(camera.focal):
            raise UserError(f"a focal length of {camera.focal:g} is no number of pixels: leave it out if it is unknown")
        columns = camera.focal / FOCAL
        if not columns >= _LEAST_SEEN * width:
            raise UserError(
                f"a focal length of {camera.focal:g} pixels is too short for a photo {width} pixels wide: give "
                f"{width} x focal length / sensor width (36 mm for 35 mm equivalents)"
            )
    across = max(round(min(columns, width)), 1)
    left = round(min(max(ahead - across / 2, 0), width - across))

    top, bottom = 0, height
    if camera.horizon is not None:
        if 0.0 < camera.horizon <= 1.0:
            raise UserError(
                f"a horizon of {camera.horizon:g} is a fraction: give the row in pixels, such as "
                f"{camera.horizon * height:.0f} of a photo {height} pixels high"
            )
        if not 0.0 <= camera.horizon < height:
            side = "above" if camera.horizon < 0.0 else "below"
            raise UserError(f"the horizon, row {camera.horizon:g}, is {side} a photo {height} pixels high")
        if camera.focal is not None:
            below = (1.0 - HORIZON) * columns * HEIGHT / WIDTH  # rows that TuSimple's camera sees under its horizon
            bottom = round(min(max(camera.horizon + below, 1), height))
        top = min(round(camera.horizon - HORIZON / (1.0 - HORIZON) * (bottom - camera.horizon)), bottom - 1)
    return Placement(left, top, across, bottom - top)


def is_alike(width: int, height: int) -> bool:
    """Return whether an image has about TuSimple's aspect, 16:9; in squares and portraits all lanes are distorted."""
    return 1.0 / _ALIKE <= width * HEIGHT / (height * WIDTH) <= _ALIKE


def misfits(view: Placement, horizon: float) -> list[str]:
    """Return what makes a view with a known horizon (row of the photo) unlike TuSimple's; empty if nothing does."""
    if is_alike(view.width, view.height):
        return []
    return [f"the network sees {view.width} x {view.height} pixels, distorted to 16:9: is row {horizon:g} the horizon?"]

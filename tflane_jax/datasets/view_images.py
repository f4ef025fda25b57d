"""Camera images prepared for a model: cropped, resized and padded to one size, with intrinsics and boxes to match.

The presets are those of the published code: TopoNet (https://github.com/OpenDriveLab/TopoNet), OpenLane-V2's baseline
(https://github.com/OpenDriveLab/OpenLane-V2) and SMERF (https://github.com/NVlabs/SMERF).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv
from tflane_jax.geometry.cameras import crop_intrinsics, resize_intrinsics
from tflane_jax.limits import INCREASING, Count, CountOrZero, Factor


@dataclass(frozen=True)
class ImageConfig:
    """Cropping and scaling of the images of every frame, in this order.

    Attributes:
        front_rows: rows [first, last) of the front image that are kept; None keeps all.
        front_size: width and height to which the front image is stretched; None does not stretch it.
        scale: factor on width and height of every image, rounded down to whole pixels.
        divisor: width and height of the array that holds all images are multiples of it.
        shrink: how images become smaller than half their size: by averages over "area", or "bilinear", which skips
            pixels.
    """

    front_rows: Annotated[tuple[CountOrZero, Count], INCREASING] | None = None
    front_size: tuple[Count, Count] | None = None
    scale: Factor = 1.0
    divisor: Count = 32
    shrink: Literal["area", "bilinear"] = "area"


TOPONET_SUBSET_A = ImageConfig(front_rows=(356, 1906), scale=0.5)
"""TopoNet, LaneSegNet and TF-Lane on Argoverse 2: 7 images of 1024 x 775 (the front one 775 x 775) in 1024 x 800."""
LANESEGNET_BUCKET = ImageConfig(front_rows=(356, 1906), scale=0.33, shrink="bilinear")
"""LaneSegNet's map-element-bucket variant on Argoverse 2: 7 images of 675 x 511 (the front one 511 x 511), bilinear."""
TOPONET_SUBSET_B = ImageConfig(scale=0.5)
"""TopoNet on nuScenes: 6 images of 800 x 450 in 800 x 480."""
BASELINE_LARGE = ImageConfig(front_size=(2048, 1550))
"""OpenLane-V2's baseline and SMERF: 7 images of 2048 x 1550 in 2048 x 1568, the portrait one stretched to landscape."""


@dataclass(frozen=True)
class ImageFit:
    """Cropping and scaling of one camera's images.

    Attributes:
        source: width and height of the files, pixels.
        rows: rows [first, last) of the files that are kept.
        size: width and height of the result, pixels.
        shrink: see `ImageConfig`.
    """

    source: tuple[int, int]
    rows: tuple[int, int]
    size: tuple[int, int]
    shrink: Literal["area", "bilinear"] = "area"

    @property
    def scale(self) -> tuple[float, float]:
        """Factors on width and height."""
        return self.size[0] / self.source[0], self.size[1] / (self.rows[1] - self.rows[0])

    def image(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Return the resized image: bilinear, or area averages below half size."""
        cv2 = opencv()
        kind = cv2.INTER_AREA if self.shrink == "area" and min(self.scale) < 0.5 else cv2.INTER_LINEAR
        part = image[self.rows[0] : self.rows[1]]
        return part if part.shape[1::-1] == self.size else cv2.resize(part, self.size, interpolation=kind)

    def intrinsics(self, intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Return the intrinsics of the result."""
        return resize_intrinsics(crop_intrinsics(intrinsics, (0.0, float(self.rows[0]))), self.scale)

    def boxes(self, boxes: Float[np.ndarray, "e 2 2"]) -> Float[np.ndarray, "e 2 2"]:
        """Return boxes (top-left and bottom-right corners) in the result, clipped at its border.

        A box that lies wholly outside gets zero area. TopoNet's code clips no true box and drops only those above the
        rows that are kept; it clamps predicted boxes to the image, which are left as they are here.
        """
        return np.clip((boxes - (0.0, self.rows[0])) * self.scale, 0.0, self.size)

    def in_file(self, boxes: Float[np.ndarray, "e 2 2"]) -> Float[np.ndarray, "e 2 2"]:
        """Return boxes of the result in pixels of the file."""
        return boxes / self.scale + (0.0, self.rows[0])


def fit_image(width: int, height: int, config: ImageConfig, *, front: bool) -> ImageFit:
    """Return the cropping and scaling for a camera whose files have this size.

    Raises UserError if the files lack the rows to keep, or no pixel would remain.
    """
    rows = (0, height)
    if front and config.front_rows is not None:
        rows = config.front_rows
        if not 0 <= rows[0] < rows[1] <= height:
            raise UserError(
                f"ImageConfig.front_rows is {rows}, but front images have {height} rows: choose the preset of this "
                "dataset (None keeps all rows)"
            )
    stretched = config.front_size if front and config.front_size is not None else (width, rows[1] - rows[0])
    size = (int(stretched[0] * config.scale), int(stretched[1] * config.scale))
    if min(size) < 1:
        raise UserError(f"ImageConfig.scale = {config.scale} leaves nothing of an image of {width} x {height} pixels")
    return ImageFit((width, height), rows, size, config.shrink)


def canvas_size(sizes: list[tuple[int, int]], divisor: int) -> tuple[int, int]:
    """Return width and height of the array that holds images of these sizes."""
    width, height = (-(-max(sides) // divisor) * divisor for sides in zip(*sizes, strict=True))
    return width, height

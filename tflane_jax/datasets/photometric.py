"""Augmentation of multi-view images: photometric distortion, which every camera system of the papers trains with,
GridMask and random scaling.

Photometric distortion is mmdetection's `PhotoMetricDistortion` (brightness, contrast, saturation, hue, channel swap;
contrast before or after the colours), drawn for each view separately, as in BEVFormer
(https://github.com/fundamentalvision/BEVFormer). The originals work on unbounded floats; here images are uint8, so
values are clipped to 0 to 255. GridMask (Chen et al. 2020, https://arxiv.org/abs/2001.04086) has BEVFormer's setting:
squares without rotation, one mask for all views. Scaling has one factor for all views of a frame (`random_scale`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, UInt8

from tflane_jax.datasets.random_scale import scaled_example
from tflane_jax.files.images import opencv
from tflane_jax.limits import ASCENDING, Factor, Fraction, Range, within
from tflane_jax.scene import CameraViews, Example

# Colour of a hidden square: the mean of ImageNet, which normalisation turns into zero as in the original.
_HIDDEN = np.array([124, 116, 104], np.uint8)


@dataclass(frozen=True)
class PhotometricConfig:
    """Strength of the changes to the images of an example; the defaults keep their size.

    Attributes:
        probability: of brightness, contrast, saturation and hue, independently.
        brightness: maximum that is added to all channels, of 255.
        contrast: minimum and maximum factor on all channels.
        saturation: minimum and maximum factor.
        hue: maximum that is added, degrees.
        swap: probability of a random order of the channels.
        grid_mask: probability of a GridMask; papers that use one have 0.7.
        grid_ratio: fraction of the period that stays visible in either direction.
        scale: smallest and largest factor on width and height of all images of a frame.
    """

    probability: Fraction = 0.5
    brightness: Annotated[float, within(0, 255)] = 32.0
    contrast: Range = (0.5, 1.5)
    saturation: Range = (0.5, 1.5)
    hue: Annotated[float, within(0, 360)] = 18.0
    swap: Fraction = 0.5
    grid_mask: Fraction = 0.0
    grid_ratio: Fraction = 0.5
    scale: Annotated[tuple[Factor, Factor], ASCENDING] = (1.0, 1.0)


LANESEGNET_PHOTOMETRIC = PhotometricConfig(grid_mask=0.7)
"""LaneSegNet at the paper's size: photometric distortion, and one GridMask for all views."""
TOPONET_PHOTOMETRIC = LANESEGNET_PHOTOMETRIC
"""TopoNet at the paper's size has the same."""
LANESEGNET_BUCKET_PHOTOMETRIC = PhotometricConfig(probability=0.0, swap=0.0, grid_mask=0.7)
"""LaneSegNet's map-element-bucket variant: the GridMask alone."""
MAPTR_PHOTOMETRIC = LANESEGNET_PHOTOMETRIC
"""MapTR and MapTRv2 at the papers' size have the same.

The published MapTR distorts colours at 1600 x 900 pixels before it halves images, MapTRv2 after; here both do so after.
"""


def augment_example(example: Example, config: PhotometricConfig, seed: int | Sequence[int]) -> Example:
    """Return an example with its images changed at random; without cameras it is unchanged.

    Intrinsics and the boxes of traffic elements follow the scale of the images.
    """
    if example.cameras is None:
        return example
    # A stream after those of `augment_views`, whose numbers thereby do not depend on this one.
    *_, sizing = np.random.default_rng(seed).spawn(2 + len(example.cameras.valid))
    example = scaled_example(example, float(sizing.uniform(*config.scale)))
    assert example.cameras is not None
    return replace(example, cameras=augment_views(example.cameras, config, seed))


def augment_views(cameras: CameraViews, config: PhotometricConfig, seed: int | Sequence[int]) -> CameraViews:
    """Return images with colours changed and squares hidden at random; the same seed gives the same bits.

    Padding, sizes and calibration are unchanged.

    Args:
        cameras: numpy.
        config: strength of the changes.
        seed: an integer or several, such as (run seed, step, index).
    """
    masking, *colours = np.random.default_rng(seed).spawn(1 + len(cameras.valid))
    images = np.array(cameras.image)
    grid = draw_grid(config, masking, *images.shape[1:3])
    for image, rng, (width, height), valid in zip(images, colours, cameras.size, cameras.valid, strict=True):
        if not valid:
            continue
        part = distort(image[:height, :width], config, rng)
        if grid is not None:
            part[grid[:height, :width]] = _HIDDEN
        image[:height, :width] = part
    return replace(cameras, image=images)


def distort(
    image: UInt8[np.ndarray, "h w 3"], config: PhotometricConfig, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return one RGB image with its brightness, contrast, saturation, hue and channels changed at random (a copy)."""
    cv2 = opencv()
    # All random numbers are drawn in every case, so that a setting changes only its own effect.
    with_brightness, with_contrast, with_saturation, with_hue = rng.uniform(size=4) < config.probability
    contrast_first = rng.uniform() < 0.5
    swapped = rng.uniform() < config.swap
    brightness = rng.uniform(-config.brightness, config.brightness)
    contrast = rng.uniform(*config.contrast)
    saturation = rng.uniform(*config.saturation)
    hue = rng.uniform(-config.hue, config.hue)
    order = rng.permutation(3)

    out = image.astype(np.float32)
    if with_brightness:
        out += np.float32(brightness)
    if with_contrast and contrast_first:
        out *= np.float32(contrast)
    if with_saturation or with_hue:
        # Hue in degrees, saturation 0 to 1. Negative values have no hue.
        colour = cv2.cvtColor(np.maximum(out, 0.0), cv2.COLOR_RGB2HSV)
        if with_saturation:
            colour[..., 1] = np.minimum(colour[..., 1] * np.float32(saturation), 1.0)
        if with_hue:
            # OpenCV wraps hues above 360 degrees, but not negative ones; np.mod would take as long as all other steps.
            colour[..., 0] += np.float32(hue % 360.0)
        out = cv2.cvtColor(colour, cv2.COLOR_HSV2RGB)
    if with_contrast and not contrast_first:
        out *= np.float32(contrast)
    if swapped:
        out = out[..., order]
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def draw_grid(
    config: PhotometricConfig, rng: np.random.Generator, height: int, width: int
) -> Bool[np.ndarray, "h w"] | None:
    """Return which pixels a grid of squares hides, or None for no grid.

    The period is between 2 pixels and the image's height. Visible stripes of rows and of columns begin once a period,
    as many as fit into 1.5 times the image; a pixel is hidden if it is in no stripe of either kind. As in TopoNet's
    code, a long period leaves rows before the first stripe or behind the last one.
    """
    chance, length, row, column = rng.uniform(size=4)
    if chance >= config.grid_mask or height < 3:
        return None
    period = 2 + int(length * (height - 2))
    kept = min(max(int(period * config.grid_ratio + 0.5), 1), period - 1)
    rows, columns = (
        _between_stripes(size, period, kept, int(start * period)) for size, start in ((height, row), (width, column))
    )
    return rows[:, None] & columns


def _between_stripes(size: int, period: int, kept: int, start: int) -> Bool[np.ndarray, " size"]:
    """Return which of `size` pixels lie in no stripe; the stripes begin at `start` in 1.5 times the size, centered."""
    whole = int(1.5 * size)
    at = np.arange(size) + (whole - size) // 2 - start
    return (at < 0) | (at >= whole // period * period) | (at % period >= kept)

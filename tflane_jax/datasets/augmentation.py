"""Random augmentation of road images: geometry, colour and lighting, by default LSTR's recipe.

Runs on the host with numpy and OpenCV: all geometry, with a change of size, is one affine warp, all colour one affine
map of RGB. The content of padding never reaches the result; pixels that the warp does not cover are black and invalid.
Source: the training settings of LSTR, https://github.com/liuruijin17/LSTR. It rotates and crops the full frame, then
resizes it. What still differs:

- one bilinear warp, where imgaug rotates and crops bilinearly and then reduces bicubically;
- colours are clipped to 0 to 255; padding stays black and does not enter the mean grey of the contrast;
- a line ends at its last labelled point in the image and is dropped if only one is left. imgaug adds points at the
  border, and splits a line that leaves the image and comes back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.files.images import opencv
from tflane_jax.limits import Factor, Fraction, PositiveOrZero, within
from tflane_jax.scene import LaneLines, RoadImage

Seed = int | Sequence[int]

GREY = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in grey (ITU-R BT.601, as in OpenCV)."""

# Principal components of the colours of natural images in [0, 1] (Krizhevsky et al. 2012), with CornerNet's numbers.
# Rows are red, green, blue; the reference has the opposite order, because its images are BGR.
PCA_VALUES = np.array([0.2141788, 0.01817699, 0.00341571])
PCA_VECTORS = np.array(
    [
        [-0.56089297, 0.71832671, 0.41158938],
        [-0.5832747, 0.00994535, -0.81221408],
        [-0.58752847, -0.69563484, 0.41340352],
    ]
)


@dataclass(frozen=True)
class AugmentationConfig:
    """Strength of each augmentation; the defaults are LSTR's recipe.

    Attributes:
        geometry: probability of rotation, flip and crop.
        rotation: maximum rotation about the center to either side, radians.
        flip: probability of a mirror image, given that geometry is applied.
        crop: fraction of height and width that is cut out anywhere in the image and enlarged to its size.
        brightness, contrast, saturation: maximum change of each factor from 1; they are applied in random order.
        lighting: standard deviation of the change along the principal components of colour.
    """

    geometry: Fraction = 10 / 11
    rotation: Annotated[float, within(0, math.pi)] = math.radians(10.0)
    flip: Fraction = 0.5
    crop: Factor = 0.9
    brightness: Fraction = 0.4
    contrast: Fraction = 0.4
    saturation: Fraction = 0.4
    lighting: PositiveOrZero = 0.1


def augment(
    example: RoadImage, config: AugmentationConfig, seed: Seed, size: tuple[int, int] | None = None
) -> RoadImage:
    """Return one example with random changes; the same seed gives the same bits.

    Points that leave the image become invalid. Rows stay ascending within a line; where a strong rotation bends one
    back to rows that it had, its far part is left out. Lines stay sorted from left to right by their first point. A
    line of several points of which the warp leaves one or none is dropped.

    Args:
        example: numpy.
        config: strength of the changes.
        seed: an integer or several, such as (run seed, epoch, index).
        size: height and width of the result, pixels; None for those of the example. Give examples at the size of the
            camera, not resized before: a second interpolation blurs.
    """
    geometry, colour = np.random.default_rng(seed).spawn(2)
    given = example.image_valid.shape
    warp = draw_warp(config, geometry, *given)
    if warp is not None or size not in (None, given):
        example = warp_example(example, warp, given if size is None else size)
    factors, order = _draw_jitter(config, colour)
    light = PCA_VECTORS @ (PCA_VALUES * colour.normal(scale=config.lighting, size=3))
    if not (factors == 1.0).all() or light.any():
        example = replace(example, image=_recoloured(example, factors, order, light))
    return example


def draw_warp(
    config: AugmentationConfig, rng: np.random.Generator, height: int, width: int
) -> Float[np.ndarray, "3 3"] | None:
    """Return a random affine map of the image onto itself, or None for no change.

    It maps columns and rows of the old image to those of the new, pixels, (0, 0) the outer corner of the first pixel.
    """
    chance, turn, mirror, left, top = rng.uniform(size=5)
    if chance >= config.geometry:
        return None
    angle = config.rotation * (2.0 * turn - 1.0)
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = width / 2.0, height / 2.0
    rotate = np.array([[cos, -sin, x - cos * x + sin * y], [sin, cos, y - sin * x - cos * y], [0.0, 0.0, 1.0]])
    flip = np.eye(3)
    if mirror < config.flip:
        flip = np.array([[-1.0, 0.0, width], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    x_cut, y_cut = left * (1.0 - config.crop) * width, top * (1.0 - config.crop) * height
    crop = np.array([[1.0, 0.0, -x_cut], [0.0, 1.0, -y_cut], [0.0, 0.0, config.crop]]) / config.crop
    warp = crop @ flip @ rotate
    return None if (warp == np.eye(3)).all() else warp


def warp_example(example: RoadImage, warp: Float[np.ndarray, "3 3"] | None, size: tuple[int, int]) -> RoadImage:
    """Return an example under an affine map as `draw_warp` gives it, at another size (bilinear; padding is black)."""
    cv2 = opencv()
    height, width = example.image_valid.shape
    lines = example.lines if warp is None else warp_lines(example.lines, warp, height, width)
    resized = np.diag([size[1] / width, size[0] / height, 1.0]) @ (np.eye(3) if warp is None else warp)
    # OpenCV counts from the center of the first pixel, and reads the map from the new image to the old.
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    inverse = (np.linalg.inv(half) @ np.linalg.inv(resized) @ half)[:2]
    seen = np.asarray(example.image_valid, np.uint8)
    image = np.ascontiguousarray(example.image)
    if not seen.all():
        image = cv2.bitwise_and(image, image, mask=seen)
    columns_rows, flags = size[::-1], cv2.WARP_INVERSE_MAP
    # OpenCV 5 warps four channels in less than half the time of three, to the same bits.
    image = cv2.warpAffine(
        cv2.cvtColor(image, cv2.COLOR_RGB2RGBA), inverse, columns_rows, flags=flags | cv2.INTER_LINEAR
    )
    image = cv2.cvtColor(image, cv2.COLOR_RGBA2RGB)
    seen = cv2.warpAffine(seen, inverse, columns_rows, flags=flags | cv2.INTER_NEAREST)
    image = cv2.bitwise_and(image, image, mask=seen)
    return RoadImage(image, seen.astype(bool), lines)


def warp_lines(lines: LaneLines, warp: Float[np.ndarray, "3 3"], height: int, width: int) -> LaneLines:
    """Return lines under an affine map of the image's pixels; see `augment` for dropped and sorted points."""
    size = np.array([width, height], np.float64)
    before = np.asarray(lines.point_valid & lines.valid[:, None])
    points = np.where(before[..., None], lines.points, 0.0).astype(np.float64)
    points = ((points * size) @ warp[:2, :2].T + warp[:2, 2]) / size
    valid = before & ((points >= 0.0) & (points <= 1.0)).all(-1)

    # Strong rotations can swap the rows of points: sort the valid ones among their own places.
    valid = _before_the_bend(points[..., 1], valid)
    places = np.argsort(~valid, axis=-1, kind="stable")
    order = np.argsort(np.where(valid, points[..., 1], np.inf), axis=-1, kind="stable")
    arranged = np.zeros_like(points)
    np.put_along_axis(arranged, places[..., None], np.take_along_axis(points, order[..., None], 1), 1)
    points = np.where(valid[..., None], arranged, 0.0)

    enough = np.minimum(before.sum(-1), 2)
    kept = np.asarray(lines.valid) & valid.any(-1) & (valid.sum(-1) >= enough)
    first = points[np.arange(len(kept)), valid.argmax(-1), 0] if points.shape[1] else np.zeros(len(kept))
    across = np.argsort(np.where(kept, first, np.inf), kind="stable")
    kept, valid, points = kept[across], valid[across], points[across]
    valid &= kept[:, None]
    return LaneLines(np.where(valid[..., None], points, 0.0).astype(np.float32), valid, kept)


def _before_the_bend(row: Float[np.ndarray, "l p"], valid: Bool[np.ndarray, "l p"]) -> Bool[np.ndarray, "l p"]:
    """Return which valid points to keep: from a line's last point, the nearest to the vehicle, back to the first bend.

    At a bend the rows begin to run against those at the line's end. Beyond it the line would have a second point in
    rows that it already has, which `LaneLines` cannot hold.
    """
    places = np.argsort(~valid, axis=-1, kind="stable")  # the valid points first, in their order
    step = np.diff(np.take_along_axis(row, places, -1))  # in rows, to the next point
    count = valid.sum(-1, keepdims=True)
    last_step = np.take_along_axis(step, np.maximum(count - 2, 0), -1) if step.size else 0.0
    bends = (np.arange(step.shape[-1]) < count - 1) & (step * last_step < 0.0)
    beyond = np.logical_or.accumulate(bends[:, ::-1], -1)[:, ::-1]
    before_last = places[:, :-1]
    kept = valid.copy()
    np.put_along_axis(kept, before_last, np.take_along_axis(valid, before_last, -1) & ~beyond, -1)
    return kept


def colour_map(
    factors: Float[np.ndarray, "3"], order: Sequence[int], light: Float[np.ndarray, "3"], mean_grey: float
) -> Float[np.ndarray, "3 4"]:
    """Return brightness, contrast, saturation (0, 1, 2, in `order`) and lighting as one affine map of RGB in [0, 1].

    As in the reference, contrast blends with the mean grey of the original image and saturation with the original
    grey, whatever came before.

    Args:
        factors: alpha of brightness, contrast and saturation.
        order: of application.
        light: added at the end.
        mean_grey: of the original image, in [0, 1].
    """
    blended = np.zeros((3, 3, 4))  # each factor blends with: nothing, mean grey, grey
    blended[1, :, 3] = mean_grey
    blended[2, :, :3] = GREY
    colour = np.eye(3, 4)
    for kind in order:
        colour = factors[kind] * colour + (1.0 - factors[kind]) * blended[kind]
    colour[:, 3] += light
    return colour


def _draw_jitter(config: AugmentationConfig, rng: np.random.Generator) -> tuple[Float[np.ndarray, "3"], list[int]]:
    spread = np.array([config.brightness, config.contrast, config.saturation])
    return 1.0 + spread * rng.uniform(-1.0, 1.0, 3), rng.permutation(3).tolist()


def _recoloured(example: RoadImage, factors: np.ndarray, order: Sequence[int], light: np.ndarray) -> np.ndarray:
    """Return the image under a colour map, rounded and clipped to uint8, black where it is not valid."""
    cv2 = opencv()
    image = np.ascontiguousarray(example.image)
    seen = np.asarray(example.image_valid, np.uint8)
    whole = bool(seen.all())
    if not whole:
        image = cv2.bitwise_and(image, image, mask=seen)
    # Padding is black, so that the sum over all pixels is that over the valid ones; OpenCV's mean under a mask is slow.
    grey = float(GREY @ cv2.sumElems(image)[:3]) / max(cv2.countNonZero(seen), 1)
    colour = colour_map(factors, order, light, grey / 255.0)
    colour[:, 3] *= 255.0
    image = cv2.transform(image, colour)
    return image if whole else cv2.bitwise_and(image, image, mask=seen)

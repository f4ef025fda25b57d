"""Scaling of the images of a training example; its arrays keep their size, so that nothing is compiled again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.view_images import ImageFit
from tflane_jax.scene import CameraViews, Example


def scaled_example(example: Example, factor: float) -> Example:
    """Return an example with all images, their intrinsics and the boxes of traffic elements scaled.

    Images stay in the top-left corner of their arrays, and padding becomes 0.

    Args:
        example: numpy, one frame.
        factor: on width and height, above 0 and at most 1; 1, or an example without cameras, changes nothing.
    """
    cameras, elements = example.cameras, example.traffic_elements
    if cameras is None or factor == 1.0:
        return example
    sizes = np.asarray(cameras.size)
    fits = {number: _fit(sizes[number], factor) for number in np.flatnonzero(cameras.valid).tolist()}
    if elements is not None and 0 in fits:
        box = np.asarray(elements.box)
        elements = replace(elements, box=fits[0].boxes(box).astype(box.dtype))
    return replace(example, cameras=_scaled(cameras, fits, factor), traffic_elements=elements)


def _fit(size: np.ndarray, factor: float) -> ImageFit:
    width, height = size.tolist()
    columns, rows = (max(1, round(side * factor)) for side in (width, height))
    return ImageFit((width, height), (0, height), (columns, rows))


def _scaled(cameras: CameraViews, fits: dict[int, ImageFit], factor: float) -> CameraViews:
    shown = np.asarray(cameras.image)
    image, size, intrinsics = np.zeros_like(shown), np.array(cameras.size), np.array(cameras.intrinsics)
    for number, fit in fits.items():
        columns, rows = fit.size
        image[number, :rows, :columns] = fit.image(shown[number, :, : fit.source[0]])
        size[number], intrinsics[number] = fit.size, fit.intrinsics(intrinsics[number])
    depth, known = cameras.depth, cameras.depth_valid
    if depth is not None and known is not None:
        depth, known = _scaled_depth(np.asarray(depth), np.asarray(known), factor)
    return replace(cameras, image=image, size=size, intrinsics=intrinsics, depth=depth, depth_valid=known)


def _scaled_depth(
    depth: Float[np.ndarray, "v h w"], valid: Bool[np.ndarray, "v h w"], factor: float
) -> tuple[Float[np.ndarray, "v h w"], Bool[np.ndarray, "v h w"]]:
    """Return the depth that the middle of each cell had before; cells beyond the scaled images have none."""
    rows, columns = (np.floor((np.arange(side) + 0.5) / factor).astype(int) for side in depth.shape[1:])
    inside = (rows < depth.shape[1])[:, None] & (columns < depth.shape[2])
    taken = np.ix_(range(len(depth)), rows.clip(max=depth.shape[1] - 1), columns.clip(max=depth.shape[2] - 1))
    known = valid[taken] & inside
    return np.where(known, depth[taken], 0.0).astype(depth.dtype), known

"""Native images of a drive at the sizes that a trained model reads."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from tflane_jax.datasets.sources import source_of
from tflane_jax.datasets.view_images import ImageFit, canvas_size, fit_image
from tflane_jax.errors import UserError
from tflane_jax.files.images import opencv
from tflane_jax.scene import CameraViews
from tflane_jax.world.cameras.ring import CameraRigConfig


class CameraNamesWarning(UserWarning):
    """The cameras of a drive have other names than those of a model."""


def camera_names(source: Any) -> tuple[str, ...]:
    """Return the cameras that a model reads which was trained on this source, in order; none for BEV evidence."""
    if getattr(source, "image", None) is not None:
        return source_of(source).cameras(source) or ()
    rig = source.example.cameras
    return () if rig is None else tuple(mount.name for mount in rig.cameras)


def check_camera_names(names: Sequence[str], source: Any) -> None:
    """Raise UserError for the cameras of a model in another order, which would be taken for each other.

    Warns (`CameraNamesWarning`) of as many other names, whose order only the user knows.
    """
    wanted = camera_names(source)
    if tuple(names) == wanted or len(names) != len(wanted):  # their number is checked with the images
        return
    if sorted(names) == sorted(wanted):
        raise UserError(
            f"the drive has the cameras {', '.join(names)}, the model reads them as {', '.join(wanted)}: give them in "
            "this order"
        )
    warnings.warn(
        f"the drive's cameras {', '.join(names)} are taken for the model's {', '.join(wanted)}, in this order",
        CameraNamesWarning,
        stacklevel=2,
    )


def fitted_views(views: CameraViews, source: Any) -> CameraViews:
    """Return the images scaled for a model that was trained on this source, smaller ones padded.

    Args:
        views: native images; cameras in the order of the source's.
        source: configuration of a split: of the built-in world with cameras, or one with an `ImageConfig` (`image`).

    Raises UserError for a source without cameras, another number of cameras, images of another shape, or cameras none
    of which has a known size.
    """
    image = getattr(source, "image", None)
    if image is not None:
        _check_cameras(views, camera_names(source))
        sizes = np.asarray(views.size).tolist()
        # Cameras without an image have their place in the array too, whose shape is the same in every frame.
        fits = [
            fit_image(width, height, image, front=place == 0) if width else None
            for place, (width, height) in enumerate(sizes)
        ]
        known = [fit.size for fit in fits if fit is not None]
        if not known:
            raise UserError("a frame has no image of any camera: leave such frames out of the drive")
        return _scaled(views, fits, *canvas_size(known, image.divisor), lambda fit, native: fit.image(native))
    rig = source.example.cameras
    if rig is None:
        raise UserError(
            "the model reads BEV evidence, which images do not give: take a model with cameras, such as "
            "markers/cameras, or leave --model out"
        )
    return _of_rig(views, rig)


def _check_cameras(views: CameraViews, names: Sequence[str]) -> None:
    if len(views.valid) != len(names):
        raise UserError(
            f"the model was trained with {len(names)} cameras ({', '.join(names)}), the drive has {len(views.valid)}: "
            "give images of the same cameras, in this order (tflane markers render: --ring and --cameras)"
        )


def _of_rig(views: CameraViews, rig: CameraRigConfig) -> CameraViews:
    _check_cameras(views, tuple(mount.name for mount in rig.cameras))
    fits: list[ImageFit | None] = []
    for number, mount in enumerate(rig.cameras):
        width, height = np.asarray(views.size)[number].tolist()
        if not width:  # no image, and none seen before
            fits.append(None)
            continue
        scale, (most_wide, most_high) = round(mount.width * rig.scale) / width, rig.size(mount)
        size = round(width * scale), round(height * scale)
        if size[0] > most_wide or size[1] > most_high:
            raise UserError(
                f"images of camera {mount.name} are {width} x {height} pixels, which does not fit the shape of the "
                f"model's, {mount.width} x {mount.height}: crop them first"
            )
        fits.append(ImageFit((width, height), (0, height), size))
    wide, high = (max(rig.size(mount)[axis] for mount in rig.cameras) for axis in (0, 1))
    return _scaled(views, fits, wide, high, _averaged)


def _averaged(fit: ImageFit, native: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Return a resized image as the built-in world draws it: a lane line a pixel wide must not fall between samples."""
    return opencv().resize(native, fit.size, interpolation=opencv().INTER_AREA)


def _scaled(
    views: CameraViews,
    fits: Sequence[ImageFit | None],
    width: int,
    height: int,
    resize: Callable[[ImageFit, UInt8[np.ndarray, "h w 3"]], UInt8[np.ndarray, "height width 3"]],
) -> CameraViews:
    count = len(fits)
    out = CameraViews(
        image=np.zeros((count, height, width, 3), np.uint8),
        size=np.zeros((count, 2), np.int32),
        intrinsics=np.asarray(views.intrinsics).copy(),
        camera_from_ego=np.asarray(views.camera_from_ego),
        valid=np.asarray(views.valid),
    )
    for number, fit in enumerate(fits):
        if fit is None or not views.valid[number]:
            continue
        columns, rows = np.asarray(views.size)[number].tolist()
        native = np.asarray(views.image)[number, :rows, :columns]
        out.image[number, : fit.size[1], : fit.size[0]] = resize(fit, native)
        out.size[number] = fit.size
        out.intrinsics[number] = fit.intrinsics(np.asarray(views.intrinsics, np.float64)[number])
    return out

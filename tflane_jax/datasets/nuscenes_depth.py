"""Depth of the camera images from the lidar's sweep of a nuScenes sample, by the rules of MapTRv2.

A point goes from the lidar through the vehicle's poses at the sweep and at a camera's exposure into the image, whatever
pose the images themselves take (`nuscenes_cameras.CameraPoses`). Of the points in a cell, the nearest one counts.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.datasets.nuscenes_cameras import sample_cameras
from tflane_jax.datasets.nuscenes_tables import LIDAR, Row, Tables
from tflane_jax.errors import UserError
from tflane_jax.files.fields import file_within
from tflane_jax.geometry import invert_pose, transform_points
from tflane_jax.scene import CameraViews

# Numbers of a point: x, y, z, intensity, ring.
_NUMBERS = 5
# Points nearer to a camera, in metres, are on the vehicle itself; MapTRv2's first depth bin begins here.
_NEAREST = 1.0


def read_sweep(path: Path) -> Float[np.ndarray, "n 3"]:
    """Return the points (x, y, z) of a sweep (`.pcd.bin`: x, y, z, intensity, ring, float32), metres, lidar's frame.

    Raises UserError where the file is missing, is cut off, or holds numbers that are not finite.
    """
    if not path.is_file():
        raise UserError(
            f"{path} is missing, from which images get their depth (data.depth_cell): restore the sweeps of the key "
            "frames, or train without depth: data.depth_cell=None and task.model.encoder.bev.supervised=False"
        )
    size, point = path.stat().st_size, 4 * _NUMBERS
    if size == 0 or size % point:
        raise UserError(f"{path} has {size} bytes, which are not whole points of {point}: restore the original file")
    points = np.fromfile(path, "<f4").reshape(-1, _NUMBERS)[:, :3].astype(np.float64)
    finite = np.isfinite(points).all(-1)
    if not finite.all():
        raise UserError(f"{path}: point {int(finite.argmin())} is not finite: restore the original file")
    return points


def with_depth(
    tables: Tables, sample: Row, global_from_ego: Float[np.ndarray, "4 4"], views: CameraViews, cell: int
) -> CameraViews:
    """Return the images of a sample with the depth that its sweep gives them.

    Args:
        tables: of the data set.
        sample: a key frame.
        global_from_ego: the vehicle's whole pose at the moment of the lidar.
        views: images of the sample, in the order of `nuscenes_cameras.CAMERAS`.
        cell: side of the square cells, pixels.

    Raises:
        UserError: the sweep cannot be read, see `read_sweep`.
    """
    row = tables.sensor_file(sample, LIDAR)
    where = f"{tables.where('sample_data', row['token'])}: filename"
    points = read_sweep(file_within(tables.root, row["filename"], where))
    points = transform_points(tables.calibration(sample), points)
    views = without_depth(views, cell)
    depth, valid = np.asarray(views.depth), np.asarray(views.depth_valid)
    for number, camera in enumerate(sample_cameras(tables, sample, global_from_ego)):
        if camera is not None and views.valid[number]:
            local = transform_points(invert_pose(camera.ego_from_camera), points)
            size = (int(views.size[number, 0]), int(views.size[number, 1]))
            depth[number], valid[number] = nearest_depth(local, views.intrinsics[number], size, cell, depth.shape[1:])
    return views


def without_depth(views: CameraViews, cell: int | None) -> CameraViews:
    """Return images with arrays for the depth of cells (pixels), in which none is valid; without them for None."""
    if cell is None:
        return views
    count, height, width = views.image.shape[:3]
    depth = np.zeros((count, -(-height // cell), -(-width // cell)), np.float32)
    return replace(views, depth=depth, depth_valid=np.zeros(depth.shape, bool))


def nearest_depth(
    points: Float[np.ndarray, "n 3"],
    intrinsics: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    cell: int,
    shape: tuple[int, ...],
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the depth of the nearest point in each cell of one image, metres, and which cells have one.

    Args:
        points: camera's frame, metres.
        intrinsics: of the image.
        size: width and height of the image, pixels; a point counts for the pixel to which it is rounded.
        cell: side of the square cells, pixels.
        shape: (h, w) of the result, which covers the image array.
    """
    points = points[points[:, 2] >= _NEAREST]
    pixel = np.rint((points @ intrinsics.astype(np.float64).T)[:, :2] / points[:, 2:])
    inside = ((pixel >= 0) & (pixel < size)).all(-1)
    column, row = (pixel[inside] // cell).astype(int).T
    nearest = np.full(shape, np.inf)
    np.minimum.at(nearest, (row, column), points[inside, 2])
    valid = np.isfinite(nearest)
    return np.where(valid, nearest, 0.0).astype(np.float32), valid

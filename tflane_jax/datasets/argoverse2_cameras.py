"""The ring cameras of an Argoverse 2 log: which image belongs to a moment, and from where it was taken.

<log>/sensors/cameras/<camera>/<timestamp_ns>.jpg
<log>/calibration/intrinsics.feather               focal lengths, principal point and image size of each camera
<log>/calibration/egovehicle_SE3_sensor.feather    pose of each camera in the ego frame

Each camera exposes at a time of its own, 20 times a second, in which the vehicle drives up to a metre. A camera's pose
therefore goes by the ego pose at its image's time: camera -> its ego -> city -> ego of the key frame. The images are
undistorted; the coefficients k1, k2 and k3 of the calibration are those of the raw ones
(https://github.com/argoverse/av2-api/issues/226).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.argoverse2_poses import POSE_COLUMNS, POSES, poses_of, read_poses
from tflane_jax.datasets.openlane_frames import SUBSETS, FrameCamera
from tflane_jax.datasets.plausible import LARGEST_IMAGE, MOST_PIXELS, first_twice
from tflane_jax.datasets.view_images import ImageConfig, ImageFit, fit_image
from tflane_jax.errors import UserError
from tflane_jax.files.feather_table import Kind, read_columns
from tflane_jax.files.fields import is_time
from tflane_jax.geometry import relative_pose
from tflane_jax.scene.logs import KeyFrame

RING = SUBSETS["A"].cameras
"""The order of OpenLane-V2's subset A; the first is the front camera, whose images are portraits."""
_INTRINSICS, _EXTRINSICS = Path("calibration/intrinsics.feather"), Path("calibration/egovehicle_SE3_sensor.feather")
_INTRINSIC_COLUMNS: Mapping[str, Kind] = {
    "sensor_name": "text",
    **dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), "number"),
    **dict.fromkeys(("width_px", "height_px"), "integer"),
}
_EXTRINSIC_COLUMNS: Mapping[str, Kind] = {
    "sensor_name": "text",
    **{name: kind for name, kind in POSE_COLUMNS.items() if name != "timestamp_ns"},
}
# Nanoseconds from a key frame to its image: half a period of 50 ms, and jitter; from an image to its ego pose.
_HALF_PERIOD, _POSE = 26_000_000, 10_000_000


@dataclass(frozen=True)
class RingCamera:
    """One camera of a log.

    Attributes:
        name: in the data set.
        size: width and height of its images, pixels.
        intrinsics: (3, 3), pixels.
        ego_from_camera: (4, 4).
        times_ns: (n,) of its images, ascending; the names of the files.
    """

    name: str
    size: tuple[int, int]
    intrinsics: Float[np.ndarray, "3 3"]
    ego_from_camera: Float[np.ndarray, "4 4"]
    times_ns: Int[np.ndarray, " n"]


def has_images(folder: Path) -> bool:
    """Return whether a log folder holds images of a ring camera; none is read."""
    return any(next((_images(folder) / name).glob("*.jpg"), None) is not None for name in RING)


def _images(folder: Path) -> Path:
    return folder / "sensors" / "cameras"


class LogImages:
    """The images of a log folder.

    Attributes:
        folder: of the log.
        cameras: in the order of `RING`; None for one without images.

    Raises UserError: no camera has an image; the calibration is missing or damaged, or lacks a camera that has images;
    an image is not named after its time.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        if not has_images(folder):
            raise UserError(
                f"{folder} holds no images of the ring cameras ({_images(Path())}/{RING[0]}/<timestamp_ns>.jpg, ...): "
                "download them, take the log out, or read no images (image=None)"
            )
        sizes, intrinsics = _intrinsics(folder / _INTRINSICS)
        extrinsics = _extrinsics(folder / _EXTRINSICS)
        cameras: list[RingCamera | None] = []
        for name in RING:
            times = _times(_images(folder) / name)
            for file, known in ((_INTRINSICS, intrinsics), (_EXTRINSICS, extrinsics)):
                if len(times) and name not in known:
                    raise UserError(f"{folder / file} lacks {name}, which has images: download it again")
            found = bool(len(times))
            cameras.append(RingCamera(name, sizes[name], intrinsics[name], extrinsics[name], times) if found else None)
        self.cameras = tuple(cameras)
        self._pose_times, self._poses = read_poses(folder)

    def at(self, moment: KeyFrame) -> tuple[FrameCamera | None, ...]:
        """Return each camera with its image nearest to a key frame; None where that is over half a period away.

        Raises UserError for an image at whose time there is no ego pose.
        """
        return tuple(None if camera is None else self._at(camera, moment) for camera in self.cameras)

    def _at(self, camera: RingCamera, moment: KeyFrame) -> FrameCamera | None:
        time = int(camera.times_ns[np.abs(camera.times_ns - moment.timestamp_ns).argmin()])
        if abs(time - moment.timestamp_ns) > _HALF_PERIOD:
            return None
        image, row = _images(self.folder) / camera.name / f"{time}.jpg", np.abs(self._pose_times - time).argmin()
        if abs(int(self._pose_times[row]) - time) > _POSE:
            raise UserError(
                f"{self.folder / POSES} has no pose at the time of {image}: they are not of the same log; download "
                "both again"
            )
        pose = relative_pose(moment.global_from_ego, self._poses[row]) @ camera.ego_from_camera
        return FrameCamera(camera.name, image, camera.intrinsics, pose)


def ring_fits(logs: Iterable[LogImages], config: ImageConfig) -> tuple[ImageFit | None, ...]:
    """Return scaling and cropping of each camera's images; None for a camera that no log has.

    All logs together, because their examples have arrays of one shape. Raises UserError where the sizes in the
    calibrations differ.
    """
    sizes: dict[str, tuple[int, int]] = {}
    for log in logs:
        for camera in filter(None, log.cameras):
            if (size := sizes.setdefault(camera.name, camera.size)) != camera.size:
                raise UserError(
                    f"{log.folder / _INTRINSICS}: images of {camera.name} are {camera.size[0]} x {camera.size[1]} "
                    f"pixels here and {size[0]} x {size[1]} in another log: take one out"
                )
    return tuple(fit_image(*sizes[name], config, front=name == RING[0]) if name in sizes else None for name in RING)


def _times(folder: Path) -> Int[np.ndarray, " n"]:
    files = sorted(folder.glob("*.jpg"))
    if odd := [file for file in files if not is_time(file.stem)]:
        raise UserError(f"{odd[0]} is not named after its time in nanoseconds: take the file out")
    return np.sort(np.array([int(file.stem) for file in files], np.int64))


def _intrinsics(path: Path) -> tuple[dict[str, tuple[int, int]], dict[str, np.ndarray]]:
    """Return sizes and camera matrices by sensor."""
    table = _ring_rows(path, _INTRINSIC_COLUMNS)
    sizes, matrices = {}, {}
    for row, name in enumerate(table["sensor_name"].tolist()):
        fx, fy, cx, cy = (float(table[column][row]) for column in ("fx_px", "fy_px", "cx_px", "cy_px"))
        width, height = int(table["width_px"][row]), int(table["height_px"][row])
        proper = 0.0 < fx <= MOST_PIXELS and 0.0 < fy <= MOST_PIXELS and 0.0 < cx < width and 0.0 < cy < height
        if not proper or max(width, height) > LARGEST_IMAGE:
            raise UserError(
                f"{path}: {name} has focal lengths {fx:g} and {fy:g} and principal point {cx:g}, {cy:g} in images of "
                f"{width} x {height} pixels, which is no camera: download it again"
            )
        sizes[name], matrices[name] = (width, height), np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return sizes, matrices


def _extrinsics(path: Path) -> dict[str, np.ndarray]:
    table = _ring_rows(path, _EXTRINSIC_COLUMNS)
    return dict(zip(table["sensor_name"].tolist(), poses_of(path, table), strict=True))


def _ring_rows(path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Return the rows of the ring cameras; raise UserError where one has two."""
    table = read_columns(path, columns)
    rows = np.isin(table["sensor_name"], RING)
    table = {name: column[rows] for name, column in table.items()}
    if (twice := first_twice(table["sensor_name"].tolist())) is not None:
        raise UserError(f"{path} has two rows of {twice}: download it again")
    return table

"""A drive as a folder of images and one JSON file with calibration, times and poses: input of `tflane markers run`.

The file (lengths in metres, pixels from the corner of the image):

    {"format": "tflane-drive", "version": 1,
     "cameras": [{"name": "front", "intrinsics": [fx, fy, cx, cy], "ego_from_camera": 4 x 4,
                  "distortion": [k1, k2, p1, p2, ...], "size": [width, height]}, ...],
     "frames": [{"timestamp_ns": 0, "global_from_ego": 4 x 4, "images": {"front": "000-front.png"}}, ...]}

A camera looks along its z axis, x to the right and y down. "distortion" (OpenCV's) and "size", that of the images which
were calibrated, may be left out, and a frame may lack images. Whatever a file holds, reading it gives a drive or one
UserError.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.datasets.plausible import LARGEST_DISTORTION, LARGEST_IMAGE, check_motion
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.files.fields import file_within, items, load_json, member, numbers, whole_number
from tflane_jax.files.images import check_center, read_image, undistorted
from tflane_jax.files.wording import shown
from tflane_jax.geometry import invert_pose
from tflane_jax.scene import CameraViews

FORMAT, VERSION = "tflane-drive", 1
# Largest coordinate of a pose, metres; largest coefficient of lens distortion.
_FARTHEST = 1e8
_LONGEST_NAME = 200


class JumpWarning(UserWarning):
    """The poses of a drive jump farther than a vehicle moves."""


@dataclass(frozen=True)
class DriveCamera:
    """A calibrated camera of a drive.

    Attributes:
        name: of the camera.
        intrinsics: (3, 3) pixels.
        ego_from_camera: (4, 4) metres.
        distortion: OpenCV's coefficients, empty for none.
        size: width and height of the images that `intrinsics` are of, pixels; None where it is not known.
    """

    name: str
    intrinsics: Float[np.ndarray, "3 3"]
    ego_from_camera: Float[np.ndarray, "4 4"]
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class DriveFrame:
    """A moment of a drive.

    Attributes:
        timestamp_ns: time.
        global_from_ego: (4, 4) float64 pose, metres.
        images: file of each camera that has one, by the camera's name.
    """

    timestamp_ns: int
    global_from_ego: Float[np.ndarray, "4 4"]
    images: Mapping[str, Path]


@dataclass(frozen=True)
class Drive:
    """Cameras and frames, in order of time."""

    cameras: tuple[DriveCamera, ...]
    frames: tuple[DriveFrame, ...]
    _sizes: dict[str, tuple[int, int] | None] = field(default_factory=dict, compare=False, repr=False)

    def views(self, frame: DriveFrame, faults: dict[str, str] | None = None) -> CameraViews:
        """Read the images of a frame, without lens distortion; a camera without an image is not valid, but has a size.

        Args:
            frame: one of the drive.
            faults: gets the error of each file that cannot be used, which then counts as missing; None raises it.

        Raises UserError for an image that cannot be read, or whose size is not that of its camera.
        """
        images: dict[int, UInt8[np.ndarray, "h w 3"]] = {}
        for number, camera in enumerate(self.cameras):
            if camera.name in frame.images:
                path = frame.images[camera.name]
                try:
                    image = read_image(path)
                    self._check_size(camera, path, image)
                    images[number] = undistorted(path, image, camera.intrinsics, camera.distortion)
                except UserError as error:
                    if faults is None:
                        raise
                    faults[str(path)] = str(error)
        sizes = np.array([self._size(camera) or (0, 0) for camera in self.cameras], np.int32)
        count, (width, height) = len(self.cameras), np.maximum(sizes.max(0), 1)
        views = CameraViews(
            image=np.zeros((count, height, width, 3), np.uint8),
            size=sizes,
            intrinsics=np.stack([camera.intrinsics for camera in self.cameras]).astype(np.float32),
            camera_from_ego=np.stack([invert_pose(c.ego_from_camera) for c in self.cameras]).astype(np.float32),
            valid=np.array([number in images for number in range(count)]),
        )
        for number, image in images.items():
            views.image[number, : image.shape[0], : image.shape[1]] = image
        return views

    def _size(self, camera: DriveCamera) -> tuple[int, int] | None:
        """Return width and height of a camera's images: as the file says, else of the first one that can be used."""
        if camera.size is not None:
            return camera.size
        if camera.name not in self._sizes:
            self._sizes[camera.name] = None
            for frame in self.frames:
                with contextlib.suppress(KeyError, UserError):
                    image = read_image(path := frame.images[camera.name])
                    check_center(path, image, camera.intrinsics)
                    self._sizes[camera.name] = (image.shape[1], image.shape[0])
                    break
        return self._sizes[camera.name]

    def _check_size(self, camera: DriveCamera, path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
        if camera.size is None:
            check_center(path, image, camera.intrinsics)
        height, width = image.shape[:2]
        if (size := self._size(camera)) is not None and size != (width, height):
            others = "the calibration" if camera.size is not None else "the first image"
            raise UserError(
                f"{path} is {width} x {height}, {others} of camera {camera.name} {size[0]} x {size[1]}: all images of "
                "a camera have the size at which it was calibrated"
            )


def thinned(drive: Drive, interval: float) -> Drive:
    """Return the drive with the frames that are nearest to `interval` seconds after one another."""
    times, kept = np.array([frame.timestamp_ns for frame in drive.frames], np.int64), [0]
    while kept[-1] + 1 < len(times):
        after = (times[kept[-1] + 1 :] - times[kept[-1]]) / 1e9
        if after[-1] < 0.5 * interval:
            break
        kept.append(kept[-1] + 1 + int(np.abs(after - interval).argmin()))
    return Drive(drive.cameras, tuple(drive.frames[i] for i in kept))


def load_drive(path: Path | str, images: Path | str) -> Drive:
    """Read and check a drive.

    Args:
        path: the JSON file.
        images: folder that the names of images are relative to.

    Raises UserError that names file, place and fault; a file name that leads out of the folder is one.
    """
    path, images = Path(path), Path(images)
    record, where = load_json(path), str(path)
    if member(record, "format", where) != FORMAT:
        raise UserError(f"{where}: format is {shown(record['format'])}, expected {FORMAT!r}: this is no drive")
    version = member(record, "version", where)
    if isinstance(version, bool) or version != VERSION:
        raise UserError(f"{where}: version is {shown(version)}, this program reads {VERSION}")
    cameras = tuple(_camera(entry, f"{where}: cameras[{i}]") for i, entry in enumerate(items(record, "cameras", where)))
    names = [camera.name for camera in cameras]
    if not cameras or len(set(names)) < len(names):
        raise UserError(f"{where}: cameras need distinct names, at least one: {', '.join(names) or 'there is none'}")
    frames = tuple(
        _frame(entry, names, images, f"{where}: frames[{i}]") for i, entry in enumerate(items(record, "frames", where))
    )
    if not frames:
        raise UserError(f"{where}: frames is empty: a drive has at least one")
    for i in range(1, len(frames)):
        if frames[i].timestamp_ns <= frames[i - 1].timestamp_ns:
            raise UserError(f"{where}: frames[{i}] is not later than the frame before: put frames in order of time")
    _warn_of_jumps(frames, where)
    return Drive(cameras, frames)


def _warn_of_jumps(frames: Sequence[DriveFrame], where: str) -> None:
    """Warn where the vehicle jumps; odometry that starts anew is no error."""
    places = np.stack([frame.global_from_ego[:3, 3] for frame in frames])
    times = np.array([frame.timestamp_ns for frame in frames], np.int64)
    try:
        check_motion(places, times, [f"{where}: frames[{i}]" for i in range(len(frames))])
    except UserError as error:
        warnings.warn(f"{error}; what is remembered lies elsewhere", JumpWarning, stacklevel=3)


def _camera(entry: Any, where: str) -> DriveCamera:
    name = _text(member(entry, "name", where), f"{where}: name")
    fx, fy, cx, cy = numbers(member(entry, "intrinsics", where), (4,), f"{where}: intrinsics").tolist()
    if not (1.0 <= fx < 1e6 and 1.0 <= fy < 1e6 and abs(cx) < 1e6 and abs(cy) < 1e6):
        raise UserError(f"{where}: intrinsics are fx, fy, cx, cy in pixels, with fx and fy from 1 to a million")
    distortion = numbers(entry.get("distortion") or [], (None,), f"{where}: distortion")
    if len(distortion) not in (0, 4, 5, 8):
        raise UserError(f"{where}: distortion has {len(distortion)} numbers, OpenCV's has 4, 5 or 8")
    if (np.abs(distortion) > LARGEST_DISTORTION).any():
        raise UserError(
            f"{where}: distortion holds {np.abs(distortion).max():g}, expected at most {LARGEST_DISTORTION:g}"
        )
    size = None
    if entry.get("size") is not None:
        size = tuple(whole_number(side, 1, LARGEST_IMAGE, f"{where}: size") for side in items(entry, "size", where))
        if len(size) != 2:
            raise UserError(f"{where}: size has {len(size)} numbers, expected width and height in pixels")
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    pose = _pose(entry, "ego_from_camera", where)
    return DriveCamera(name, intrinsics, pose, tuple(float(value) for value in distortion), size)


def _frame(entry: Any, names: Sequence[str], folder: Path, where: str) -> DriveFrame:
    time = whole_number(member(entry, "timestamp_ns", where), -(2**62), 2**62, f"{where}: timestamp_ns")
    listed = member(entry, "images", where)
    if not isinstance(listed, Mapping):
        raise UserError(f"{where}: images is {shown(listed)}, expected a file for each camera")
    images: dict[str, Path] = {}
    for name, file in listed.items():
        if name not in names:
            raise UserError(f"{where}: images names the camera {name!r:.40}, which is none of {', '.join(names)}")
        place = f"{where}: images: {name}"
        images[name] = file_within(folder, _text(file, place), place)
        if not images[name].is_file():
            raise UserError(f"{where}: there is no image {images[name]}: correct --images, or the file's name")
    return DriveFrame(time, _pose(entry, "global_from_ego", where), images)


def _pose(entry: Any, name: str, where: str) -> Float[np.ndarray, "4 4"]:
    pose = numbers(member(entry, name, where), (4, 4), f"{where}: {name}").astype(np.float64)
    rotation = pose[:3, :3]
    if not (
        np.abs(pose).max() < _FARTHEST
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0.0
        and np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])
    ):
        raise UserError(f"{where}: {name} is no pose: expected a rotation and a translation over the row 0 0 0 1")
    return pose


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= _LONGEST_NAME:
        raise UserError(f"{where} is {shown(value)}, expected a name")
    return value


def save_drive(drive: Drive, path: Path, images: Path) -> Path:
    """Write a drive's JSON file; image names become relative to the folder `images`."""
    cameras = [
        {
            "name": camera.name,
            "intrinsics": [camera.intrinsics[i, j].item() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "ego_from_camera": camera.ego_from_camera.tolist(),
            **({"distortion": list(camera.distortion)} if camera.distortion else {}),
            **({"size": list(camera.size)} if camera.size else {}),
        }
        for camera in drive.cameras
    ]
    frames = [
        {
            "timestamp_ns": int(frame.timestamp_ns),
            "global_from_ego": np.asarray(frame.global_from_ego).tolist(),
            "images": {name: file.relative_to(images).as_posix() for name, file in frame.images.items()},
        }
        for frame in drive.frames
    ]
    return write_json(path, {"format": FORMAT, "version": VERSION, "cameras": cameras, "frames": frames})

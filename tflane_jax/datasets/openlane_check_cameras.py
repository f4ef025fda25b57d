"""Faults of the images and the calibration of OpenLane-V2's frames, found without decoding a pixel.

A size is read from an image's header. What a decoder would only mend silently, damage in the middle of a JPEG, shows in
its bytes: a marker that does not belong there, or a hole of zeros.
"""

from __future__ import annotations

import re
import struct
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.openlane_frames import FrameCamera, FrameFile
from tflane_jax.files.images import unreadable
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING

Images = Literal["ends", "whole"]
"""How images are read: header and last bytes, or every byte."""

# First and last bytes of intact images.
_MARKS = {".jpg": (b"\xff\xd8", b"\xff\xd9"), ".png": (b"\x89PNG", b"IEND\xaeB`\x82")}
# JPEG: start of frame, but for DHT, JPG and DAC; start of scan.
_FRAME_STARTS, _SCAN = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}, 0xDA
# In the compressed data of a scan: a marker other than a stuffed byte, a restart, or one that begins the next segment
# of a progressive file (tables, scan) or ends the image; and a hole.
_STRANGE = re.compile(rb"\xff[^\x00\xd0-\xd9\xda\xc4\xdb\xdd\xfe\xff]|\x00{4096}")
_TURNED = 35.0  # degrees between the optical axis and the nominal direction
_ASIDE = 0.15  # principal point from the image's middle, fraction of its size
_FARTHEST = 5.0  # metres from the vehicle's origin
_MOVED = 0.4  # metres from the nominal place; those of the datasets' vehicles differ by centimetres
_FOCAL = (0.25, 4.0)  # focal length, widths of the image
_NOMINAL = 0.1  # deviation from the nominal focal length, as a fraction; those of the datasets' cameras differ by 3 %
_MOUNTS = {mount.name: mount for mount in (*ARGOVERSE2_RING, *NUSCENES_RING)}


class CameraChecks:
    """Checks frame by frame; the images of a camera should all have the size of most.

    Args:
        images: see `Images`.
    """

    def __init__(self, images: Images = "ends"):
        self._images: Images = images
        self._sizes: dict[str, Counter[tuple[int, int]]] = defaultdict(Counter)
        self._of_size: dict[tuple[Path, str, tuple[int, int]], _Repeated] = {}
        self._calibration: dict[tuple[Path, str, str, tuple[int, int] | None], _Repeated] = {}

    def check(self, frame: FrameFile) -> tuple[int, list[str]]:
        """Return how many of a frame's images can be read, and the faults of the others."""
        intact, faults = 0, []
        segment = frame.path.parent.parent
        for camera in frame.cameras:
            if camera is None:
                continue
            fault, size = damage_of(camera.image, self._images), None
            if fault is None:
                intact += 1
                size = image_size(camera.image)
            else:
                faults.append(f"{camera.image} {fault}")
            if size is not None:
                self._sizes[camera.name][size] += 1
                self._of_size.setdefault((segment, camera.name, size), _Repeated(str(camera.image))).count += 1
            faults_by_kind = {
                "image": _folder_fault(camera),
                "pose": _direction_fault(camera) or _place_fault(camera),
                "scale": _scale_fault(camera, size),
            }
            for kind, found in faults_by_kind.items():
                if found is None:
                    continue
                key = (segment, camera.name, kind, size if kind == "scale" else None)
                first = _Repeated(f"{frame.path}: {camera.name} {found}")
                self._calibration.setdefault(key, first).count += 1
        return intact, faults

    def finish(self) -> tuple[int, list[str]]:
        """Return how many images have another size than most, and the faults of sizes and calibrations.

        A fault of several frames of a segment is one, with their number.
        """
        usual = {name: sizes.most_common(1)[0][0] for name, sizes in self._sizes.items()}
        strange, faults = 0, []
        for (_, name, size), found in self._of_size.items():
            if size == usual[name]:
                continue
            strange += found.count
            most = f"{usual[name][0]} x {usual[name][1]}"
            text = f"{found.text} is {size[0]} x {size[1]} pixels, most images of {name} are {most}"
            faults.append(text + found.others("images"))
        # The intrinsics fit the usual images.
        faults += [
            found.text + found.others("frames")
            for (_, name, _, size), found in self._calibration.items()
            if size is None or size == usual[name]
        ]
        return strange, faults


@dataclass
class _Repeated:
    """What was first found in a segment, a fault or an image of some size, and how often."""

    text: str
    count: int = 0

    def others(self, what: str) -> str:
        return "" if self.count == 1 else f" ({self.count} {what} of the segment)"


def image_size(path: Path) -> tuple[int, int] | None:
    """Return width and height from the header of a JPEG or PNG file; None where there is none."""
    try:
        with open(path, "rb") as file:
            start = file.read(24)
            if start.startswith(_MARKS[".png"][0]) and len(start) == 24:
                width, height = struct.unpack(">II", start[16:24])
                return width, height
            file.seek(2)
            return _jpeg_size(file) if start.startswith(b"\xff\xd8") else None
    except OSError:
        return None


def _jpeg_size(file: IO[bytes]) -> tuple[int, int] | None:
    """Return the size from the first start of frame; `file` stands behind the first marker."""
    while len(head := file.read(4)) == 4 and head[0] == 0xFF and head[1] != _SCAN:
        if head[1] in _FRAME_STARTS:
            content = file.read(5)
            height, width = struct.unpack(">HH", content[1:5]) if len(content) == 5 else (0, 0)
            return (width, height) if width and height else None
        file.seek(max(struct.unpack(">H", head[2:4])[0] - 2, 0), 1)
    return None


def damage_of(path: Path, images: Images) -> str | None:
    """Return the fault of an image file, after its name; None for none. Its end is read, or the whole file."""
    if fault := unreadable(path):
        return f"cannot be read ({fault})"
    try:
        with open(path, "rb") as file:
            start = file.read(4)
            size = file.seek(0, 2)
            file.seek(max(size - 64, 0))
            end = file.read()
            file.seek(0)
            content = file.read() if images == "whole" else b""
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    head, tail = _MARKS.get(path.suffix.lower(), (b"", b""))
    if not start.startswith(head) or tail not in end:
        return "is damaged or cut short"
    if head and image_size(path) is None:
        return "is damaged: its header gives no size"
    if content.startswith(b"\xff\xd8") and (found := _STRANGE.search(content, _scan_start(content))) is not None:
        return f"is damaged {found.start()} bytes after its start"
    return None


def _scan_start(content: bytes) -> int:
    """Return where the compressed data of a JPEG begin."""
    place = 2
    while place + 4 <= len(content) and content[place] == 0xFF:
        length = struct.unpack(">H", content[place + 2 : place + 4])[0]
        if content[place + 1] == _SCAN:
            return place + 2 + length
        place += 2 + length
    return len(content)


def _folder_fault(camera: FrameCamera) -> str | None:
    """Return what is wrong with an image that is in the folder of another camera."""
    others = [name for name in camera.image.parts if name in _MOUNTS and name != camera.name]
    if not others or camera.name in camera.image.parts:
        return None
    return f"has the image {camera.image}, which is in the folder of {others[-1]}"


def _direction_fault(camera: FrameCamera) -> str | None:
    """Return what is wrong with where a camera looks."""
    axis = camera.ego_from_camera[:3, 2]
    mount = _MOUNTS.get(camera.name)
    if mount is None:
        return None
    if _apart(axis, mount.yaw) <= _TURNED:
        return _roll_fault(camera)
    expected = mount.yaw
    looks = float(np.rad2deg(np.arctan2(axis[1], axis[0])))
    other = _camera_looking_along(axis, camera.name)
    text = f"looks to {looks:.0f} degrees (left of ahead), expected about {expected:.0f}"
    if expected == 0.0:
        text = f"does not look ahead but to {looks:.0f} degrees"
    if _inverted(camera, mount.yaw):
        return (
            f"{text}: is its extrinsic from the ego frame to the camera, instead of from the camera to the ego frame?"
        )
    if other is not None:
        return f"{text}, where {other} should look: are their calibrations swapped?"
    return f"{text}: is its extrinsic that of the camera's axes (x right, y down, z ahead) in the ego frame?"


def _roll_fault(camera: FrameCamera) -> str | None:
    """Return what is wrong with how a camera is turned about its optical axis."""
    down = camera.ego_from_camera[:3, 1] @ np.array([0.0, 0.0, -1.0])
    if down >= np.cos(np.deg2rad(_TURNED)):
        return None
    degrees = float(np.rad2deg(np.arccos(np.clip(down, -1.0, 1.0))))
    return f"is rolled by {degrees:.0f} degrees, expected upright: does the y axis of its extrinsic point down?"


def _inverted(camera: FrameCamera, yaw: float) -> bool:
    """Return whether a camera stands upright and looks along a yaw only by the inverse of its extrinsic."""
    rotation, down = camera.ego_from_camera[:3, :3], np.array([0.0, 0.0, -1.0])

    def upright(axes: Float[np.ndarray, "3 3"]) -> bool:
        return bool(axes[:, 1] @ down >= np.cos(np.deg2rad(_TURNED)))

    return upright(rotation.T) and not upright(rotation) and _apart(rotation[2], yaw) <= _TURNED


def _camera_looking_along(axis: Float[np.ndarray, "3"], name: str) -> str | None:
    """Return another camera of the same ring that should look along the axis."""
    ring = ARGOVERSE2_RING if name in {mount.name for mount in ARGOVERSE2_RING} else NUSCENES_RING
    near = {mount.name: _apart(axis, mount.yaw) for mount in ring if mount.name != name}
    best = min(near, key=near.__getitem__)
    return best if near[best] <= 0.5 * _TURNED else None


def _apart(axis: Float[np.ndarray, "3"], yaw: float) -> float:
    """Return the angle between a direction and a level one, degrees."""
    level = np.array([np.cos(np.deg2rad(yaw)), np.sin(np.deg2rad(yaw)), 0.0])
    return float(np.rad2deg(np.arccos(np.clip(axis @ level, -1.0, 1.0))))


def _place_fault(camera: FrameCamera) -> str | None:
    """Return what is wrong with where a camera is."""
    metres = float(np.linalg.norm(camera.ego_from_camera[:3, 3]))
    if metres > _FARTHEST:
        return f"is {metres:.0f} m from the vehicle's origin: is its translation in metres, and of this vehicle?"
    mount = _MOUNTS.get(camera.name)
    if mount is None:
        return None
    nominal = np.array([mount.x, mount.y, mount.z])
    apart = float(np.linalg.norm(camera.ego_from_camera[:3, 3] - nominal))
    if apart <= _MOVED:
        return None
    there = ", ".join(f"{value:.2f}" for value in camera.ego_from_camera[:3, 3])
    return (
        f"is at ({there}) m, {apart:.1f} m from where the datasets' cameras of this name are: is its translation in "
        "metres, in the ego frame, and that of this camera?"
    )


def _scale_fault(camera: FrameCamera, size: tuple[int, int] | None) -> str | None:
    """Return what is wrong with the intrinsics for images of this size."""
    if size is None:
        return None
    middle = camera.intrinsics[:2, 2] / size
    focal = camera.intrinsics[0, 0] / size[0]
    central = (np.abs(middle - 0.5) <= _ASIDE).all() and _FOCAL[0] <= focal <= _FOCAL[1]
    if central and _focal_deviation(camera, size) <= _NOMINAL:
        return None
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    if central and abs(fy / fx - 1.0) > _NOMINAL:
        return (
            f"has focal lengths of {fx:.0f} pixels along the width and {fy:.0f} along the height of images of "
            f"{size[0]} x {size[1]}, expected the same: is the matrix damaged, or were its images stretched?"
        )
    if central:
        nominal = _MOUNTS[camera.name]
        return (
            f"has a focal length of {camera.intrinsics[0, 0]:.0f} pixels in images of {size[0]} x {size[1]}, expected "
            f"about {nominal.focal * size[0] / nominal.width:.0f}: are its intrinsics those of images of another size?"
        )
    x, y = camera.intrinsics[:2, 2]
    return (
        f"has its principal point at ({x:.0f}, {y:.0f}) and a focal length of {camera.intrinsics[0, 0]:.0f} pixels in "
        f"images of {size[0]} x {size[1]}: are intrinsics those of images of another size, or of another camera?"
    )


def _focal_deviation(camera: FrameCamera, size: tuple[int, int]) -> float:
    """Return how far the focal lengths are from that of the dataset's cameras of this name, as a fraction.

    In widths or in heights of the image, whichever is nearer: one of them may have been cropped or padded. Two focal
    lengths are of a stretched image: each is compared along its own side.
    """
    mount = _MOUNTS.get(camera.name)
    if mount is None:
        return 0.0
    focal, nominal = np.diag(camera.intrinsics)[:2], mount.focal / np.array([mount.width, mount.height])
    if abs(focal[1] / focal[0] - 1.0) > _NOMINAL:
        return float(np.abs(focal / size / nominal - 1.0).max())
    return float(np.abs(focal[0] / np.array(size) / nominal - 1.0).min())

"""Faults of the images and the calibration of OpenLane-V2's frames, found without decoding a pixel.

A size is read from an image's header. What a decoder would only mend silently, damage in the middle of a JPEG, shows in
its bytes: a marker that does not belong there, or a hole of zeros.
"""

from __future__ import annotations

import re
import struct
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
# Degrees between the optical axis and where a camera of this name looks; a fraction of the image's size between its
# middle and the principal point; metres from the vehicle's origin; focal length in widths of the image, and relative to
# that of the datasets' cameras of this name, which differ by 3 %.
_TURNED, _ASIDE, _FARTHEST, _FOCAL, _NOMINAL = 35.0, 0.15, 5.0, (0.25, 4.0), 0.1
_MOUNTS = {mount.name: mount for mount in (*ARGOVERSE2_RING, *NUSCENES_RING)}


class CameraChecks:
    """Checks frame by frame; the images of a camera should all have the size of its first one.

    Args:
        images: see `Images`.
    """

    def __init__(self, images: Images = "ends"):
        self._images: Images = images
        self._sizes: dict[str, tuple[int, int]] = {}

    def check(self, frame: FrameFile) -> tuple[int, list[str]]:
        """Return how many of a frame's images are intact, and its faults."""
        intact, faults = 0, []
        for camera in frame.cameras:
            if camera is None:
                continue
            fault = _damage(camera.image, self._images)
            size = None if fault else image_size(camera.image)
            if size is not None and size != self._sizes.setdefault(camera.name, size):
                first = self._sizes[camera.name]
                fault = f"is {size[0]} x {size[1]} pixels, the first image of {camera.name} is {first[0]} x {first[1]}"
            intact += fault is None
            faults += [] if fault is None else [f"{camera.image} {fault}"]
            where = f"{frame.path}: {camera.name}"
            scale = None if fault else _scale(camera, size)
            every = _direction(camera), _place(camera), scale
            faults += [f"{where} {found}" for found in every if found is not None]
        return intact, faults


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


def _damage(path: Path, images: Images) -> str | None:
    """Return the fault of an image file, or None."""
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


def _direction(camera: FrameCamera) -> str | None:
    """Return what is wrong with where a camera looks."""
    axis = camera.ego_from_camera[:3, 2]
    mount = _MOUNTS.get(camera.name)
    if mount is None or _apart(axis, mount.yaw) <= _TURNED:
        return None
    expected = mount.yaw
    looks, other = float(np.rad2deg(np.arctan2(axis[1], axis[0]))), _others(axis, camera.name)
    text = f"looks to {looks:.0f} degrees (left of ahead), expected about {expected:.0f}"
    if expected == 0.0:
        text = f"does not look ahead but to {looks:.0f} degrees"
    if other is not None:
        return f"{text}, where {other} should look: are their calibrations swapped?"
    return f"{text}: is its extrinsic from the ego frame to the camera, instead of from the camera to the ego frame?"


def _others(axis: Float[np.ndarray, "3"], name: str) -> str | None:
    """Return another camera of the same ring that should look along the axis."""
    ring = ARGOVERSE2_RING if name in {mount.name for mount in ARGOVERSE2_RING} else NUSCENES_RING
    near = {mount.name: _apart(axis, mount.yaw) for mount in ring if mount.name != name}
    best = min(near, key=near.__getitem__)
    return best if near[best] <= 0.5 * _TURNED else None


def _apart(axis: Float[np.ndarray, "3"], yaw: float) -> float:
    """Return the angle between a direction and a level one, degrees."""
    level = np.array([np.cos(np.deg2rad(yaw)), np.sin(np.deg2rad(yaw)), 0.0])
    return float(np.rad2deg(np.arccos(np.clip(axis @ level, -1.0, 1.0))))


def _place(camera: FrameCamera) -> str | None:
    """Return what is wrong with where a camera is."""
    metres = float(np.linalg.norm(camera.ego_from_camera[:3, 3]))
    if metres <= _FARTHEST:
        return None
    return f"is {metres:.0f} m from the vehicle's origin: is its translation in metres, and of this vehicle?"


def _scale(camera: FrameCamera, size: tuple[int, int] | None) -> str | None:
    """Return what is wrong with the intrinsics for images of this size."""
    if size is None:
        return None
    middle = camera.intrinsics[:2, 2] / size
    focal = camera.intrinsics[0, 0] / size[0]
    central = (np.abs(middle - 0.5) <= _ASIDE).all() and _FOCAL[0] <= focal <= _FOCAL[1]
    if central and _relative(camera, size) <= _NOMINAL:
        return None
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


def _relative(camera: FrameCamera, size: tuple[int, int]) -> float:
    """Return how far the focal length is from that of the dataset's cameras of this name, as a fraction.

    In widths or in heights of the image, whichever is nearer: one of them may have been cropped or padded.
    """
    mount = _MOUNTS.get(camera.name)
    if mount is None:
        return 0.0
    found = camera.intrinsics[0, 0] / np.array(size)
    return float(np.abs(found / (mount.focal / np.array([mount.width, mount.height])) - 1.0).min())

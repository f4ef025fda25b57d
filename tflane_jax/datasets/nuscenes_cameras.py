"""The six cameras of a nuScenes sample, with the vehicle's motion between a camera's exposure and the lidar's sweep.

An exposure is up to 50 ms away from the sample's time, in which the vehicle drives up to a metre. A camera's pose
therefore goes by its own ego pose: camera -> its ego -> global -> ego of the lidar. Images have no distortion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.nuscenes_can_bus import can_bus
from tflane_jax.datasets.nuscenes_tables import LIDAR, Row, Tables
from tflane_jax.datasets.openlane_frames import SUBSETS, FrameCamera
from tflane_jax.datasets.plausible import LARGEST_IMAGE, MOST_PIXELS
from tflane_jax.datasets.view_images import ImageConfig, ImageFit, fit_image
from tflane_jax.errors import UserError
from tflane_jax.files.fields import file_within, numbers
from tflane_jax.geometry import invert_pose, relative_pose
from tflane_jax.scene import VehicleState

# Metres that the vehicle drives at most between a camera's exposure and the lidar's sweep.
_DRIVEN = 5.0
CanBus = Literal["none", "plain", "reference"]
"""Rules of `nuscenes_can_bus.can_bus`, or no messages."""
CameraPoses = Literal["exposure", "calibration"]
"""Pose of a camera: where the vehicle was at its exposure, or as calibrated, without the vehicle's motion until the
lidar's sweep, as MapTRv2's lift has it."""
CAMERAS = SUBSETS["B"].cameras
"""The order of MapTR and of OpenLane-V2's subset B; the first is the front camera."""


def sample_cameras(
    tables: Tables,
    sample: Row,
    global_from_ego: Float[np.ndarray, "4 4"],
    frame_from_ego: Float[np.ndarray, "4 4"] | None = None,
    poses: CameraPoses = "exposure",
) -> tuple[FrameCamera | None, ...]:
    """Return the cameras of a sample in the order of `CAMERAS`; None for one that the sample lacks.

    Args:
        tables: of the data set.
        sample: a key frame.
        global_from_ego: the vehicle's whole pose at the moment of the lidar.
        frame_from_ego: pose of the vehicle in the frame of the example, if that is another; the result's
            `ego_from_camera` is then frame_from_camera.
        poses: see `CameraPoses`.

    Raises:
        UserError: a camera matrix or a pose is malformed.
    """
    cameras: list[FrameCamera | None] = [None] * len(CAMERAS)
    channels = _channels(tables, sample)
    for place, name in enumerate(CAMERAS):
        if name in channels:
            row = channels[name]
            cameras[place] = _camera(tables, sample, name, row, global_from_ego, frame_from_ego, poses)
    return tuple(cameras)


def _camera(
    tables: Tables,
    sample: Row,
    name: str,
    row: Row,
    global_from_ego: np.ndarray,
    frame_from_ego: np.ndarray | None,
    poses: CameraPoses,
) -> FrameCamera:
    token = row["calibrated_sensor_token"]
    where = f"{tables.where('calibrated_sensor', token)}: camera_intrinsic"
    record = tables.rows["calibrated_sensor"][token]
    intrinsics = numbers(record["camera_intrinsic"], (3, 3), where, largest=MOST_PIXELS).astype(np.float64)
    if not (intrinsics[0, 0] > 0.0 and intrinsics[1, 1] > 0.0 and (intrinsics[2] == (0.0, 0.0, 1.0)).all()):
        raise UserError(f"{where} is no camera matrix (positive focal lengths, last row 0 0 1)")
    pose = tables.calibration(sample, name)
    if poses == "exposure":
        pose = relative_pose(global_from_ego, tables.ego_pose(sample, name) @ pose)
    driven = float(np.linalg.norm(tables.ego_pose(sample, name)[:2, 3] - global_from_ego[:2, 3]))
    where = tables.where("sample_data", row["token"])
    if driven > _DRIVEN:
        raise UserError(f"{where}: its ego_pose is {driven:.0f} m from that of the lidar's sweep")
    return FrameCamera(
        name=name,
        image=file_within(tables.root, row["filename"], f"{where}: filename"),
        intrinsics=intrinsics,
        ego_from_camera=pose if frame_from_ego is None else frame_from_ego @ pose,
    )


def vehicle_state(
    tables: Tables,
    scene: Row,
    sample: Row,
    frame_from_ego: Float[np.ndarray, "4 4"] | None = None,
    messages: CanBus = "none",
) -> VehicleState:
    """Return what published weights know of the vehicle in a sample.

    Args:
        tables: of the data set.
        scene, sample: a key frame and its scene.
        frame_from_ego: see `sample_cameras`.
        messages: of the CAN bus, read from the folder `can_bus` of the data set.

    Raises:
        UserError: a pose is malformed, or the messages of the scene are missing.
    """
    vehicle = np.eye(4) if frame_from_ego is None else invert_pose(frame_from_ego)
    bus = None
    if messages != "none":
        row = tables.rows["ego_pose"][tables.sensor_file(sample, LIDAR)["ego_pose_token"]]
        time, folder = sample["timestamp"] * 1000, tables.root / "can_bus"
        tables.ego_pose(sample)  # checks the row
        bus = can_bus(folder, scene["name"], time, row["translation"], row["rotation"], rules=messages)
    return VehicleState(
        lidar_from_ego=(invert_pose(tables.calibration(sample)) @ vehicle).astype(np.float32),
        vehicle_from_ego=vehicle.astype(np.float32),
        can_bus=None if bus is None else bus.astype(np.float32),
    )


def camera_fits(tables: Tables, config: ImageConfig) -> tuple[ImageFit | None, ...]:
    """Return scaling and cropping of each camera's images, by the image sizes in the tables; None for an absent camera.

    Raises UserError if no sample has a camera, or the images of a camera differ in size.
    """
    sizes: dict[str, tuple[int, int]] = {}
    for channels in tables.data.values():
        for name in CAMERAS:
            if name in channels:
                _check_size(sizes, name, channels[name], tables)
    if not sizes:
        raise UserError(f"{tables.folder}: no sample has a camera")
    return tuple(
        fit_image(*sizes[name], config, front=name == CAMERAS[0]) if name in sizes else None for name in CAMERAS
    )


def _check_size(sizes: dict[str, tuple[int, int]], name: str, row: Row, tables: Tables) -> None:
    """Keep the first size of a camera's images in `sizes`; raise UserError for another one, or an impossible one."""
    size, where = (row["width"], row["height"]), tables.where("sample_data", row["token"])
    if not 1 <= min(size) <= max(size) <= LARGEST_IMAGE:
        raise UserError(f"{where}: images of {name} are {size[0]} x {size[1]} pixels, expected 1 to {LARGEST_IMAGE}")
    if sizes.setdefault(name, size) != size:
        raise UserError(
            f"{where}: images of {name} are {size[0]} x {size[1]} pixels here and {sizes[name][0]} x {sizes[name][1]} "
            "before"
        )


def missing_images(tables: Tables, samples: Sequence[Row]) -> list[str]:
    """Return the image files of samples that do not exist, relative to the data set's folder."""
    missing = []
    for sample in samples:
        channels = _channels(tables, sample)
        for row in (channels[name] for name in CAMERAS if name in channels):
            where = tables.where("sample_data", row["token"])
            if not file_within(tables.root, row["filename"], where).is_file():
                missing.append(row["filename"])
    return missing


def _channels(tables: Tables, sample: Row) -> Mapping[str, Row]:
    """Return the sensor files of a sample by channel."""
    return tables.data.get(sample["token"], {})

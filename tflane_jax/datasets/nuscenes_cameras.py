"""The six cameras of a nuScenes sample, with the vehicle's motion between a camera's exposure and the lidar's sweep.

An exposure is up to 50 ms away from the sample's time, in which the vehicle drives up to a metre. A camera's pose
therefore goes by its own ego pose: camera -> its ego -> global -> ego of the lidar. Images have no distortion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.nuscenes_tables import Row, Tables
from tflane_jax.datasets.openlane_frames import SUBSETS, FrameCamera
from tflane_jax.datasets.view_images import ImageConfig, ImageFit, fit_image
from tflane_jax.errors import UserError
from tflane_jax.files.fields import numbers
from tflane_jax.geometry import relative_pose

# Metres that the vehicle drives at most between a camera's exposure and the lidar's sweep.
_DRIVEN = 5.0
CAMERAS = SUBSETS["B"].cameras
"""The order of MapTR and of OpenLane-V2's subset B; the first is the front camera."""


def sample_cameras(
    tables: Tables,
    sample: Row,
    global_from_ego: Float[np.ndarray, "4 4"],
    frame_from_ego: Float[np.ndarray, "4 4"] | None = None,
) -> tuple[FrameCamera | None, ...]:
    """Return the cameras of a sample in the order of `CAMERAS`; None for one that the sample lacks.

    Args:
        tables: of the data set.
        sample: a key frame.
        global_from_ego: the vehicle's whole pose at the moment of the lidar.
        frame_from_ego: pose of the vehicle in the frame of the example, if that is another; the result's
            `ego_from_camera` is then frame_from_camera.

    Raises:
        UserError: a camera matrix or a pose is malformed.
    """
    return tuple(
        _camera(tables, sample, name, row, global_from_ego, frame_from_ego) if row is not None else None
        for name, row in ((name, tables.data.get(sample["token"], {}).get(name)) for name in CAMERAS)
    )


def _camera(
    tables: Tables,
    sample: Row,
    name: str,
    row: Row,
    global_from_ego: np.ndarray,
    frame_from_ego: np.ndarray | None,
) -> FrameCamera:
    token = row["calibrated_sensor_token"]
    where = f"{tables.where('calibrated_sensor', token)}: camera_intrinsic"
    record = tables.rows["calibrated_sensor"][token]
    intrinsics = numbers(record["camera_intrinsic"], (3, 3), where).astype(np.float64)
    if not (intrinsics[0, 0] > 0.0 and intrinsics[1, 1] > 0.0 and (intrinsics[2] == (0.0, 0.0, 1.0)).all()):
        raise UserError(f"{where} is no camera matrix (positive focal lengths, last row 0 0 1)")
    global_from_camera = tables.ego_pose(sample, name) @ tables.calibration(sample, name)
    pose = relative_pose(global_from_ego, global_from_camera)
    driven = float(np.linalg.norm(tables.ego_pose(sample, name)[:2, 3] - global_from_ego[:2, 3]))
    if driven > _DRIVEN:
        where = tables.where("sample_data", row["token"])
        raise UserError(f"{where}: its ego_pose is {driven:.0f} m from that of the lidar's sweep")
    return FrameCamera(
        name=name,
        image=tables.root / row["filename"],
        intrinsics=intrinsics,
        ego_from_camera=pose if frame_from_ego is None else frame_from_ego @ pose,
    )


def camera_fits(tables: Tables, config: ImageConfig) -> tuple[ImageFit | None, ...]:
    """Return scaling and cropping of each camera's images, by the image sizes in the tables; None for an absent camera.

    Raises UserError if no sample has a camera, or the images of a camera differ in size.
    """
    sizes: dict[str, tuple[int, int]] = {}
    for channels in tables.data.values():
        for name in CAMERAS:
            if name in channels:
                _note_size(sizes, name, channels[name], tables)
    if not sizes:
        raise UserError(f"{tables.folder}: no sample has a camera")
    return tuple(
        fit_image(*sizes[name], config, front=name == CAMERAS[0]) if name in sizes else None for name in CAMERAS
    )


def _note_size(sizes: dict[str, tuple[int, int]], name: str, row: Row, tables: Tables) -> None:
    size = (row["width"], row["height"])
    if sizes.setdefault(name, size) != size or min(size) < 1:
        raise UserError(
            f"{tables.where('sample_data', row['token'])}: images of {name} are {size[0]} x {size[1]} pixels here and "
            f"{sizes[name][0]} x {sizes[name][1]} before"
        )


def missing_images(tables: Tables, samples: Sequence[Row]) -> list[str]:
    """Return the image files of samples that do not exist, relative to the data set's folder."""
    files = (
        channels[name]["filename"]
        for sample in samples
        for channels in [_channels(tables, sample)]
        for name in CAMERAS
        if name in channels
    )
    return [file for file in files if not (tables.root / file).is_file()]


def _channels(tables: Tables, sample: Row) -> Mapping[str, Row]:
    return tables.data.get(sample["token"], {})

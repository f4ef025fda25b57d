"""A hand-made Argoverse 2 log of six frames: a car throughout, a walker in one frame, a bollard; one lane."""

import json
from pathlib import Path

import numpy as np

from tflane_jax.datasets.argoverse2_log import ANNOTATIONS
from tflane_jax.datasets.argoverse2_poses import POSES

FRAMES, MS = 6, 1_000_000
POSE = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx_m": 0.0, "ty_m": 0.0, "tz_m": 0.0}


def write(path, rows, columns=None):
    """Write rows as a feather file."""
    import pyarrow as pa
    from pyarrow import feather

    columns = columns or list(rows[0])
    feather.write_feather(pa.table({c: [row[c] for row in rows] for c in columns}), str(path))


def box(frame, uuid, category, x, *, points=9):
    return {
        "timestamp_ns": (1000 + 100 * frame) * MS,
        "track_uuid": uuid,
        "category": category,
        "length_m": 4.0,
        "width_m": 2.0,
        "height_m": 1.5,
        **POSE,
        "tx_m": x,
        "qw": 0.0,
        "qz": 1.0,
        "num_interior_pts": points,
    }


def points(*xy):
    return [{"x": float(x), "y": float(y), "z": 0.5} for x, y in xy]


LANE = {
    "id": 5,
    "is_intersection": False,
    "lane_type": "BIKE",
    "left_lane_boundary": points((0, 2), (40, 2)),
    "left_lane_mark_type": "DASHED_WHITE",
    "right_lane_boundary": points((0, -2), (20, -2), (40, -2)),
    "right_lane_mark_type": "NONE",
    "successors": [6],
    "predecessors": [],
    "left_neighbor_id": None,
    "right_neighbor_id": None,
}
MAP = {
    "lane_segments": {"5": LANE},
    "pedestrian_crossings": {"1": {"id": 1, "edge1": points((0, 0), (0, 5)), "edge2": points((3, 0), (3, 5))}},
    "drivable_areas": {
        "1": {"id": 1, "area_boundary": points((0, -9), (20, -9), (20, 9), (0, 9))},
        "2": {"id": 2, "area_boundary": points((20, -9), (40, -9), (40, 9), (20, 9))},
    },
}


def write_log(folder: Path) -> Path:
    """Write the log, and return its folder."""
    (folder / "map").mkdir(parents=True)
    boxes = [box(f, "car", "REGULAR_VEHICLE", 10.0 + f, points=f) for f in range(FRAMES)]
    boxes += [box(1, "walker", "PEDESTRIAN", 3.0), box(2, "post", "BOLLARD", 4.0)]
    write(folder / ANNOTATIONS, boxes)
    poses = [{"timestamp_ns": t * MS, **POSE, "tx_m": t / 100} for t in (990, *range(1000, 1600, 100), 1590)]
    write(folder / POSES, poses)
    (folder / "map" / "log_map_archive_log-a____PIT_city_1.json").write_text(json.dumps(MAP))
    return folder


FOCAL, SPEED, MOUNT_HEIGHT = 300.0, 10.0, 1.4  # pixels, m/s, metres
CAMERAS = {
    # Width, height, place, and the axes right, down, ahead of the camera in the ego frame, as columns.
    "ring_front_center": (310, 410, (1.6, 0.0, MOUNT_HEIGHT), np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])),
    "ring_side_left": (410, 310, (1.3, 0.3, MOUNT_HEIGHT), np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])),
}


def pixel(camera, time_ms, point):
    """Return where a point (city) is in the image that a camera takes at a time, by hand, and its depth."""
    width, height, (x, y, z), _ = CAMERAS[camera]
    ahead, left, up = point[0] - SPEED * time_ms / 1e3 - x, point[1] - y, point[2] - z
    right, depth = (-left, ahead) if camera == "ring_front_center" else (ahead, left)
    return np.array([width / 2 + FOCAL * right / depth, height / 2 - FOCAL * up / depth]), depth


def write_images(folder: Path, images, point):
    """Write calibration, poses every 5 ms, and images (camera, ms) that are black but for one point of the city."""
    import cv2
    from scipy.spatial.transform import Rotation

    (folder / "calibration").mkdir()
    intrinsics, extrinsics = [], []
    for name, (width, height, place, axes) in CAMERAS.items():
        x, y, z, w = Rotation.from_matrix(axes).as_quat()
        row = {"sensor_name": name, "fx_px": FOCAL, "fy_px": FOCAL, "cx_px": width / 2, "cy_px": height / 2}
        # Raw images had this distortion; those of the data set have none.
        intrinsics.append(row | {"k1": -0.24, "k2": -0.2, "k3": 0.3, "height_px": height, "width_px": width})
        row = {"sensor_name": name, "qw": w, "qx": x, "qy": y, "qz": z}
        extrinsics.append(row | dict(zip(("tx_m", "ty_m", "tz_m"), place, strict=True)))
    write(folder / "calibration" / "intrinsics.feather", intrinsics)
    write(folder / "calibration" / "egovehicle_SE3_sensor.feather", extrinsics)
    poses = [{"timestamp_ns": t * MS, **POSE, "tx_m": SPEED * t / 1e3} for t in range(900, 1601, 5)]
    write(folder / POSES, poses)
    for name, time in images:
        width, height = CAMERAS[name][:2]
        image = np.zeros((height, width, 3), np.uint8)
        u, v = np.round(pixel(name, time, point)[0]).astype(int)
        image[v - 3 : v + 3, u - 3 : u + 3] = 255  # its center is the corner of four pixels
        path = folder / "sensors" / "cameras" / name / f"{time * MS}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), image)

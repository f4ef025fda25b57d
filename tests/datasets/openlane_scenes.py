"""A small dataset with cameras: a vehicle that drives along static lanes."""

from dataclasses import dataclass

import numpy as np

from tests.fakes import fake_views
from tflane_jax.datasets.base import FrameInfo
from tflane_jax.geometry import invert_pose, relative_pose, transform_points, yaw_pose
from tflane_jax.scene import Areas, CameraViews, Example, LaneGraph, TrafficElements
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING

FRAMES, STEP = 3, 2.5
# The ego axes in a camera that looks ahead.
AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
# Two lanes one after the other, and one beside them; global frame.
CENTERLINES = [[(0.0, 0.0), (20.0, 0.0)], [(20.0, 0.0), (38.0, 6.0)], [(0.0, 3.5), (20.0, 3.5)]]


@dataclass(frozen=True)
class DriveConfig:
    """How many scenes, how many cameras."""

    scenes: int = 2
    cameras: int = 6


class DriveDataset:
    """Frames of scenes; the order of lanes differs between frames."""

    name = "drive"

    def __init__(self, config: DriveConfig = DriveConfig()):
        self.config = config

    def __len__(self) -> int:
        return self.config.scenes * FRAMES

    def info(self, index: int) -> FrameInfo:
        scene, frame = divmod(index, FRAMES)
        pose = yaw_pose(STEP * frame, 0.0, 0.02 * frame)
        return FrameInfo("drive", f"scene {scene}", frame * 500_000_000, np.asarray(pose))

    def example(self, index: int) -> Example:
        frame, pose = index % FRAMES, self.info(index).global_from_ego
        before = self.info(index - 1).global_from_ego if frame else pose
        order = np.roll(np.arange(3), frame)
        lanes, segments = LaneGraph.empty(5, 11), LaneGraph.empty(4, 10)
        for graph in (lanes, segments):
            count = graph.points.shape[1]
            fraction = np.linspace(0, 1, count)[:, None]
            for row, number in enumerate(order):
                start, end = (np.array([*point, 0.3]) for point in CENTERLINES[number])
                graph.points[row] = transform_points(invert_pose(pose), start + fraction * (end - start))
                graph.is_connector[row] = number == 1
            side = np.array([0.0, 1.7, 0.0])
            graph.left[:3], graph.right[:3] = graph.points[:3] + side, graph.points[:3] - side
            graph.valid[:3], graph.visibility[:3] = True, 1.0
            graph.successor[:3, :3] = (order[:, None] == 0) & (order == 1)
            graph.points[3:] = np.nan
        segments.left_type[:3], segments.right_type[:3] = 2, 1
        areas = Areas.empty(2, 20)
        areas.points[0], areas.category[0], areas.valid[0] = np.linspace([5, -3, 0], [5, 3, 0], 20), 2, True
        elements = TrafficElements.empty(3, 5)
        place = transform_points(invert_pose(pose), np.array([[40.0, 3.0, 5.0], [41.0, -3.0, 5.0]]))
        elements.position[1:] = place  # row 0 is padding
        elements.box[1:] = [[[10, 4], [14, 12.5]], [[30, 5], [33, 9]]]
        elements.category[1:], elements.attribute[1:] = (1, 2), (2, 4)
        elements.lane[:3, 1:] = np.stack([order == 0, order == 2], -1)
        elements.valid[1:] = True
        return Example(
            bev=None,
            hidden=None,
            traffic_flow=None,
            markers=None,
            sd_map=None,
            lanes=lanes,
            segments=segments,
            areas=areas,
            traffic_elements=elements,
            previous_from_ego=relative_pose(before, pose).astype(np.float32),
            has_previous=np.asarray(frame > 0),
            cameras=_official(fake_views(index, cameras=self.config.cameras)),
        )


def _official(views: CameraViews) -> CameraViews:
    """Return the views from where OpenLane-V2's cameras are and look, with their focal lengths; other numbers stay."""
    rings = [ring for ring in (ARGOVERSE2_RING, NUSCENES_RING) if len(ring) == len(views.valid)]
    for i, mount in enumerate(rings[0] if rings else ()):
        turn = yaw_pose(0.0, 0.0, -np.deg2rad(mount.yaw))[:3, :3]
        views.camera_from_ego[i, :3, :3] = AHEAD @ turn
        views.camera_from_ego[i, :3, 3] = -AHEAD @ turn @ [mount.x, mount.y, mount.z]
        focal = mount.focal * views.size[i, 0] / mount.width
        views.intrinsics[i, 0, 0] = views.intrinsics[i, 1, 1] = focal
    return views

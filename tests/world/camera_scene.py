"""A small scene for ring cameras: a straight street far from the origin."""

import numpy as np

from tests.datasets.small_logs import lane_map, log, segment, tracks
from tflane_jax.geometry import yaw_pose
from tflane_jax.scene import LineType, RoadUser
from tflane_jax.scene.logs import MapElement
from tflane_jax.world.cameras.ring import NUSCENES_RING, CameraRigConfig

X, Y = 1000.0, -2000.0
FRONT = CameraRigConfig(cameras=NUSCENES_RING[:1], scale=0.4, severity=0.0)
RING = CameraRigConfig(scale=0.1, severity=0.0)
# Two lanes of 3.5 m, white lines left, between and right of them; kerbs half a metre beyond.
LINES = (3.5, 0.0, -3.5)
EGO_YAW = 0.05


def street(elements=(), crossing=True):
    """Return the map: the street runs along x, the ego vehicle drives on the right lane at (X, Y - 1.75)."""
    ends = np.array([X - 60.0, X + 90.0])
    lanes = [
        segment(0, [(x, Y + 1.75) for x in ends], left=LineType.SOLID, right=LineType.SOLID),
        segment(1, [(x, Y - 1.75) for x in ends], left=LineType.SOLID, right=LineType.SOLID),
    ]
    kerbs = (
        np.array([(ends[0], Y - 4.0, 0.0), (ends[1], Y - 4.0, 0.0)]),
        np.array([(ends[1], Y + 4.0, 0.0), (ends[0], Y + 4.0, 0.0)]),
    )
    a, b = X + 14.0, X + 17.0
    corners = [(a, Y - 4.0, 0.0), (a, Y + 4.0, 0.0), (b, Y + 4.0, 0.0), (b, Y - 4.0, 0.0), (a, Y - 4.0, 0.0)]
    ring = np.array(corners)
    return lane_map(*lanes, crossings=(ring,) if crossing else (), road_boundaries=kerbs, elements=tuple(elements))


def light(x=25.0, y=-1.75, yaw=np.pi, z=5.0, category=1, attribute=1):
    """Return an element that faces the ego vehicle unless told otherwise; x and y from (X, Y)."""
    return MapElement(np.array([X + x, Y + y, z]), yaw, category, attribute, (1,))


def scene(vector_map, boxes=(), *, category=RoadUser.CAR, **other):
    """Return a log of one frame; boxes are x, y (ego frame), length, width, height."""
    boxes = np.asarray(boxes, float).reshape(-1, 5)
    position = np.column_stack([boxes[:, :2], 0.5 * boxes[:, 4]])[None]
    recorded = tracks(position, category=category)
    recorded.size[:] = boxes[:, 2:]
    pose = yaw_pose(X, Y - 1.75, EGO_YAW)
    return log(vector_map, recorded, [pose], [(0, pose)], **other)


def to_ego(x, y, z=0.0):
    """Return a point of the street, given from (X, Y), in the ego frame."""
    c, s = np.cos(EGO_YAW), np.sin(EGO_YAW)
    dx, dy = np.asarray(x, float), np.asarray(y, float) + 1.75
    return np.stack([c * dx + s * dy, c * dy - s * dx, np.broadcast_to(z, dx.shape)], -1)

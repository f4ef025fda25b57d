"""Whether the vehicles of a scene drive along its lanes."""

import numpy as np

from tflane_jax.geometry import pose_yaw, transform_points
from tflane_jax.scene import RoadUser
from tflane_jax.world.roads.curves import arc_length, points_at


def fractions_on_lanes(log):
    """Return for each motor vehicle that moves the fraction of frames in which it follows a lane.

    It does within 1.5 m of the centerline of a lane, facing along it.
    """
    lines = [_dense(s.centerline[:, :2]) for s in log.map.segments.values()]
    at = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in lines])
    ahead = np.concatenate([np.diff(line, axis=0) for line in lines])
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    actors, poses = log.actors, log.global_from_ego
    place = transform_points(poses, actors.position)[..., :2]
    yaw = actors.yaw + pose_yaw(poses)[:, None]
    moved = np.linalg.norm(place[-1] - place[0], axis=-1) > 5.0
    vehicle = np.isin(actors.category, (RoadUser.CAR, RoadUser.TRUCK, RoadUser.BUS))
    found = []
    for k in np.flatnonzero(moved & vehicle & actors.valid.all(0)):
        apart = np.linalg.norm(at[None] - place[:, k, None], axis=-1)
        facing = np.stack([np.cos(yaw[:, k]), np.sin(yaw[:, k])], -1) @ ahead.T
        found.append(float((np.where(facing > 0.8, apart, np.inf).min(-1) < 1.5).mean()))
    return np.array(found)


def _dense(line):
    """Return a line with a vertex at least every metre."""
    length = arc_length(line)[-1]
    return points_at(line, np.linspace(0.0, length, int(length) + 2))

"""A drive in which the vehicle's frame does not point where the vehicle drives.

Roads run along the x axis of a vehicle that drives straight on. A model trained on such frames alone meets roads at
other angles only at junctions; turned frames add angles of up to `view_turn` on every road.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from tflane_jax.geometry import transform_points, yaw_pose
from tflane_jax.scene.logs import Log, Tracks
from tflane_jax.world.moving import moved_boxes
from tflane_jax.world.traffic.tracker import wrap_outside


def turned_view(log: Log, turn: float) -> Log:
    """Return a level drive with all frames of the vehicle turned to the left, counterclockwise from above.

    What is in the world stays where it is; boxes of road users are given in the turned frames.

    Args:
        log: the drive.
        turn: radians.
    """
    assert log.relief is None
    mounted: Float[np.ndarray, "4 4"] = yaw_pose(np.asarray(0.0), np.asarray(0.0), np.asarray(turn))
    tracks, actors = moved_boxes(log, lambda boxes: _tracks(boxes, turn))
    return replace(
        log,
        global_from_ego=log.global_from_ego @ mounted,
        tracks=tracks,
        actors=actors,
        keyframes=tuple(replace(moment, global_from_ego=moment.global_from_ego @ mounted) for moment in log.keyframes),
    )


def _tracks(found: Tracks, turn: float) -> Tracks:
    back = yaw_pose(np.asarray(0.0), np.asarray(0.0), np.asarray(-turn))
    return replace(
        found,
        position=transform_points(back, found.position),
        yaw=np.where(found.valid, wrap_outside(found.yaw - turn), found.yaw),
    )

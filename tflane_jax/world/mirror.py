"""The mirror image of a drive: right-hand traffic becomes left-hand traffic.

The traffic of the built-in world keeps to the right: right of way, routes, parking and the sides of roads follow from
it. Left-hand traffic is its mirror image, y -> -y in global coordinates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from tflane_jax.scene.logs import LaneSegment, Log, PlacedMarkers, Side, Tracks, VectorMap
from tflane_jax.world.moving import moved_boxes, moved_map
from tflane_jax.world.roads.markers import PlacementConfig, Visible, place_markers
from tflane_jax.world.roads.road_map import RoadMap, drives_on_left

_OTHER_SIDE: dict[Side, Side] = {"left": "right", "right": "left"}
_FLIP_POINT = np.array([1.0, -1.0, 1.0])
_FLIP_POSE = np.diag([1.0, -1.0, 1.0, 1.0])
# A board is turned over, too, so that its pattern is not reversed: x runs along the board (`tflane_jax.markers`).
_FLIP_BOARD = np.diag([-1.0, 1.0, 1.0, 1.0])
# OpenLane-V2: left and right turns, forbidden turns, and slight turns.
_MIRRORED_ATTRIBUTE = np.array([0, 1, 2, 3, 4, 6, 5, 8, 7, 9, 10, 12, 11])


def mirrored(log: Log) -> Log:
    """Return a level drive seen in a mirror. Applied twice it gives the drive back (yaws of buildings up to rounding).

    Its name, weather and random numbers of rendering stay. Traffic lights keep their states, signs of left turns show
    right turns, and patterns of markers stay readable.
    """
    assert log.relief is None
    poses = _mirrored_poses(log.global_from_ego)
    tracks, actors = moved_boxes(log, _mirrored_tracks)
    attribute = log.element_attribute
    return replace(
        log,
        map=mirrored_map(log.map),
        global_from_ego=poses,
        tracks=tracks,
        actors=actors,
        keyframes=tuple(
            replace(moment, global_from_ego=_mirrored_poses(moment.global_from_ego)) for moment in log.keyframes
        ),
        element_attribute=None if attribute is None else _MIRRORED_ATTRIBUTE[attribute],
        markers=None if log.markers is None else _mirrored_boards(log.markers),
    )


def mirrored_road_map(found: RoadMap) -> RoadMap:
    """Return a recorded map seen in a mirror."""
    return replace(
        found,
        map=mirrored_map(found.map),
        places=found.places * _FLIP_POINT[:2],
        parked=found.parked * [1.0, -1.0, -1.0],
    )


def mirrored_map(found: VectorMap) -> VectorMap:
    """Return a map seen in a mirror: lanes keep their direction, and their left side becomes the right one."""
    there = moved_map(found, _mirrored_points, _mirrored_points)
    return replace(
        there,
        segments={number: _with_sides_swapped(lane) for number, lane in there.segments.items()},
        road_boundaries=tuple(line[::-1] for line in there.road_boundaries),  # the road stays on their left
        elements=tuple(
            replace(element, yaw=-element.yaw, attribute=int(_MIRRORED_ATTRIBUTE[element.attribute]))
            for element in there.elements
        ),
        # Turned round, which is the same box: the left side of a building is its front.
        buildings=there.buildings * [1.0, -1.0, 1.0, 1.0, -1.0] + [0.0, 0.0, 0.0, 0.0, np.pi],
        side=None if found.side is None else _OTHER_SIDE[found.side],
    )


def markers_beside(
    found: VectorMap,
    seed: int,
    config: PlacementConfig,
    visible: Visible | None = None,
    poses: Float[np.ndarray, "f 4 4"] | None = None,
) -> PlacedMarkers:
    """Return the virtual markers of a recorded map, beside the lanes on the side on which traffic keeps.

    See `place_markers`, which is for right-hand traffic.
    """
    if not drives_on_left(found):
        return place_markers(found, seed, config, visible, poses)

    def seen(place: Float[np.ndarray, "3"], heading: float) -> float:
        assert visible is not None
        return visible(place * _FLIP_POINT, -heading)

    placed = place_markers(
        mirrored_map(found),
        seed,
        config,
        None if visible is None else seen,
        None if poses is None else _mirrored_poses(poses),
    )
    return _mirrored_boards(placed)


def _mirrored_boards(markers: PlacedMarkers) -> PlacedMarkers:
    return replace(markers, pose=_FLIP_POSE @ markers.pose @ _FLIP_BOARD)


def _mirrored_points(points: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "_ 3"]:
    return points * _FLIP_POINT


def _with_sides_swapped(lane: LaneSegment) -> LaneSegment:
    return replace(lane, left=lane.right, right=lane.left, left_type=lane.right_type, right_type=lane.left_type)


def _mirrored_tracks(found: Tracks) -> Tracks:
    return replace(found, position=found.position * _FLIP_POINT, yaw=-found.yaw)


def _mirrored_poses(poses: Float[np.ndarray, "*f 4 4"]) -> Float[np.ndarray, "*f 4 4"]:
    return _FLIP_POSE @ poses @ _FLIP_POSE

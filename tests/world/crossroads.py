"""A small hand-made network: two one-way streets that cross.

West to east: 1 -> 2 -> 3; south to north: 4 -> 5 -> 6, with a bend to the east 4 -> 7 -> 3. Stop lines lie 8 m before
the middle. One crosswalk runs over street 3.
"""

import numpy as np

from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment, VectorMap
from tflane_jax.world.roads.networks import RoadNetwork, SceneKind

HALF_WIDTH, STOP, REACH, LIMIT = 1.75, 8.0, 150.0, 12.0


def segment(number, line, successors, is_intersection=False, vehicle=True):
    line = np.asarray(line, float)
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    left = line + HALF_WIDTH * np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    flat = np.zeros((len(line), 1))
    return LaneSegment(
        number,
        np.hstack([line, flat]),
        np.hstack([left, flat]),
        np.hstack([2 * line - left, flat]),
        LineType.SOLID,
        LineType.SOLID,
        is_intersection,
        tuple(successors),
        vehicle,
    )


def straight(a, b, count=30):
    return np.linspace(a, b, count)


def crossroads(control="signals", turn="none"):
    """Return the network; control "signals", or "yield" where 5 and 7 let 2 pass; turn "right" adds segment 7."""
    segments = [
        segment(1, straight((-REACH, 0), (-STOP, 0)), [2]),
        segment(2, straight((-STOP, 0), (STOP, 0)), [3], is_intersection=True),
        segment(3, straight((STOP, 0), (REACH, 0)), []),
        segment(4, straight((0, -REACH), (0, -STOP)), [5, 7] if turn == "right" else [5]),
        segment(5, straight((0, -STOP), (0, STOP)), [6], is_intersection=True),
        segment(6, straight((0, STOP), (0, REACH)), []),
    ]
    connectors = {2: (0, 0), 5: (0, 1)}
    if turn == "right":
        angle = np.linspace(np.pi, np.pi / 2, 20)
        arc = np.stack([STOP + STOP * np.cos(angle), -STOP + STOP * np.sin(angle)], -1)
        segments.append(segment(7, arc, [3], is_intersection=True))
        connectors[7] = (0, 1)
    return RoadNetwork(
        map=VectorMap({s.id: s for s in segments}),
        speed_limit={s.id: LIMIT for s in segments},
        yield_to={i: (2,) for i in connectors if i != 2} if control == "yield" else {},
        signal_phase=connectors if control == "signals" else {},
        sidewalks=(np.array([[-REACH, -5.0], [REACH, -5.0]]),),
        walk_across=(np.array([[12.0, -5.0], [12.0, 5.0]]),),
        parking=np.array([[40.0, 3.5, 0.0], [46.5, 3.5, 0.0]]),
        ego_routes=((1, 2, 3),),
        kind=SceneKind.FOUR_WAY,
    )

"""Fiducial markers as bodies: a printed board on a post.

The marker frame is that of `tflane_jax.markers`: poses are `global_from_marker`, with z out of the board.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.scene.logs import PlacedMarkers
from tflane_jax.scene.marker_patterns import board_cells, board_size
from tflane_jax.world.cameras.solids import Bodies, Box, pack
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import Colour, box

# The board's thickness and the side of its square post, metres.
_THICK, _POST = 0.03, 0.1
_BACK: Colour = (0.55, 0.56, 0.57)
_WHITE: Colour = (0.93, 0.93, 0.93)


def marker_bodies(markers: PlacedMarkers | None) -> Bodies:
    """Return a board and a post for each marker, global frame; none for None.

    Args:
        markers: their poses; the ground is at z = 0, and a board lower than the thickness of a post has no post.

    Raises UserError for a size that is not positive, or ids outside the family.
    """
    if markers is None:
        return pack([], [])
    if not markers.size > 0.0:
        raise UserError(f"the size of markers must be a positive number of metres, not {markers.size}")
    solids: list[Solid] = []
    boxes: list[Box] = []
    pictures: dict[int, np.ndarray] = {}
    half = 0.5 * board_size(markers.family, float(markers.size))
    faces = 0
    for marker_id, pose in zip(np.asarray(markers.marker_id).tolist(), np.asarray(markers.pose), strict=True):
        board, outline = _board(pose, half)
        pictures[faces] = board_cells(markers.family, marker_id).astype(np.float32)
        post = Solid()
        foot, top = pose[:3, 3] - (_THICK + 0.5 * _POST) * pose[:3, 2], float(pose[2, 3] + 0.4 * half)
        heading = float(np.arctan2(pose[1, 2], pose[0, 2]))
        solids.append(board)
        boxes.append(outline)
        if top > _POST:
            box(post, foot[:2], heading, (_POST, _POST), (0.0, top), _BACK)
            solids.append(post)
            boxes.append((float(foot[0]), float(foot[1]), _POST, _POST, heading, 0.0, top))
        faces += len(board.corners) + len(post.corners)
    return replace(pack(solids, boxes), pictures=pictures)


def _board(pose: Float[np.ndarray, "4 4"], half: float) -> tuple[Solid, Box]:
    """Return the board, its face first, and the upright box around it."""
    square = half * np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    face, back = (np.asarray(side @ pose[:3, :3].T + pose[:3, 3]) for side in (square, square - [0.0, 0.0, _THICK]))
    solid = Solid()
    solid.add(face, _WHITE)
    solid.add(back[::-1], _BACK)
    for k in range(4):
        after = (k + 1) % 4
        solid.add(np.stack([face[k], back[k], back[after], face[after]]), _BACK)
    heading = float(np.arctan2(pose[1, 2], pose[0, 2]))
    cos, sin = np.cos(heading), np.sin(heading)
    corners = np.concatenate([face, back])
    along = corners[:, :2] @ np.array([[cos, -sin], [sin, cos]])
    low, high = along.min(0), along.max(0)
    u, v = 0.5 * (low + high)
    length, width = high - low
    bottom, top = corners[:, 2].min(), corners[:, 2].max()
    return solid, (cos * u - sin * v, sin * u + cos * v, length, width, heading, bottom, top)

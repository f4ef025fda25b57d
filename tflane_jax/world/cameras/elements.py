"""Traffic lights and road signs: bodies with lamps and pictograms, image boxes and visibility.

Frame of an element: x points where it faces, y to the right as seen from the front, z up.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import invert_pose
from tflane_jax.scene.logs import MapElement
from tflane_jax.world.bev.line_of_sight import hidden_points, occluders_from
from tflane_jax.world.cameras.solids import Bodies, Box, pack
from tflane_jax.world.render.camera import NEAR, PinholeCamera
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import Colour, box
from tflane_jax.world.roads.traffic_control import (
    GO_STRAIGHT,
    GREEN,
    LIGHT,
    NO_LEFT_TURN,
    NO_RIGHT_TURN,
    NO_U_TURN,
    RED,
    TURN_LEFT,
    TURN_RIGHT,
    YELLOW,
)

U_TURN, SLIGHT_LEFT, SLIGHT_RIGHT = 9, 11, 12
# Half width, half height and depth, metres.
LIGHT_SIZE, SIGN_SIZE = (0.2, 0.55, 0.24), (0.38, 0.38, 0.05)
# Above this height an element hangs from a mast beside the road, metres.
_HANGS = 4.4
_MAST: Colour = (0.34, 0.35, 0.36)
_HOUSING: Colour = (0.05, 0.055, 0.05)
_BLUE: Colour = (0.05, 0.2, 0.6)
_WHITE: Colour = (0.93, 0.93, 0.93)
_RED: Colour = (0.78, 0.06, 0.06)
_BLACK: Colour = (0.05, 0.05, 0.05)
_LAMPS: dict[int, tuple[float, Colour]] = {
    RED: (0.345, (1.0, 0.1, 0.07)),
    YELLOW: (0.0, (1.0, 0.78, 0.1)),
    GREEN: (-0.345, (0.1, 0.98, 0.5)),
}
# Limits of visibility: visible fraction of the points on its face, cosine of the widest viewing angle, fraction of its
# box inside the image.
_SEEN, _FACING, _INSIDE = 0.5, np.cos(np.deg2rad(72.0)), 0.6

_STRAIGHT = ([(-0.13, -0.75), (0.13, -0.75), (0.13, 0.15), (-0.13, 0.15)], [(-0.45, 0.15), (0.45, 0.15), (0.0, 0.8)])
_RIGHT = (
    [(-0.5, -0.75), (-0.24, -0.75), (-0.24, 0.28), (-0.5, 0.28)],
    [(-0.5, 0.02), (0.2, 0.02), (0.2, 0.28), (-0.5, 0.28)],
    [(0.2, -0.25), (0.78, 0.15), (0.2, 0.55)],
)
_BACK = (
    [(0.24, -0.75), (0.5, -0.75), (0.5, 0.5), (0.24, 0.5)],
    [(-0.5, 0.3), (0.5, 0.3), (0.5, 0.56), (-0.5, 0.56)],
    [(-0.5, -0.1), (-0.24, -0.1), (-0.24, 0.5), (-0.5, 0.5)],
    [(-0.37, -0.62), (0.0, -0.1), (-0.74, -0.1)],
)
Pictogram = Sequence[Sequence[tuple[float, float]]]


def _mirrored(parts: Pictogram) -> Pictogram:
    return [[(-u, v) for u, v in reversed(ring)] for ring in parts]


def _leaning(parts: Pictogram, angle: float) -> Pictogram:
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    return [[(cos * u + sin * v, cos * v - sin * u) for u, v in ring] for ring in parts]


_PICTOGRAMS: dict[int, Pictogram] = {
    GO_STRAIGHT: _STRAIGHT,
    TURN_LEFT: _mirrored(_RIGHT),
    TURN_RIGHT: _RIGHT,
    NO_LEFT_TURN: _mirrored(_RIGHT),
    NO_RIGHT_TURN: _RIGHT,
    U_TURN: _BACK,
    NO_U_TURN: _BACK,
    SLIGHT_LEFT: _leaning(_STRAIGHT, -0.7),
    SLIGHT_RIGHT: _leaning(_STRAIGHT, 0.7),
}


def element_bodies(elements: Sequence[MapElement], attribute: Int[np.ndarray, " e"]) -> Bodies:
    """Return one body for each element, global frame, with the given attributes."""
    solids, boxes, places = [], [], []
    for element, shown in zip(elements, np.asarray(attribute).tolist(), strict=True):
        solid = Solid()
        height = float(element.position[2])
        half, up, depth = LIGHT_SIZE if element.category == LIGHT else SIGN_SIZE
        if element.category == LIGHT:
            _light(solid, height, shown)
        else:
            _sign(solid, height, shown)
        solids.append(solid)
        boxes.append((-0.5 * depth, 0.0, depth, 2.0 * half, 0.0, height - up, height + up))
        places.append((*element.position[:2], element.yaw))
    pose = np.array(places).reshape(-1, 3)
    return pack(solids, boxes).placed(pose[:, :2], pose[:, 2])


def mast_bodies(elements: Sequence[MapElement], boundaries: Sequence[Float[np.ndarray, "_ 3"]]) -> Bodies:
    """Return the supports of the elements: posts of low ones, masts with an arm beside the road for high ones."""
    solids: list[Solid] = []
    boxes: list[Box] = []

    def add(center: np.ndarray, heading: float, size: tuple[float, float], z: tuple[float, float]) -> None:
        solid = Solid()
        box(solid, center, heading, size, z, _MAST)
        solids.append(solid)
        boxes.append((center[0], center[1], *size, heading, *z))

    kerbs = np.concatenate([np.zeros((0, 2)), *(line[:, :2] for line in boundaries)])
    for element in elements:
        behind = -np.array([np.cos(element.yaw), np.sin(element.yaw)])
        _, up, depth = LIGHT_SIZE if element.category == LIGHT else SIGN_SIZE
        middle, height = element.position[:2] + (depth + 0.08) * behind, float(element.position[2])
        if height < _HANGS or not len(kerbs):
            add(middle, element.yaw, (0.08, 0.08), (0.0, height + 0.8 * up))
            continue
        foot = kerbs[np.argmin(np.linalg.norm(kerbs - middle, axis=-1))]
        reach = foot - middle
        foot = foot + 0.7 * reach / max(float(np.linalg.norm(reach)), 1e-6)
        arm = middle - foot
        heading, length = float(np.arctan2(arm[1], arm[0])), float(np.linalg.norm(arm))
        level = height + 0.7 * up
        add(foot, heading, (0.22, 0.22), (0.0, level + 0.3))
        add(0.5 * (foot + middle), heading, (length, 0.12), (level - 0.06, level + 0.06))
    return pack(solids, boxes)


def element_boxes(
    elements: Sequence[MapElement], ego_from_global: Float[np.ndarray, "4 4"], camera: PinholeCamera
) -> tuple[Float[np.ndarray, "e 2 2"], Bool[np.ndarray, " e"]]:
    """Return the pixel box of each element, cut at the image border, and which are in the image and face the camera.

    Other boxes are arbitrary. Occlusion is not considered."""
    corners, faces = _corners(elements, ego_from_global)
    pixels, depth = camera.image_of(corners.reshape(-1, 3))
    pixels, depth = pixels.reshape(-1, 8, 2), depth.reshape(-1, 8)
    whole = np.stack([pixels.min(1), pixels.max(1)], 1)
    cut = np.clip(whole, 0.0, [camera.width, camera.height])
    area, full = np.prod(cut[:, 1] - cut[:, 0], -1), np.prod(whole[:, 1] - whole[:, 0], -1)
    eye = invert_pose(camera.camera_from_ego)[:3, 3]
    sight = eye - corners[:, :4].mean(1)
    facing = (sight * faces).sum(-1) > _FACING * np.linalg.norm(sight, axis=-1)
    inside = area >= _INSIDE * np.maximum(full, 1e-9)
    return cut, (depth > NEAR).all(-1) & facing & inside


def unhidden(
    elements: Sequence[MapElement],
    ego_from_global: Float[np.ndarray, "4 4"],
    camera: PinholeCamera,
    boxes: Float[np.ndarray, "b 7"],
    own: int,
) -> Bool[np.ndarray, " e"]:
    """Return which elements are not mostly occluded.

    Args:
        elements, ego_from_global, camera: elements and viewpoint.
        boxes: of all bodies in the ego frame, as `Bodies.boxes`.
        own: row of the first element's body in `boxes`; those of the others follow.
    """
    corners, faces = _corners(elements, ego_from_global)
    fraction = np.array([(u, v) for u in (0.12, 0.5, 0.88) for v in (0.06, 0.35, 0.65, 0.94)])
    across, up = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    points = (
        corners[:, None, 0] + fraction[:, :1] * across[:, None] + fraction[:, 1:] * up[:, None] + 0.03 * faces[:, None]
    )
    eye = invert_pose(camera.camera_from_ego)[:3, 3]
    hidden = hidden_points(
        points.reshape(-1, 3)[:, :2] - eye[:2],
        occluders_from(boxes, eye),
        np.zeros((0, 5)),
        sensor_height=float(eye[2]),
        target_height=points[..., 2].ravel(),
        exclude=np.repeat(own + np.arange(len(corners)), len(fraction)),
    )
    return hidden.reshape(len(corners), -1).mean(-1) <= 1.0 - _SEEN


def _corners(
    elements: Sequence[MapElement], ego_from_global: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "e 8 3"], Float[np.ndarray, "e 3"]]:
    """Return the corners of the elements' faces (lower left, lower right, upper right, upper left) and of their backs,
    and the directions of the faces, all in the ego frame."""
    rows = []
    for element in elements:
        half, up, depth = LIGHT_SIZE if element.category == LIGHT else SIGN_SIZE
        rows.append([(x, u, v) for x in (0.0, -depth) for u, v in ((-half, -up), (half, -up), (half, up), (-half, up))])
    local = np.array(rows).reshape(-1, 8, 3)
    yaw = np.array([element.yaw for element in elements])
    place = np.array([element.position for element in elements]).reshape(-1, 3)
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    there = np.stack([cos * x - sin * y, sin * x + cos * y, z], -1) + place[:, None]
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], -1)
    turn = ego_from_global[:3, :3]
    return there @ turn.T + ego_from_global[:3, 3], ahead @ turn.T


def _face(solid: Solid, x: float, ring: Sequence[tuple[float, float]], z: float, colour: Colour, light: float = 0.0):
    """Add a polygon on the face, given as (right, up) counter-clockwise as seen from the front."""
    solid.add(np.array([(x, u, z + v) for u, v in ring]), colour, light)


def _disc(radius: float, count: int = 12) -> list[tuple[float, float]]:
    angle = 2.0 * np.pi * np.arange(count) / count
    return list(zip((radius * np.cos(angle)).tolist(), (radius * np.sin(angle)).tolist(), strict=True))


def _light(solid: Solid, z: float, shown: int) -> None:
    half, up, depth = LIGHT_SIZE
    box(solid, np.array([-0.5 * depth, 0.0]), 0.0, (depth, 2.0 * half), (z - up, z + up), _HOUSING)
    for state, (height, colour) in _LAMPS.items():
        lit = state == shown
        tone = colour if lit else (0.16 * colour[0], 0.16 * colour[1], 0.16 * colour[2])
        ring = [(u, v + height) for u, v in _disc(0.15)]
        _face(solid, 0.005, ring, z, tone, 1.0 if lit else 0.0)


def _sign(solid: Solid, z: float, shown: int) -> None:
    half, up, depth = SIGN_SIZE
    banned = shown in (NO_LEFT_TURN, NO_RIGHT_TURN, NO_U_TURN)
    plate = _WHITE if banned else _BLUE
    box(solid, np.array([-0.5 * depth, 0.0]), 0.0, (depth, 2.0 * half), (z - up, z + up), plate)
    if banned:
        _face(solid, 0.002, _disc(0.96 * half, 20), z, _RED)
        _face(solid, 0.004, _disc(0.74 * half, 20), z, _WHITE)
    scale, colour = (0.6 * half, _BLACK) if banned else (0.92 * half, _WHITE)
    for ring in _PICTOGRAMS.get(shown, ()):
        _face(solid, 0.006, [(scale * u, scale * v) for u, v in ring], z, colour)
    if banned:
        bar = _leaning([[(-0.11, -0.85), (0.11, -0.85), (0.11, 0.85), (-0.11, 0.85)]], -0.785)
        _face(solid, 0.008, [(half * u, half * v) for u, v in bar[0]], z, _RED)

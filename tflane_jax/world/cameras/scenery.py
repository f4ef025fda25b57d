"""Static scenery beside the roads of a map: buildings, trees, bushes and street lamps.

Global metres. Everything is placed off the drivable area; only lamp arms and tree crowns extend over it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from tflane_jax.scene.logs import VectorMap
from tflane_jax.world.cameras.solids import Bodies, Box, footprints, join, pack
from tflane_jax.world.render.polygons import Solid
from tflane_jax.world.render.shapes import Colour, box, frustum, inset, insets
from tflane_jax.world.roads.area import road_rings
from tflane_jax.world.roads.curves import arc_length, points_at, right_of

_WALLS: tuple[Colour, ...] = (
    (0.62, 0.56, 0.48),
    (0.55, 0.36, 0.28),
    (0.7, 0.68, 0.63),
    (0.48, 0.5, 0.52),
    (0.72, 0.62, 0.45),
    (0.42, 0.32, 0.28),
    (0.6, 0.62, 0.58),
    (0.78, 0.75, 0.7),
)
_PANE: Colour = (0.17, 0.21, 0.26)
_LIT: Colour = (0.95, 0.78, 0.45)
_BARK: Colour = (0.22, 0.17, 0.12)
_POST: Colour = (0.36, 0.37, 0.38)
_STOREY = 3.2
_CELL = 0.5  # of the raster of free space, metres


@dataclass(frozen=True)
class Scenery:
    """Scenery beside the roads.

    Attributes:
        bodies: global frame.
        towers: (t, 6) x, y, length, width, yaw and height of buildings, for their shadows.
        crowns: (c, 4) x, y, z and radius of tree crowns.
        lamps: (l, 2) ground below street lamps.
        urban: paved beside the road.
    """

    bodies: Bodies
    towers: Float[np.ndarray, "t 6"]
    crowns: Float[np.ndarray, "c 4"]
    lamps: Float[np.ndarray, "l 2"]
    urban: bool


def draw_scenery(rng: np.random.Generator, vector_map: VectorMap, night: float) -> Scenery:
    """Draw the scenery of a map; the same stream and map give the same bits.

    Args:
        rng: stream.
        vector_map: with its boundaries and buildings.
        night: 0 to 1, brightness of windows and lamps.
    """
    kerbs = [line[:, :2] for line in vector_map.road_boundaries if np.linalg.norm(line[0] - line[-1]) > 0.05]
    urban = len(vector_map.crossings) > 0 or len(vector_map.buildings) >= 12
    heights = rng.uniform(5.5, 17.0, len(vector_map.buildings))
    solids: list[Solid] = []
    boxes: list[Box] = []
    for block, height, look in zip(vector_map.buildings, heights, rng.random((len(heights), 6)), strict=True):
        solids.append(_building(block, height, look, night))
        boxes.append((*block, 0.0, height + 0.5))
    room = _Room(vector_map)
    lamps = _lamps(rng, kerbs, room, night, solids, boxes) if urban or rng.random() < 0.3 else np.zeros((0, 2))
    trees, crowns = _trees(rng, kerbs, room, urban)
    towers = np.column_stack([vector_map.buildings, heights])
    return Scenery(join([pack(solids, boxes), trees]), towers, crowns, lamps, urban)


class _Room:
    """Raster of occupied space: the drivable area with a margin, and buildings."""

    def __init__(self, vector_map: VectorMap):
        import cv2

        rings = [*road_rings(vector_map.road_boundaries), *footprints(_boxes_of(vector_map.buildings))]
        points = np.concatenate([*rings, np.zeros((1, 2))])
        self.low = points.min(0) - 30.0
        size = np.ceil((points.max(0) + 30.0 - self.low) / _CELL).astype(int)
        self.road: UInt8[np.ndarray, "h w"] = np.zeros((size[1], size[0]), np.uint8)
        fixed = [np.round((ring - self.low) / _CELL).astype(np.int32) for ring in rings]
        streets = len(rings) - len(vector_map.buildings)
        if streets:
            cv2.fillPoly(self.road, fixed[:streets], 1)
        for ring in fixed[streets:]:
            cv2.fillPoly(self.road, [ring], 1)
        self._grown: dict[int, np.ndarray] = {}

    def free(self, xy: Float[np.ndarray, "n 2"], margin: float) -> np.ndarray:
        """Return which points keep `margin` metres from all occupied space."""
        import cv2

        cells = round(margin / _CELL)
        if cells not in self._grown:
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
            self._grown[cells] = cv2.dilate(self.road, kernel)
        column, row = np.round((xy - self.low) / _CELL).astype(int).T
        h, w = self.road.shape
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        return inside & (self._grown[cells][np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)] == 0)


def _boxes_of(blocks: Float[np.ndarray, "b 5"]) -> Float[np.ndarray, "b 7"]:
    return np.pad(np.asarray(blocks, np.float64).reshape(-1, 5), ((0, 0), (0, 2)))


def _building(block: np.ndarray, height: float, look: np.ndarray, night: float) -> Solid:
    """Return one block; its left side is its front."""
    x, y, length, width, yaw = block
    wall = np.array(_WALLS[int(look[0] * len(_WALLS))]) * (0.85 + 0.3 * look[1])
    tone: Colour = (float(wall[0]), float(wall[1]), float(wall[2]))
    dark: Colour = (tone[0] * 0.55, tone[1] * 0.55, tone[2] * 0.55)
    solid = Solid()
    half, a, b = 0.5 * width, -0.5 * length, 0.5 * length
    if look[2] < 0.35 and height < 10.0:
        faces = frustum(solid, (a, b, 0.0), (a, b, height - 2.0), (half, half), {"all": tone})
        roof: Colour = (0.35 + 0.2 * look[3], 0.24, 0.2)
        top = height - 2.0
        frustum(solid, (a - 0.3, b + 0.3, top), (a + 1.0, b - 1.0, height + 0.5), (half + 0.3, 0.3), {"all": roof})
    else:
        faces = frustum(solid, (a, b, 0.0), (a, b, height), (half, half), {"all": tone, "top": dark})
        rim = a - 0.15, b + 0.15
        frustum(solid, (*rim, height - 0.4), (*rim, height), (half + 0.15, half + 0.15), {"all": dark})
        top = height
    storeys = max(int(top / _STOREY), 1)
    shop = look[4] < 0.45
    for side, extent in (("left", length), ("front", width), ("rear", width)):
        count = max(int(extent / (2.4 + 2.0 * look[5])), 1)
        storey, column = (index.ravel() for index in np.mgrid[:storeys, :count])
        if shop and side == "left":
            up = 0.1 * _STOREY / top, 0.85 * _STOREY / top
            solid.add(inset(faces[side], (0.05, 0.95), up), _PANE, 0.6 * night)
            storey, column = storey[count:], column[count:]
        # Lit windows are chosen by a hash of their positions.
        lit = (np.sin(91.7 * column + 37.1 * storey + 7.0 * x + 3.0 * y) > 0.55) & (night > 0.0)
        across = (column[:, None] + [0.22, 0.78]) / count
        panes = insets(faces[side], across, (storey[:, None] + [0.3, 0.82]) * (_STOREY / top))
        solid.corners += list(panes)
        solid.colours += [_LIT if shines else _PANE for shines in lit]
        solid.light += (0.85 * night * lit).tolist()
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    solid.corners = [corners @ turn + np.array([x, y, 0.0]) for corners in solid.corners]
    return solid


def _along(
    rng: np.random.Generator, kerb: Float[np.ndarray, "n 2"], spacing: tuple[float, float], behind: tuple[float, float]
) -> Float[np.ndarray, "k 2"]:
    """Return places in a row behind a kerb."""
    total = float(arc_length(kerb)[-1])
    count = int(total / spacing[0]) + 1
    at, back = np.cumsum(rng.uniform(*spacing, count)), rng.uniform(*behind, count)
    at, back = at[at < total - 3.0], back[at < total - 3.0]
    if not len(at):
        return np.zeros((0, 2))
    ahead = points_at(kerb, np.minimum(at + 1.0, total)) - points_at(kerb, np.maximum(at - 1.0, 0.0))
    return points_at(kerb, at) + back[:, None] * right_of(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _lamps(
    rng: np.random.Generator, kerbs: list[np.ndarray], room: _Room, night: float, solids: list[Solid], boxes: list[Box]
) -> Float[np.ndarray, "l 2"]:
    """Add street lamps; return the ground below their heads."""
    below = [np.zeros((0, 2))]
    for kerb in kerbs:
        feet = _along(rng, kerb, (24.0, 34.0), (0.7, 0.9))
        for foot in feet[room.free(feet, 0.4)]:
            nearest = kerb[np.argmin(np.linalg.norm(kerb - foot, axis=-1))]
            ahead = (nearest - foot) / max(float(np.linalg.norm(nearest - foot)), 1e-6)
            heading = float(np.arctan2(ahead[1], ahead[0]))
            post, head = Solid(), Solid()
            box(post, foot, heading, (0.16, 0.16), (0.0, 7.0), _POST)
            box(head, foot + 1.1 * ahead, heading, (2.2, 0.14), (7.0, 7.12), _POST)
            glow: Colour = (1.0, 0.9, 0.7)
            box(head, foot + 2.0 * ahead, heading, (0.6, 0.26), (6.94, 7.0), glow if night > 0.0 else _POST)
            head.light[-6:] = [min(1.0, 2.0 * night)] * 6
            solids += [post, head]
            boxes += [(*foot, 0.16, 0.16, heading, 0.0, 7.0), (*(foot + 1.15 * ahead), 2.3, 0.26, heading, 6.94, 7.2)]
            below.append((foot + 2.0 * ahead)[None])
    return np.concatenate(below)


def _trees(
    rng: np.random.Generator, kerbs: list[np.ndarray], room: _Room, urban: bool
) -> tuple[Bodies, Float[np.ndarray, "c 4"]]:
    """Return trees and bushes as trunks with blobs, and the crowns of the trees."""
    green = np.array([0.3, 0.42, 0.17]) * rng.uniform(0.8, 1.25) + rng.uniform(0.0, 0.05, 3)
    trunks: list[Solid] = []
    boxes: list[Box] = []
    crowns, blobs, colours, owners = [], [], [], []
    for kerb in kerbs:
        spacing = (9.0, 26.0) if urban else (6.0, 22.0)
        places = _along(rng, kerb, spacing, (1.5, 4.0) if urban else (4.0, 16.0))
        for (x, y), fits, look in zip(places, room.free(places, 1.5), rng.random((len(places), 40)), strict=True):
            if not fits:
                continue
            bush = look[0] < (0.25 if urban else 0.35)
            radius = 0.5 + 0.6 * look[1] if bush else 1.5 + 1.3 * look[1]
            middle = 0.7 * radius if bush else 2.3 + radius * 0.8 + 1.0 * look[2]
            if not bush:
                trunk = Solid()
                box(trunk, np.array([x, y]), 3.0 * look[3], (0.3, 0.26), (0.0, middle - 0.5 * radius), _BARK)
                trunks.append(trunk)
                boxes.append((x, y, 0.3, 0.26, 3.0 * look[3], 0.0, middle - 0.5 * radius))
                crowns.append((x, y, middle, radius))
            low = 0.0 if bush else middle - 0.5 * radius
            boxes.append((x, y, 1.6 * radius, 1.6 * radius, 0.0, low, middle + radius))
            trunks.append(Solid())
            tint = green * (0.8 + 0.4 * look[4]) + [0.04 * look[5], 0.0, 0.0]
            # Later blobs are drawn over earlier ones: dark and low first, bright and high last.
            blob, offset = np.arange(9), look[6:33].reshape(9, 3) - 0.5
            offset[:, 2] = 0.65 * (blob / 8.0 - 0.45) + 0.3 * offset[:, 2]
            size = radius * (0.62 - 0.035 * blob)
            blobs.append(np.column_stack([[x, y, middle] + radius * offset * [1.1, 1.1, 1.0], size]))
            colours.append(tint * (0.62 + 0.075 * blob)[:, None])
            owners.append(np.full(9, len(trunks) - 1))
    leaves = replace(
        pack(trunks, boxes),
        blobs=np.concatenate([np.zeros((0, 4)), *blobs]),
        blob_colours=np.concatenate([np.zeros((0, 3)), *colours]),
        blob_owner=np.concatenate([np.zeros(0, int), *owners]),
    )
    return leaves, np.array(crowns).reshape(-1, 4)

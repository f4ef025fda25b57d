"""Convex bodies made of flat polygons, packed into arrays and drawn from far to near.

Distance does not decide which of two bodies hides the other: the center of a long building beside the road may be
nearer than a car in front of it. A separating plane does: bodies on the camera's side of it are never hidden by those
beyond (Schumacker et al. 1969). Every body has an upright bounding box; the faces of these boxes are the candidate
planes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from tflane_jax.geometry import invert_pose
from tflane_jax.world.cameras.pictures import paint_picture
from tflane_jax.world.render.camera import PinholeCamera
from tflane_jax.world.render.faces import faces_of
from tflane_jax.world.render.polygons import HEADLIGHTS, SHIFT, Solid, clipped, fixed_point
from tflane_jax.world.render.weather import Weather

Box = tuple[float, float, float, float, float, float, float]
# Boxes that overlap by less than this still count as separated, metres.
_SLACK = 0.04
_SIDES = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
_CORNERS = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
_OUTLINE = 18
# Display value of printed black.
_INK = np.full((1, 3), 0.045)


@dataclass(frozen=True)
class Bodies:
    """B bodies of K polygons with M corners, and L round blobs (foliage) that always face the camera.

    Attributes:
        boxes: (B, 7) x, y, length, width, yaw, lowest and highest z, metres.
        corners: (M, 3) counter-clockwise as seen from outside, metres.
        stops: (K,) index after the last corner of each polygon.
        colours: (K, 3) display values 0 to 1.
        light: (K,) 0 lit by the sun, 1 shines by itself.
        owner: (K,) body of each polygon; polygons of one body lie in the order in which they are drawn.
        blobs: (L, 4) center and radius, metres.
        blob_colours: (L, 3).
        blob_owner: (L,).
        pictures: (r, c) patterns by polygon index, top row first: 1 has the polygon's colour, 0 is black. Such a
            polygon is a parallelogram; its first corner is the lower left one as seen from the front.
    """

    boxes: Float[np.ndarray, "b 7"]
    corners: Float[np.ndarray, "m 3"]
    stops: Int[np.ndarray, " k"]
    colours: Float[np.ndarray, "k 3"]
    light: Float[np.ndarray, " k"]
    owner: Int[np.ndarray, " k"]
    blobs: Float[np.ndarray, "l 4"]
    blob_colours: Float[np.ndarray, "l 3"]
    blob_owner: Int[np.ndarray, " l"]
    pictures: Mapping[int, Float[np.ndarray, "_ _"]] = field(default_factory=dict)

    def placed(self, xy: Float[np.ndarray, "#b 2"], yaw: Float[np.ndarray, " #b"]) -> Bodies:
        """Return the bodies rotated by `yaw` about the origin, then moved by `xy`: one pose for all, or one each."""
        count = len(self.boxes)
        pose = np.broadcast_to(np.column_stack([xy, np.cos(yaw), np.sin(yaw)]), (count, 4))
        boxes = self.boxes.copy()
        boxes[:, :2] = _turned(self.boxes[:, :2], pose)
        boxes[:, 4] += yaw
        corners, blobs = self.corners.copy(), self.blobs.copy()
        corners[:, :2] = _turned(self.corners[:, :2], pose[np.repeat(self.owner, _counts(self.stops))])
        blobs[:, :2] = _turned(self.blobs[:, :2], pose[self.blob_owner])
        return replace(self, boxes=boxes, corners=corners, blobs=blobs)

    def chosen(self, keep: Bool[np.ndarray, " b"]) -> Bodies:
        """Return the bodies where `keep` is true."""
        number = np.cumsum(keep) - 1
        kept, blob = keep[self.owner], keep[self.blob_owner]
        counts = _counts(self.stops)
        place = np.cumsum(kept) - 1
        return Bodies(
            self.boxes[keep],
            self.corners[np.repeat(kept, counts)],
            np.cumsum(counts[kept]),
            self.colours[kept],
            self.light[kept],
            number[self.owner[kept]],
            self.blobs[blob],
            self.blob_colours[blob],
            number[self.blob_owner[blob]],
            {int(place[polygon]): picture for polygon, picture in self.pictures.items() if kept[polygon]},
        )


def pack(solids: Sequence[Solid], boxes: Sequence[Box] | Float[np.ndarray, "b 7"]) -> Bodies:
    """Pack bodies; each solid's polygons lie within its box."""
    counts = [len(solid.corners) for solid in solids]
    rings = [ring for solid in solids for ring in solid.corners]
    return Bodies(
        boxes=np.asarray(boxes, np.float64).reshape(-1, 7),
        corners=np.concatenate([np.zeros((0, 3)), *rings]),
        stops=np.cumsum([len(ring) for ring in rings], dtype=int),
        colours=np.array([colour for solid in solids for colour in solid.colours], np.float64).reshape(-1, 3),
        light=np.array([light for solid in solids for light in solid.light], np.float64),
        owner=np.repeat(np.arange(len(counts)), counts),
        blobs=np.zeros((0, 4)),
        blob_colours=np.zeros((0, 3)),
        blob_owner=np.zeros(0, int),
    )


def join(groups: Sequence[Bodies]) -> Bodies:
    """Return the bodies of several groups as one."""
    bodies = np.cumsum([0, *(len(g.boxes) for g in groups)])
    corners = np.cumsum([0, *(len(g.corners) for g in groups)])
    polygons = np.cumsum([0, *(len(g.stops) for g in groups)]).tolist()
    return Bodies(
        boxes=np.concatenate([g.boxes for g in groups]),
        corners=np.concatenate([g.corners for g in groups]),
        stops=np.concatenate([g.stops + n for g, n in zip(groups, corners[:-1], strict=True)]),
        colours=np.concatenate([g.colours for g in groups]),
        light=np.concatenate([g.light for g in groups]),
        owner=np.concatenate([g.owner + n for g, n in zip(groups, bodies[:-1], strict=True)]),
        blobs=np.concatenate([g.blobs for g in groups]),
        blob_colours=np.concatenate([g.blob_colours for g in groups]),
        blob_owner=np.concatenate([g.blob_owner + n for g, n in zip(groups, bodies[:-1], strict=True)]),
        pictures={
            n + polygon: picture
            for g, n in zip(groups, polygons[:-1], strict=True)
            for polygon, picture in g.pictures.items()
        },
    )


def draw_bodies(
    image: UInt8[np.ndarray, "h w 3"],
    bodies: Bodies,
    camera: PinholeCamera,
    weather: Weather,
    edges: Literal["smooth", "hard"] = "smooth",
) -> None:
    """Draw bodies given in the ego frame; `weather.sun` is in the ego frame too.

    Hard edges are faster, and sufficient if the image is averaged down afterwards.
    """
    import cv2

    line = cv2.LINE_AA if edges == "smooth" else cv2.LINE_8
    if not len(bodies.boxes):
        return
    eye = invert_pose(camera.camera_from_ego)[:3, 3]
    bodies = with_blobs(bodies, eye)
    faces = faces_of(bodies.corners, polygon_starts(bodies), camera, eye)
    starts, a, normal, near, shown = faces.starts, faces.corner, faces.normal, faces.near, faces.shown
    if not len(shown):
        return
    low, high = faces.low, faces.high
    low[near], high[near] = -np.inf, np.inf
    present, owner = np.unique(bodies.owner[shown], return_inverse=True)
    outline = np.full((2, len(present), 2), np.inf)
    np.minimum.at(outline[0], owner, low[shown])
    np.minimum.at(outline[1], owner, -high[shown])
    rank = np.empty(len(present), int)
    rank[_far_to_near(bodies.boxes[present], eye, outline[0], -outline[1])] = np.arange(len(present))
    shown = shown[np.argsort(rank[owner], kind="stable")]
    colours = _lit(bodies.colours[shown], normal[shown], bodies.light[shown], a[shown], weather).tolist()
    fixed = fixed_point(faces.pixels)
    for number, colour in zip(shown.tolist(), colours, strict=True):
        part = slice(starts[number], bodies.stops[number])
        ring = fixed[part]
        if near[number]:
            ring = fixed_point(camera.image_of(clipped(bodies.corners[part], faces.depth[part]))[0])
        if number in bodies.pictures and not near[number]:
            black = _lit(_INK, normal[[number]], bodies.light[[number]], a[[number]], weather)[0]
            paint_picture(image, bodies.corners[part], bodies.pictures[number], camera, np.stack([black, colour]))
        else:
            cv2.fillPoly(image, [ring], colour, line, SHIFT)


def _far_to_near(
    boxes: Float[np.ndarray, "b 7"],
    eye: Float[np.ndarray, "3"],
    low: Float[np.ndarray, "b 2"],
    high: Float[np.ndarray, "b 2"],
) -> list[int]:
    """Return an order in which no body is drawn after one that hides it.

    Args:
        boxes: of the bodies.
        eye: position of the camera.
        low, high: bounding boxes in the image; bodies whose boxes do not overlap need no order.
    """
    before = ~_cannot_hide(boxes, eye) & ((low[:, None] < high) & (low < high[:, None])).all(-1)
    # [i, j]: i may hide j and is drawn after it. If each may hide the other, distance decides.
    before &= ~before.T
    waits = before.sum(1)
    distance = np.hypot(boxes[:, 0] - eye[0], boxes[:, 1] - eye[1])
    left, order = np.ones(len(boxes), bool), []
    for _ in range(len(boxes)):
        # If bodies hide each other in a cycle, the farthest is drawn first.
        ready = left & (waits == 0)
        pick = int(np.argmax(np.where(ready if ready.any() else left, distance, -1.0)))
        order.append(pick)
        left[pick] = False
        waits -= before[:, pick]
    return order


def _cannot_hide(boxes: Float[np.ndarray, "b 7"], eye: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "b b"]:
    """Return [i, j]: some face of a box has i on one side, and j with the camera on the other."""
    count = len(boxes)
    turn = np.stack([np.cos(boxes[:, 4]), np.sin(boxes[:, 4])], -1)
    normal = np.stack([turn, -turn, turn[:, ::-1] * [-1, 1], turn[:, ::-1] * [1, -1]], 1)  # (b, 4, 2)
    reach = (np.abs(_SIDES) * boxes[:, None, 2:4]).sum(-1)  # from the middle to each face
    offset = (normal * boxes[:, None, :2]).sum(-1) + reach
    corners = footprints(boxes)
    lies = (normal.reshape(-1, 2) @ corners.reshape(-1, 2).T).reshape(count, 4, count, 4).min(-1)
    beyond = lies >= offset[..., None] - _SLACK  # [i, side, j]: j lies beyond that side of i
    outside = (normal @ eye[:2] > offset)[..., None]
    result = (beyond & outside).any(1)  # j and the camera lie beyond a face of i: i cannot hide j
    result |= (beyond & ~outside).any(1).T  # i lies beyond a face of j, the camera does not
    above = boxes[:, 5] >= boxes[:, None, 6] - _SLACK  # [i, j]: j lies above i
    higher = (eye[2] > boxes[:, 6])[:, None]
    return result | (above & higher) | (above & ~higher).T


def footprints(boxes: Float[np.ndarray, "b 7"]) -> Float[np.ndarray, "b 4 2"]:
    """Return the corners of upright boxes on the ground, counter-clockwise."""
    local = _CORNERS * boxes[:, None, 2:4]
    cos, sin = np.cos(boxes[:, 4])[:, None], np.sin(boxes[:, 4])[:, None]
    x, y = local[..., 0], local[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], -1) + boxes[:, None, :2]


def with_blobs(bodies: Bodies, eye: Float[np.ndarray, "3"]) -> Bodies:
    """Return the bodies with their blobs as polygons that face the camera, drawn after the body's own polygons."""
    count = len(bodies.blobs)
    if not count:
        return bodies
    away = bodies.blobs[:, :3] - eye
    away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-6)
    right = np.stack([away[:, 1], -away[:, 0], np.zeros(count)], -1)
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-6)
    up = np.cross(right, away)
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE + 1)[:-1]
    # A ragged outline like leaves; it depends on the blob alone, not on the direction of view.
    ragged = (
        1.0
        + 0.13 * np.sin(5.0 * angle + 90.0 * bodies.blobs[:, 3:])
        + 0.1 * np.sin(8.0 * angle + 230.0 * bodies.blobs[:, 2:3])
    )
    reach = (bodies.blobs[:, 3:] * ragged)[..., None]
    ring = np.cos(angle)[:, None] * right[:, None] + np.sin(angle)[:, None] * up[:, None]
    corners = (bodies.blobs[:, None, :3] + reach * ring).reshape(-1, 3)
    stops = len(bodies.corners) + _OUTLINE * np.arange(1, count + 1)
    return replace(
        bodies,
        corners=np.concatenate([bodies.corners, corners]),
        stops=np.concatenate([bodies.stops, stops]),
        colours=np.concatenate([bodies.colours, bodies.blob_colours]),
        light=np.concatenate([bodies.light, np.zeros(count)]),
        owner=np.concatenate([bodies.owner, bodies.blob_owner]),
        blobs=bodies.blobs[:0],
        blob_colours=bodies.blob_colours[:0],
        blob_owner=bodies.blob_owner[:0],
    )


def _lit(
    colours: Float[np.ndarray, "k 3"],
    normal: Float[np.ndarray, "k 3"],
    light: Float[np.ndarray, " k"],
    place: Float[np.ndarray, "k 3"],
    weather: Weather,
) -> Float[np.ndarray, "k 3"]:
    """Return display colours 0 to 255 of surfaces in the light and haze of the weather, with the ego's headlights."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    distance = np.linalg.norm(place[:, :2], axis=-1)
    lit = weather.ambient * (0.9 + 0.16 * unit[:, 2]) + 1.1 * weather.direct * np.maximum(unit @ weather.sun, 0.0)
    if weather.night:
        toward = place / np.maximum(np.linalg.norm(place, axis=-1, keepdims=True), 1e-9)
        beam = np.clip(2.0 * toward[:, 0] - 1.0, 0.0, 1.0) * np.exp(-((distance / HEADLIGHTS) ** 2))
        lit += 0.6 * weather.night * beam * np.maximum(-(unit * toward).sum(-1), 0.0)
    factor = np.where(light > 0.0, np.maximum(light, lit), lit)
    clear = np.exp(-distance / weather.visibility)[:, None]
    # Lamps are visible from farther away than lit surfaces.
    clear = np.where(light[:, None] > 0.5, np.sqrt(clear), clear)
    hazy = colours * factor[:, None] * clear + weather.horizon * (1.0 - clear)
    return np.round(255.0 * np.clip(hazy, 0.0, 1.0))


def _turned(points: Float[np.ndarray, "m 2"], pose: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "m 2"]:
    x, y, cos, sin = pose.T
    return np.stack([cos * points[:, 0] - sin * points[:, 1] + x, sin * points[:, 0] + cos * points[:, 1] + y], -1)


def polygon_starts(bodies: Bodies) -> Int[np.ndarray, " k"]:
    """Return the index of the first corner of each polygon."""
    return bodies.stops - _counts(bodies.stops)


def _counts(stops: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    return np.diff(stops, prepend=0)

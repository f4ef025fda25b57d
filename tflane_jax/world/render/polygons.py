"""Flat-coloured 3-D polygons: shading by weather, near clipping, and drawing from far to near (painter's algorithm)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from tflane_jax.world.render.camera import NEAR, PinholeCamera
from tflane_jax.world.render.faces import faces_of
from tflane_jax.world.render.weather import Weather

# cv2 takes corners as multiples of 1/16 pixel.
SHIFT = 4
_LIMIT = 8000.0
# How far the ego's headlights reach, metres.
HEADLIGHTS = 38.0


@dataclass
class Solid:
    """Polygons drawn together, in the order in which they were added.

    Attributes:
        distance: from the camera, metres; farther solids are drawn first.
        corners: (m, 3) each, ego frame, metres; counter-clockwise as seen from the visible side.
        colours: display values 0 to 1, one for each.
        light: 0 lit by the sun, 1 shines by itself, one for each.
    """

    distance: float = 0.0
    corners: list[np.ndarray] = field(default_factory=list)
    colours: list[tuple[float, float, float]] = field(default_factory=list)
    light: list[float] = field(default_factory=list)

    def add(self, corners: np.ndarray, colour: tuple[float, float, float], light: float = 0.0) -> None:
        """Add one polygon."""
        self.corners.append(np.asarray(corners, np.float64))
        self.colours.append(colour)
        self.light.append(light)


def draw_solids(
    image: UInt8[np.ndarray, "h w 3"], solids: Sequence[Solid], camera: PinholeCamera, weather: Weather
) -> None:
    """Draw solids into the image, the farthest first; polygons seen from behind are skipped."""
    import cv2

    ordered = sorted((solid for solid in solids if solid.corners), key=lambda solid: -solid.distance)
    if not ordered:
        return
    corners = [ring for solid in ordered for ring in solid.corners]
    points = np.concatenate(corners)
    stops = np.cumsum([len(ring) for ring in corners])
    starts = np.concatenate([[0], stops[:-1]])
    faces = faces_of(points, starts, camera, np.array([0.0, 0.0, camera.above_ground]))
    colours, light = (np.concatenate([getattr(solid, name) for solid in ordered]) for name in ("colours", "light"))
    colours = shade(colours, faces.normal, light, faces.corner, weather).tolist()
    fixed = fixed_point(faces.pixels)
    for number in faces.shown.tolist():
        part = slice(starts[number], stops[number])
        ring = fixed[part]
        if faces.near[number]:
            ring = fixed_point(camera.image_of(clipped(points[part], faces.depth[part]))[0])
        cv2.fillPoly(image, [ring], colours[number], cv2.LINE_AA, SHIFT)


def fixed_point(pixels: Float[np.ndarray, "m 2"]) -> Int[np.ndarray, "m 2"]:
    """Convert pixels, counted from the image corner, to cv2's fixed point: 1/16 pixel from the first pixel's center."""
    return np.round((np.clip(pixels, -_LIMIT, _LIMIT) - 0.5) * (1 << SHIFT)).astype(np.int32)


def clipped(points: Float[np.ndarray, "m 3"], depth: Float[np.ndarray, " m"]) -> Float[np.ndarray, "k 3"]:
    """Return the part of a polygon in front of the camera (Sutherland and Hodgman 1974)."""
    after, depth_after = np.roll(points, -1, 0), np.roll(depth, -1)
    inside = depth > NEAR
    crosses = inside != (depth_after > NEAR)
    fraction = np.where(crosses, (NEAR - depth) / np.where(crosses, depth_after - depth, 1.0), 0.0)
    cut = points + fraction[:, None] * (after - points)
    both = np.stack([points, cut], 1).reshape(-1, 3)
    return both[np.stack([inside, crosses], 1).ravel()]


def shade(
    colours: Float[np.ndarray, "k 3"],
    normal: Float[np.ndarray, "k 3"],
    light: Float[np.ndarray, " k"],
    place: Float[np.ndarray, "k 3"],
    weather: Weather,
) -> Float[np.ndarray, "k 3"]:
    """Return display colours (0 to 255) of surfaces under the light and haze of the weather."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    distance = np.linalg.norm(place[:, :2], axis=-1)
    sky = 0.8 + 0.2 * unit[:, 2]
    lit = weather.ambient * sky + 1.1 * weather.direct * np.maximum(unit @ weather.sun, 0.0)
    lit += weather.night * 0.5 * np.exp(-((distance / HEADLIGHTS) ** 2)) * np.maximum(-unit[:, 0], 0.0)
    factor = np.where(light > 0.0, np.maximum(light, lit), lit)
    clear = np.exp(-distance / weather.visibility)[:, None]
    hazy = colours * factor[:, None] * clear + weather.horizon * (1.0 - clear)
    return np.round(255.0 * np.clip(hazy, 0.0, 1.0))

"""Polygons of solids as a camera sees them: which face it, where in the image, how deep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.world.render.camera import NEAR, PinholeCamera


class Faces(NamedTuple):
    """F polygons as a camera sees them, whose C corners lie one after another.

    Attributes:
        starts: (F,) index of the first corner of each polygon.
        corner, normal: (F, 3) that corner and a normal, ego frame.
        towards: (F,) positive where the polygon's front faces the camera: (eye - corner) . normal.
        pixels, depth: (C, 2) and (C,) of the corners; pixels nearer than `NEAR` mean nothing.
        low, high: (F, 2) bounding boxes in the image.
        near: (F,) some corner is nearer than `NEAR`, so that the polygon must be clipped.
        shown: numbers of the polygons that face the camera and may be in the image.
    """

    starts: Int[np.ndarray, " f"]
    corner: Float[np.ndarray, "f 3"]
    normal: Float[np.ndarray, "f 3"]
    towards: Float[np.ndarray, " f"]
    pixels: Float[np.ndarray, "c 2"]
    depth: Float[np.ndarray, " c"]
    low: Float[np.ndarray, "f 2"]
    high: Float[np.ndarray, "f 2"]
    near: Bool[np.ndarray, " f"]
    shown: Int[np.ndarray, " s"]


def faces_of(
    corners: Float[np.ndarray, "c 3"], starts: Int[np.ndarray, " f"], camera: PinholeCamera, eye: Float[np.ndarray, "3"]
) -> Faces:
    """Return polygons as a camera sees them.

    Args:
        corners: of all polygons, one after another, counter-clockwise seen from their front, ego frame.
        starts: index of the first corner of each polygon; at least one.
        camera: that sees them.
        eye: its position in the ego frame.
    """
    corner = corners[starts]
    normal = np.cross(corners[starts + 1] - corner, corners[starts + 2] - corner)
    pixels, depth = camera.image_of(corners)
    low, high = np.minimum.reduceat(pixels, starts), np.maximum.reduceat(pixels, starts)
    nearest, farthest = np.minimum.reduceat(depth, starts), np.maximum.reduceat(depth, starts)
    near = nearest <= NEAR
    inside = ((high > 0.0) & (low < [camera.width, camera.height])).all(-1)
    towards = ((eye - corner) * normal).sum(-1)
    shown = np.flatnonzero((towards > 0.0) & (farthest > NEAR) & (inside | near))
    return Faces(starts, corner, normal, towards, pixels, depth, low, high, near, shown)

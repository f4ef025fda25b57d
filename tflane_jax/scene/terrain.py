"""Heights of the ground as a sum of waves: smooth, known everywhere, with an exact slope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Terrain:
    """The ground of a place, global metres.

    Attributes:
        waves: (n, 2) wave vectors, radians a metre.
        phase: (n,) radians.
        amplitude: (n,) metres.
    """

    waves: Float[np.ndarray, "n 2"]
    phase: Float[np.ndarray, " n"]
    amplitude: Float[np.ndarray, " n"]

    def height(self, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
        """Return the height of the ground at points, metres."""
        return np.sin(xy @ self.waves.T + self.phase) @ self.amplitude

    def slope(self, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Return the gradient of the height at points, metres a metre."""
        return (np.cos(xy @ self.waves.T + self.phase) * self.amplitude) @ self.waves

    def raised(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Return points of the level world moved up by the height of the ground below them."""
        return np.concatenate([points[..., :2], points[..., 2:] + self.height(points[..., :2])[..., None]], -1)

    def pose(self, xy: Float[np.ndarray, "*b 2"], yaw: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b 4 4"]:
        """Return the pose of a vehicle that stands on the ground with all wheels; `geometry.pose_yaw` gives its yaw."""
        slope = self.slope(xy)
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], -1)
        ahead = np.concatenate([ahead, (slope * ahead).sum(-1, keepdims=True)], -1)
        up = np.concatenate([-slope, np.ones_like(slope[..., :1])], -1)
        ahead, up = (axis / np.linalg.norm(axis, axis=-1, keepdims=True) for axis in (ahead, up))
        found = np.zeros((*xy.shape[:-1], 4, 4))
        found[..., :3, :3] = np.stack([ahead, np.cross(up, ahead), up], -1)
        found[..., :2, 3], found[..., 2, 3], found[..., 3, 3] = xy, self.height(xy), 1.0
        return found

"""Hilly ground in the cameras: the level scene, moved point by point onto the ground, and what each pixel sees of it.

The scene of a moment is drawn as on level ground. A point of it keeps its place on the map and moves up with the ground
below; then it is seen from the vehicle, which stands on the slope. Bodies move corner by corner. A pixel of the ground
is where its ray first meets the surface; its texture is that of the level ground there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import invert_pose, pose_yaw, transform_points, yaw_pose
from tflane_jax.scene.logs import Log
from tflane_jax.scene.terrain import Terrain
from tflane_jax.world.cameras.light import View
from tflane_jax.world.cameras.solids import Bodies
from tflane_jax.world.render.camera import PinholeCamera

# Distances along a ray at which it is compared with the ground: from one to the next by a fifteenth, metres.
_NEAREST, _FARTHEST, _GROWTH = 0.5, 250.0, 1.07
# Spacing of the heights between which rays are compared, metres.
_SPACING = 2.0


@dataclass(frozen=True, eq=False)
class Surface:
    """The ground around a vehicle.

    Attributes:
        terrain: global metres.
        global_from_level: pose of the vehicle on level ground.
        ego_from_level: from the level frame, whose origin is on the ground below the vehicle, to the ego frame.
    """

    terrain: Terrain
    global_from_level: Float[np.ndarray, "4 4"]
    ego_from_level: Float[np.ndarray, "4 4"]

    def heights(self, xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
        """Return heights at points of the level frame, above the vehicle's own ground, metres."""
        pose = self.global_from_level
        there = xy @ pose[:2, :2].T + pose[:2, 3]
        return self.terrain.height(there) - self.terrain.height(pose[:2, 3])

    def raised(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points of the level scene in the ego frame of the vehicle on the slope."""
        up = points[:, 2] + self.heights(points[:, :2])
        return transform_points(self.ego_from_level, np.column_stack([points[:, :2], up]))

    def bodies(self, level: Bodies) -> Bodies:
        """Return bodies of the level scene in the ego frame on the slope."""
        corners = self.raised(level.corners)
        blobs = np.column_stack([self.raised(level.blobs[:, :3]), level.blobs[:, 3]])
        boxes = level.boxes.copy()
        for end in (5, 6):
            boxes[:, end] = self.raised(level.boxes[:, [0, 1, end]])[:, 2]
        boxes[:, :2] = self.raised(level.boxes[:, [0, 1, 5]])[:, :2]
        # The box holds all corners.
        owner = np.repeat(level.owner, np.diff(level.stops, prepend=0))
        np.minimum.at(boxes[:, 5], owner, corners[:, 2])
        np.maximum.at(boxes[:, 6], owner, corners[:, 2])
        return replace(level, boxes=boxes, corners=corners, blobs=blobs)

    def hits(self, camera: PinholeCamera) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"], np.ndarray]:
        """Return where the rays of a camera's pixels first meet the ground, level frame, and which do.

        The third result are the rays (h, w, 3), level frame; all are float32.
        """
        level_from_camera = invert_pose(camera.camera_from_ego @ self.ego_from_level)
        turn = (level_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)).astype(np.float32)
        u, v = np.arange(camera.width) + np.float32(0.5), (np.arange(camera.height) + np.float32(0.5))[:, None]
        ray = np.stack([(row[0] * u + row[2]) + row[1] * v for row in turn], -1).astype(np.float32)
        ray /= np.maximum(np.hypot(ray[..., 0], ray[..., 1]), 1e-6)[..., None]
        eye = level_from_camera[:3, 3].astype(np.float32)
        ground = _Lattice.of(self)
        near, far = np.zeros(ray.shape[:2], np.float32), np.full(ray.shape[:2], np.inf, np.float32)
        above, below, distance = np.full(near.shape, eye[2]), np.zeros_like(near), _NEAREST
        while distance < _FARTHEST:
            open_ = np.isinf(far)
            gap = eye[2] + distance * ray[..., 2] - ground.at(eye[:2] + distance * ray[..., :2])
            met = open_ & (gap <= 0.0)
            far[met], below[met] = distance, gap[met]
            ahead = open_ & ~met
            near[ahead], above[ahead] = distance, gap[ahead]
            distance *= _GROWTH
        seen = np.isfinite(far)
        far = np.where(seen, far, _FARTHEST)
        # Between the two, ray and ground are nearly straight.
        reach = near + (far - near) * above / np.maximum(above - below, 1e-6)
        place = eye + reach[..., None] * ray
        return place, seen, ray

    def look(self, camera: PinholeCamera) -> View:
        """Return the rays and ground points of a camera's pixels, as `light.look` does for level ground.

        Ground points are those of the level scene; azimuth and elevation are against the horizon.
        """
        place, seen, ray = self.hits(camera)
        first = int(np.argmax(seen.any(1))) if seen.any() else camera.height
        part = slice(first, None)
        distance = np.hypot(place[part, :, 0], place[part, :, 1])
        depth = np.maximum(np.median(self.depth(camera, place, seen)[part], -1), 0.1)
        focal, eye = float(camera.intrinsics[0, 0]), camera.above_ground
        return View(
            camera,
            np.arctan2(ray[..., 1], ray[..., 0]),
            np.arctan2(ray[..., 2], np.float32(1.0)),
            first,
            np.where(seen, place[..., 0], 0.0)[part],
            np.where(seen, place[..., 1], 0.0)[part],
            np.where(seen[part], distance, np.float32(_FARTHEST)),
            np.where(seen[part], 255, 0).astype(np.uint8),
            depth / focal,
            depth**2 / (focal * eye),
            self.raised,
        )

    def depth(
        self, camera: PinholeCamera, place: Float[np.ndarray, "h w 3"], seen: Bool[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "h w"]:
        """Return the depth of hits along the optical axis, metres; that of pixels without ground is the farthest."""
        axis = (camera.camera_from_ego @ self.ego_from_level)[2]
        return np.where(seen, place @ axis[:3] + axis[3], _FARTHEST)


@dataclass(frozen=True)
class _Lattice:
    """Heights on a square lattice around the vehicle, level frame."""

    values: Float[np.ndarray, "n n"]

    @classmethod
    def of(cls, surface: Surface) -> _Lattice:
        reach = np.arange(-_FARTHEST - 10.0, _FARTHEST + 10.0 + _SPACING, _SPACING)
        x, y = np.meshgrid(reach, reach)
        return cls(surface.heights(np.stack([x, y], -1)).astype(np.float32))

    def at(self, xy: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w"]:
        """Return heights at points, bilinear."""
        import cv2

        cells = ((xy + np.float32(_FARTHEST + 10.0)) / np.float32(_SPACING)).astype(np.float32)
        return cv2.remap(self.values, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def surface_at(log: Log, global_from_ego: Float[np.ndarray, "4 4"]) -> Surface | None:
    """Return the ground around a vehicle of a log; None on level ground."""
    if log.relief is None:
        return None
    level = yaw_pose(global_from_ego[0, 3], global_from_ego[1, 3], pose_yaw(global_from_ego))
    ground = level.copy()
    ground[2, 3] = global_from_ego[2, 3]
    return Surface(log.relief.terrain, level, invert_pose(global_from_ego) @ ground)

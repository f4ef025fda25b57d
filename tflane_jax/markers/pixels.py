"""Markers detected in native images of the built-in world, as the vehicle of a log would detect them.

Only the parts of the images around the boards are drawn, because a ring of native images takes seconds: what a detector
finds elsewhere (nothing, see `benchmarks.marker_occlusion`) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.geometry import relative_pose
from tflane_jax.limits import Positive
from tflane_jax.markers.detection import DetectedMarkers, locate
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers, find_markers, joined
from tflane_jax.markers.square_pose import marker_outline
from tflane_jax.scene import CameraViews
from tflane_jax.scene.logs import KeyFrame, Log, PlacedMarkers
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig, draw_rig
from tflane_jax.world.cameras.sensor import render_window
from tflane_jax.world.render.camera import PinholeCamera

# Around a board, pixels, in addition to its own width; a board whose face is turned away farther cannot be read.
_AROUND, _FACING = 24, np.cos(np.deg2rad(80.0))


@dataclass(frozen=True)
class PixelConfig:
    """Cameras and detector.

    Attributes:
        rig: cameras of an example without images of its own; an example with cameras is searched in those, at native
            size.
        detector: settings; the size of the boards comes from the store, as do their ids where it names none.
        range: boards farther from the vehicle are not drawn, metres.
    """

    rig: CameraRigConfig = CameraRigConfig(cameras=ARGOVERSE2_RING[:3], scale=1.0, markers=True)
    detector: DetectorConfig = DetectorConfig(search="all")
    range: Positive = 70.0

    def native(self, cameras: CameraRigConfig | None) -> CameraRigConfig:
        """Return the cameras in which boards are searched, for an example with these cameras."""
        return replace(cameras or self.rig, scale=1.0, multiple=1, markers=True, depth_cell=None)


def detect_in_world(
    log: Log, moment: KeyFrame, markers: PlacedMarkers, rig: CameraRigConfig, config: PixelConfig
) -> DetectedMarkers:
    """Return the markers that the detector finds in the native images of a moment of a log.

    Args:
        log: of the built-in world, whose boards are drawn.
        moment: any moment of it.
        markers: its markers.
        rig: from `PixelConfig.native`.
        config: detector and range.

    Raises UserError for a log without drawn boards, for example of real data.
    """
    if log.markers is None:
        raise UserError(
            f"{log.name} has no boards in images: markers from pixels need the built-in world; simulate them "
            "(MarkerConfig.pixels = None), or use tflane markers run for images of a real drive"
        )
    sizes = dict.fromkeys(np.asarray(markers.marker_id).tolist(), float(markers.size))
    detector = config.detector
    if detector.ids is None:
        detector = replace(detector, ids=tuple(sorted(sizes)))
    cameras = draw_rig(log.seed, rig)
    poses = relative_pose(moment.global_from_ego, markers.pose)
    near = np.flatnonzero(np.linalg.norm(poses[:, :2, 3], axis=-1) <= config.range)
    found = []
    for number, camera in enumerate(cameras):
        parts = []
        for pose in poses[near]:
            window = _window(pose, markers.size, camera, detector)
            if window is not None:
                corner, size = window
                pixels = render_window(log, moment, rig, corner, size, camera=number)
                parts.append(_shifted(find_markers(pixels, detector), corner))
        found.append(joined(parts))
    return locate(_empty_views(cameras), found, detector, sizes)


def _window(
    pose: Float[np.ndarray, "4 4"], size: float, camera: PinholeCamera, detector: DetectorConfig
) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Return corner and size of the part of the image around a board, None where it cannot be read."""
    seen = camera.camera_from_ego @ pose
    sight = seen[:3, 3] / np.linalg.norm(seen[:3, 3])
    if seen[2, 3] < size or -seen[:3, 2] @ sight < _FACING:
        return None
    outline = marker_outline(pose, size, camera.intrinsics, camera.camera_from_ego)
    inside = ((outline > 0.0) & (outline < [camera.width, camera.height])).all(-1)
    around = _AROUND + (outline.max(0) - outline.min(0)).max()
    if not inside.any() or around - _AROUND < 0.5 * detector.least_pixels:
        return None
    low = np.maximum(np.floor(outline.min(0) - around), 0.0).astype(int)
    high = np.minimum(np.ceil(outline.max(0) + around), [camera.width, camera.height]).astype(int)
    (left, top), (width, height) = low.tolist(), (high - low).tolist()
    return (left, top), (width, height)


def _shifted(found: ImageMarkers, corner: tuple[int, int]) -> ImageMarkers:
    return found._replace(corners=found.corners + np.array(corner))


def _empty_views(cameras: tuple[PinholeCamera, ...]) -> CameraViews:
    """Return the calibration of the cameras, without pixels."""
    return CameraViews(
        image=np.zeros((len(cameras), 1, 1, 3), np.uint8),
        size=np.array([[camera.width, camera.height] for camera in cameras], np.int32),
        intrinsics=np.stack([camera.intrinsics for camera in cameras]).astype(np.float32),
        camera_from_ego=np.stack([camera.camera_from_ego for camera in cameras]).astype(np.float32),
        valid=np.ones(len(cameras), bool),
    )

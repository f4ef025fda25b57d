"""Markers found in images, kept on disk: an image is searched once for each detector."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from tflane_jax.datasets.cache import cache_root
from tflane_jax.datasets.source_digest import source_digest
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.files.fields import load_json, member, numbers
from tflane_jax.markers.image_search import DetectorConfig, ImageMarkers, find_markers
from tflane_jax.scene import CameraViews


def search_views(views: CameraViews, config: DetectorConfig, root: Path | None = None) -> list[ImageMarkers]:
    """Return the markers in each valid view, as `find_markers` gives them, from the cache where possible.

    Args:
        views: images of one frame, at native size.
        config: the detector.
        root: folder of the cache, default `cache_root()`/markers.

    Raises UserError without OpenCV, for an invalid config, or if the cache cannot be written.
    """
    root = cache_root() / "markers" if root is None else root
    found = []
    for number in np.flatnonzero(np.asarray(views.valid)).tolist():
        width, height = np.asarray(views.size[number]).tolist()
        found.append(_searched(np.asarray(views.image[number])[:height, :width], config, root))
    return found


def _searched(image: UInt8[np.ndarray, "h w 3"], config: DetectorConfig, root: Path) -> ImageMarkers:
    digest = hashlib.sha256(np.ascontiguousarray(image).tobytes())
    digest.update(f"{image.shape} {config!r} {source_digest()}".encode())
    path = root / f"{digest.hexdigest()[:32]}.json"
    if path.is_file():
        # A damaged entry is made again.
        with contextlib.suppress(UserError):
            return _read(path)
    found = find_markers(image, config)
    write_json(path, {name: np.asarray(column).tolist() for name, column in found._asdict().items()})
    return found


def _read(path: Path) -> ImageMarkers:
    record, where = load_json(path), str(path)
    corners = numbers(member(record, "corners", where), (None, 4, 2), where)
    ids, wrong = (numbers(member(record, name, where), (len(corners),), where) for name in ("marker_id", "wrong_bits"))
    return ImageMarkers(ids.astype(int), corners, wrong.astype(int))

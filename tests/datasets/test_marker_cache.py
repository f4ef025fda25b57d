"""Searching an image once."""

from dataclasses import replace

import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo, pose, views
from tflane_jax.datasets import marker_cache
from tflane_jax.datasets.marker_cache import search_views
from tflane_jax.markers.image_search import DetectorConfig, find_markers

pytest.importorskip("cv2")


def test_an_image_is_searched_once_for_each_detector(tmp_path, monkeypatch):
    seen, config = views((AHEAD, photo(AHEAD, {7: pose(9.0, 1.0, 2.0)}))), DetectorConfig()
    calls = []

    def counted(image, settings):
        calls.append(settings)
        return find_markers(image, settings)

    monkeypatch.setattr(marker_cache, "find_markers", counted)
    (first,), (again,) = search_views(seen, config, tmp_path), search_views(seen, config, tmp_path)
    assert first.marker_id.tolist() == again.marker_id.tolist() == [7]
    np.testing.assert_array_equal(first.corners, again.corners)
    assert len(calls) == 1
    search_views(seen, replace(config, corners="none"), tmp_path)
    search_views(seen.replace(image=255 - seen.image), config, tmp_path)
    assert len(calls) == 3
    assert search_views(seen.replace(valid=np.array([False])), config, tmp_path) == []
    # A damaged entry is made again.
    for path in tmp_path.iterdir():
        path.write_text("{")
    assert search_views(seen, config, tmp_path)[0].marker_id.tolist() == [7]
    assert len(calls) == 4

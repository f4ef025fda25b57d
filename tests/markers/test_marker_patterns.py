"""Families of markers: cells and correctable bits."""

import numpy as np
import pytest

from tflane_jax.scene.marker_patterns import MarkerFamily, correctable_bits, dictionary_of, marker_cells, marker_count

cv2 = pytest.importorskip("cv2")

# OpenCV's own figures of these families depend on its version.
FAMILIES = [family for family in MarkerFamily if family.name.startswith("APRILTAG")]
FAMILIES.append(MarkerFamily.ARUCO_MIP_36H12)


@pytest.fixture
def older_opencv(monkeypatch):
    """Let no family of OpenCV correct any bit."""
    predefined = cv2.aruco.getPredefinedDictionary

    def without_corrections(name):
        dictionary = predefined(name)
        dictionary.maxCorrectionBits = 0
        return dictionary

    monkeypatch.setattr(cv2.aruco, "getPredefinedDictionary", without_corrections)
    dictionary_of.cache_clear()
    yield
    dictionary_of.cache_clear()


@pytest.mark.usefixtures("older_opencv")
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_correctable_bits_follow_from_the_least_distance_in_any_opencv(family):
    cells = np.stack([marker_cells(family, i)[1:-1, 1:-1] for i in range(marker_count(family))])
    turned = np.stack([np.rot90(cells, turns, (1, 2)) for turns in range(4)]).reshape(4, len(cells), -1)
    flat = cells.reshape(len(cells), -1)
    different = np.where(flat, 1.0, -1.0) @ np.where(turned, 1.0, -1.0).swapaxes(1, 2)
    distance = (flat.shape[1] - different) / 2.0
    distance[0, np.arange(len(cells)), np.arange(len(cells))] = np.inf  # a marker and itself
    assert correctable_bits(family) == (distance.min() - 1) // 2


@pytest.mark.usefixtures("older_opencv")
def test_the_original_family_has_newer_opencvs_figure():
    # Some of its ids look alike when they are turned, so that no figure follows from distances.
    assert correctable_bits(MarkerFamily.ARUCO_ORIGINAL) == 1


def test_all_other_families_have_opencvs_figure():
    for family in set(MarkerFamily) - {MarkerFamily.ARUCO_ORIGINAL, *FAMILIES}:
        figure = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family.value)).maxCorrectionBits
        assert correctable_bits(family) == figure

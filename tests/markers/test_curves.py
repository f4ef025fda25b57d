"""Detection curves over distance: the scenes, and the summary rows of their sightings."""

from dataclasses import replace

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose
from tflane_jax.markers.curves import CurveConfig, Sighting, measure, street, summarise
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.scene.marker_patterns import MarkerFamily

pytest.importorskip("cv2")

SMALL = CurveConfig(distances=(7.0, 12.0), turns=(0.0, 30.0), seeds=1, scale=0.3, severity=0.0)


def test_the_street_has_a_key_frame_at_each_distance_from_upright_boards():
    config = CurveConfig(distances=(10.0, 35.0, 5.0))
    log = street(3, config)
    for keyframe, distance in zip(log.keyframes, config.distances, strict=True):
        poses = invert_pose(keyframe.global_from_ego) @ log.markers.pose
        np.testing.assert_allclose(poses[:, 0, 3] - config.mounts[0].x, distance, atol=1e-9)
        np.testing.assert_allclose(poses[:, :3, 1], [[0.0, 0.0, 1.0]] * 3, atol=1e-12)
        turns = np.rad2deg(np.arccos(-poses[:, 0, 2]))
        np.testing.assert_allclose(np.sort(turns), config.turns, atol=1e-5)
        assert (poses[:, 1, 3] < -2.5).all()
    assert len(set(log.markers.marker_id)) == 3


def test_boards_are_found_at_their_places_by_each_detector():
    ways = [replace(SMALL, detector=DetectorConfig(corners=how)) for how in ("pattern", "subpixel")]
    pattern, subpixel = measure(ways)
    assert len(pattern) == len(subpixel) > 1
    assert all(a.found and b.found for a, b in zip(pattern, subpixel, strict=True))
    assert [(a.turn, a.distance, a.pixels) for a in pattern] == [(b.turn, b.distance, b.pixels) for b in subpixel]
    assert max(np.linalg.norm(sighting.translation) for sighting in pattern) < 0.1
    assert max(sighting.rotation for sighting in pattern) < 2.0
    other = replace(SMALL, detector=DetectorConfig(MarkerFamily.APRILTAG_36H11))
    (tags,) = measure([replace(other, distances=(7.0,))])
    assert all(tag.found for tag in tags)


def test_rows_summarise_the_sightings():
    here = [
        Sighting(0, 0.0, 10.0, True, 50.0, np.array([3.0, 4.0, 0.0]), 1.0, 30.0, 0.1, 0.2),
        Sighting(0, 0.0, 10.0, True, 70.0, np.array([-1.0, 0.0, 0.0]), 40.0, 2.0, 0.3, 0.9),
        Sighting(1, 0.0, 10.0, False, 30.0),
        Sighting(1, 0.0, 40.0, False, 10.0),
    ]
    near, far = summarise(here)
    assert (near["boards"], near["pixels"], near["wrong pose"]) == (3, 50.0, 0.5)
    assert near["found"] == pytest.approx(2 / 3)
    assert near["translation m"] == pytest.approx(3.0)
    assert near["forward m"] == pytest.approx(np.sqrt(5.0))
    assert near["sideways m"] == pytest.approx(np.sqrt(8.0))
    assert near["rotation median"] == pytest.approx(20.5)
    assert far["found"] == 0.0
    assert np.isnan(far["translation m"])
    assert summarise([]) == []


@pytest.mark.parametrize(
    "config",
    [
        replace(SMALL, distances=()),
        replace(SMALL, distances=(0.5,)),
        replace(SMALL, seeds=0),
        replace(SMALL, turns=()),
        replace(SMALL, mounts=()),
    ],
)
def test_invalid_configs_are_refused(config):
    with pytest.raises(UserError, match=r"CurveConfig\.\w+ is"):
        measure([config])


def test_detectors_are_compared_on_the_same_scenes():
    with pytest.raises(UserError, match="same scenes"):
        measure([SMALL, replace(SMALL, seeds=2)])
    assert measure([]) == []

"""Markers found in native images of the built-in world, as the prior of an example."""

from dataclasses import replace

import numpy as np
import pytest

from tests.markers.test_simulation import markers_at, standing
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.marker_observations import marker_observations, store_of_log
from tflane_jax.errors import UserError
from tflane_jax.limits import SettingError
from tflane_jax.markers.image_search import DetectorConfig, find_markers
from tflane_jax.markers.observe import observe
from tflane_jax.markers.pixels import PixelConfig, detect_in_world
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig

pytest.importorskip("cv2")

# The front camera alone, at a third of its size: a board at 14 m is 42 pixels wide.
CAMERAS = CameraRigConfig(cameras=ARGOVERSE2_RING[:1], scale=0.1, severity=0.0)

PIXELS = PixelConfig(detector=DetectorConfig())  # whole boards, which are found faster


@pytest.fixture(scope="module")
def scene():
    """A vehicle that stands for six frames (0.1 s apart) before a board 14 m away; another one is out of reach."""
    return replace(standing(6, seed=4), markers=markers_at(14.0, 90.0))


def test_the_short_form_names_the_default_settings():
    assert ExampleConfig(markers="pixels") == ExampleConfig(markers=MarkerConfig(pixels=PixelConfig()))  # pyright: ignore
    with pytest.raises(SettingError, match="markers is 'pixel': it must be a MarkerConfig, 'pixels' or None"):
        ExampleConfig(markers="pixel")  # pyright: ignore
    assert ExampleConfig().markers is None
    native = PixelConfig().native(CAMERAS)
    assert (native.scale, native.cameras, native.markers) == (1.0, CAMERAS.cameras, True)


def test_the_prior_of_an_example_is_the_composition_of_its_parts(scene, monkeypatch):
    config = MarkerConfig(pixels=PIXELS, simulation=MarkerSimulationConfig(first_residual=50.0))
    small = replace(CAMERAS, scale=0.33, markers=True)
    monkeypatch.setattr(PixelConfig, "native", lambda self, cameras: small)  # a native image takes seconds
    found = marker_observations(scene, 5, config, ExampleConfig().range, bike_lanes=True, cameras=CAMERAS)
    now, before = (detect_in_world(scene, scene.keyframes[k], scene.markers, small, config.pixels) for k in (5, 0))
    expected = observe(
        now,
        store_of_log(scene, radius=config.radius, bike_lanes=True),
        ExampleConfig().range,
        markers=config.markers,
        lanes=config.lanes,
        points=config.points,
        previous=before,
        now_from_previous=np.eye(4),
        first_residual=50.0,
    ).markers
    for name in ("marker_id", "pose", "residual", "lanes", "lane_valid", "valid"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert found.valid.tolist() == [True, False]
    np.testing.assert_allclose(found.pose[0, :3, 3], [14.0, 0.0, 3.0], atol=0.2)
    assert found.residual[0] < 0.5


def test_a_moment_between_key_frames_can_be_drawn(scene):
    """As the key frame at the same time, but for noise."""
    config, rig = PIXELS, replace(CAMERAS, scale=0.33, markers=True)
    late = replace(scene, keyframes=scene.keyframes[5:])
    poses = [detect_in_world(one, scene.keyframes[5], scene.markers, rig, config).pose[0] for one in (late, scene)]
    np.testing.assert_allclose(poses[0], poses[1], atol=0.05)


@pytest.mark.parametrize(("named", "searched"), [(None, (0, 1)), ((1, 5), (1, 5))])
def test_boards_are_searched_by_the_ids_of_the_store_unless_others_are_named(scene, monkeypatch, named, searched):
    given, rig = [], replace(CAMERAS, scale=0.33, markers=True)

    def find(image, detector):
        given.append(detector.ids)
        return find_markers(image, detector)

    monkeypatch.setattr("tflane_jax.markers.pixels.find_markers", find)
    config = PixelConfig(detector=DetectorConfig(ids=named))
    assert scene.markers.marker_id.tolist() == [0, 1]
    detect_in_world(scene, scene.keyframes[5], scene.markers, rig, config)
    assert set(given) == {searched}


def test_logs_without_boards_in_images_are_refused(scene):
    with pytest.raises(UserError, match="tflane markers run"):
        detect_in_world(replace(scene, markers=None), scene.keyframes[0], scene.markers, CAMERAS, PixelConfig())

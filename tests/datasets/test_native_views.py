"""Native images at the sizes that a trained model reads."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo, pose, views
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.native_views import CameraNamesWarning, camera_names, check_camera_names, fitted_views
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.datasets.view_images import ImageConfig, fit_image
from tflane_jax.errors import UserError
from tflane_jax.geometry.cameras import project
from tflane_jax.world.cameras.ring import CameraMount, CameraRigConfig

pytest.importorskip("cv2")

MOUNT = CameraMount("front", 0.0, 0.0, 1.5, 0.0, 0.0, 900.0, 960, 540)


def world(*mounts, **more):
    return ProceduralConfig(example=ExampleConfig(sensor=None, cameras=CameraRigConfig(cameras=mounts, **more)))


@pytest.fixture(scope="module")
def native():
    return views((AHEAD, photo(AHEAD, {3: pose(12.0, 1.0, 2.0)})))


def test_images_are_scaled_and_padded_like_the_rigs(native):
    small = fitted_views(native, world(MOUNT, scale=0.25, multiple=16))
    small.validate()
    assert small.image.shape == (1, 144, 240, 3)  # 135 rows, padded to a multiple of 16
    assert small.size.tolist() == [[240, 135]]
    assert not small.image[0, 135:].any()
    point = np.array([[12.0, 1.0, 2.0]])
    pixel, reduced = (
        project(point, np.asarray(v.intrinsics[0], np.float64), np.asarray(v.camera_from_ego[0], np.float64))[0][0]
        for v in (native, small)
    )
    np.testing.assert_allclose(reduced, pixel / 4.0, atol=1e-3)
    # Pixels are averages of the native ones.
    block = np.asarray(native.image[0], float).reshape(135, 4, 240, 4, 3).mean((1, 3))
    assert np.abs(small.image[0, :135] - block).max() <= 1.0


def test_a_missing_image_stays_missing(native):
    nothing = fitted_views(native.replace(valid=np.array([False])), world(MOUNT, scale=0.25))
    assert nothing.valid.tolist() == [False]
    assert not nothing.image.any()


def openlane(native, cameras=7):
    """Return a source whose images are read from files, and the images of a drive."""
    image = ImageConfig(front_rows=(100, 500), scale=0.5, divisor=32)
    stacked = jax.tree.map(lambda leaf: np.concatenate([leaf] * cameras), native)
    return stacked, OpenLaneV2Config(Path("data"), image=image)


def test_images_fit_the_settings_of_a_dataset(native):
    fitted = fitted_views(*openlane(native))
    assert fitted.size.tolist() == [[480, 200], *[[480, 270]] * 6]
    assert fitted.image.shape == (7, 288, 480, 3)


def test_a_drive_needs_the_cameras_of_the_dataset_and_an_image_in_each_frame(native):
    with pytest.raises(UserError, match=r"trained with 7 cameras \(ring_front_center, .*the drive has 6"):
        fitted_views(*openlane(native, 6))
    views, source = openlane(native)
    one = views.replace(valid=np.arange(7) == 3)
    assert fitted_views(one, source).valid.tolist() == one.valid.tolist()
    assert fitted_views(one, source).image.shape == fitted_views(views, source).image.shape  # one program for both
    nothing = views.replace(valid=np.zeros(7, bool))
    assert not fitted_views(nothing, source).valid.any()
    with pytest.raises(UserError, match="no image of any camera"):
        fitted_views(nothing.replace(size=np.zeros((7, 2), np.int32)), source)


@pytest.mark.parametrize("change", [{"scale": 0.7}, {"scale": 0.4}, {"scale": 0.3, "shrink": "bilinear"}])
def test_images_are_resized_as_those_of_the_training(native, change):
    config = replace(openlane(native)[1].image, front_size=(900, 700), **change)
    views, source = openlane(native)
    fitted = fitted_views(views, replace(source, image=config))
    for number in (0, 1):
        fit = fit_image(960, 540, config, front=number == 0)
        expected = fit.image(np.asarray(native.image[0]))
        width, height = fit.size
        np.testing.assert_array_equal(fitted.image[number, :height, :width], expected)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (world(MOUNT, MOUNT, scale=0.25), "trained with 2 cameras"),
        (world(CameraMount("front", 0.0, 0.0, 1.5, 0.0, 0.0, 900.0, 960, 300), scale=0.25), "crop them first"),
        (ProceduralConfig(), "leave --model out"),
    ],
)
def test_models_that_these_images_do_not_suit_are_refused(native, source, message):
    with pytest.raises(UserError, match=message):
        fitted_views(native, source)


def test_a_camera_whose_images_do_not_fit_is_refused_before_it_has_one(native):
    """Its size is known from the calibration or from a later frame."""
    absent = native.replace(valid=np.array([False]), size=np.array([[960, 700]]))
    with pytest.raises(UserError, match="images of camera front are 960 x 700 pixels, which does not fit"):
        fitted_views(absent, world(MOUNT, scale=0.25))


@pytest.mark.parametrize(
    "source",
    [
        world(MOUNT, replace(MOUNT, name="left"), replace(MOUNT, name="right")),
        OpenLaneV2Config(Path("nowhere"), subset="B"),
    ],
)
def test_cameras_in_another_order_are_refused(source):
    """They would be taken for each other without a word."""
    names = camera_names(source)
    assert len(names) == (3 if "left" in names else 6)
    check_camera_names(names, source)
    check_camera_names(names[:-1], source)  # their number is an error of the images
    swapped = (names[0], names[2], names[1], *names[3:])
    with pytest.raises(UserError, match=f"the drive has the cameras {names[0]}, {names[2]}.* give them in this order"):
        check_camera_names(swapped, source)
    with pytest.warns(CameraNamesWarning, match=f"cameras a, .* are taken for the model's {names[0]}"):
        check_camera_names(("a", *names[1:]), source)


def test_a_model_of_evidence_has_no_cameras():
    assert camera_names(ProceduralConfig()) == ()

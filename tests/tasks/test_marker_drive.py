"""A drive with a model: equal to the model's own steps on the same examples."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo
from tests.markers.test_reader import BOARDS, SECOND, STORE, ego
from tests.models.cases import CAMERA_TOPONET, make_camera_example
from tests.models.test_marker_fusion import CONFIG
from tests.parameters import random_params
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.native_views import fitted_views
from tflane_jax.datasets.openlane_example import blank
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import relative_pose
from tflane_jax.markers.reader import MarkerReader, ReaderConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.scene import CameraViews
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.tasks.marker_drive import DriveModel, MarkerDrive, check_model
from tflane_jax.world.cameras.ring import CameraMount, CameraRigConfig

pytest.importorskip("cv2")

FRONT = CameraMount("front", 0.0, 0.0, 1.5, 0.0, 0.0, 900.0, 960, 540)


def two_views(x):
    """Return the images of two cameras, the second one as the first."""
    here = {number: relative_pose(ego(x), place[None])[0] for number, place in BOARDS.items()}
    image = photo(AHEAD, here)
    return CameraViews(
        image=np.stack([image, image]),
        size=np.array([[960, 540]] * 2, np.int32),
        intrinsics=np.stack([AHEAD.intrinsics] * 2).astype(np.float32),
        camera_from_ego=np.stack([AHEAD.camera_from_ego] * 2).astype(np.float32),
        valid=np.ones(2, bool),
    )


def test_a_model_of_photos_is_refused():
    with pytest.raises(UserError, match="single photos"):
        check_model(LaneShapeTask())


@pytest.mark.slow
def test_a_drive_with_a_model_is_the_composition_of_its_parts():
    model = replace(CAMERA_TOPONET, denoising=None, priors=PriorsConfig(markers=CONFIG))
    task = LaneGraphTask(model)
    rig = CameraRigConfig(cameras=(FRONT, replace(FRONT, name="again")), scale=0.1, multiple=32)
    source = ProceduralConfig(example=ExampleConfig(range=model.range, sensor=None, cameras=rig))
    params = random_params(task.init, make_camera_example())
    config = ReaderConfig(range=model.range)
    drive, reader = (
        MarkerDrive(MarkerReader(STORE, config), DriveModel(task, params, source)),
        MarkerReader(STORE, config),
    )
    step, memory = jax.jit(task.step), task.start()
    for number, x in enumerate((0.0, 4.0)):
        views, time = two_views(x), number * SECOND // 2
        found = drive.step(views, time, ego(x))
        example = replace(
            blank(source.example, governed="lanes", views=fitted_views(views, source), traffic=True),
            markers=reader.read(views, time, ego(x)).observed.markers,
            previous_from_ego=relative_pose(ego(max(x - 4.0, 0.0)), ego(x)).astype(np.float32),
            has_previous=np.asarray(number > 0),
        )
        memory, expected = step(params, memory, example)
        assert found.prediction is not None
        np.testing.assert_allclose(found.prediction.centerlines.points, expected.centerlines.points, atol=1e-4)
        assert set(found.reading.observed.outcomes) == {3, 8}
        assert not found.remembered

"""A drive with a model: equal to the model's own steps on the same examples."""

import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo
from tests.markers.test_reader import BOARDS, SECOND, STORE, ego, seen_from
from tests.models.cases import CAMERA_TOPONET, make_camera_example
from tests.models.test_marker_fusion import CONFIG
from tests.parameters import random_params
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.drive_files import Drive, DriveCamera, DriveFrame, thinned
from tflane_jax.datasets.native_views import fitted_views
from tflane_jax.datasets.openlane_example import blank
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import relative_pose
from tflane_jax.markers.reader import MarkerReader, ReaderConfig
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.marker_fusion import uniform_fusion
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.sd_map_encoder import SMALL_SD_MAP
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.scene import CameraViews
from tflane_jax.tasks import marker_drive
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.tasks.marker_drive import (
    SHOWN,
    DriveModel,
    FrameRateWarning,
    MarkerDrive,
    MissingPriorWarning,
    as_trained,
    check_model,
    check_rate,
)
from tflane_jax.world.cameras.ring import CameraMount, CameraRigConfig
from tflane_jax.world.simulate import WorldConfig

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


def test_priors_that_a_drive_lacks_are_warned_of():
    def task(**priors):
        return LaneGraphTask(replace(CAMERA_TOPONET, priors=PriorsConfig(**priors)))

    check_model(task(markers=CONFIG))
    with pytest.warns(MissingPriorWarning, match="reads no markers: .* its own lanes do not depend on them"):
        check_model(task())
    with pytest.warns(MissingPriorWarning, match="reads an SD map, and a drive has none"):
        check_model(task(markers=CONFIG, sd_map=SMALL_SD_MAP))
    with pytest.warns(MissingPriorWarning, match="reads an SD map and traffic flow"):
        check_model(task(markers=CONFIG, sd_map=SMALL_SD_MAP, traffic_flow=TrafficFlowConfig()))


@pytest.mark.slow
def test_a_drive_with_a_model_is_the_composition_of_its_parts():
    model = replace(CAMERA_TOPONET, denoising=None, priors=PriorsConfig(markers=CONFIG))
    task = LaneGraphTask(model, clip=2)
    rig = CameraRigConfig(cameras=(FRONT, replace(FRONT, name="again")), scale=0.1, multiple=32)
    source = ProceduralConfig(example=ExampleConfig(range=model.range, sensor=None, cameras=rig))
    params = random_params(replace(task, clip=1).init, make_camera_example())
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


class Remembering:
    """A task that predicts the number of frames in its memory, -1 without a memory."""

    model = SimpleNamespace(priors=PriorsConfig(markers=SHOWN), spec=CAMERA_TOPONET.spec)

    def __init__(self, streams):
        self.streams = streams

    def start(self):
        return jnp.zeros((), int)

    def step(self, params, memory, example):
        return (jnp.zeros((), int), jnp.asarray(-1)) if memory is None else (memory + 1, memory)


@pytest.mark.parametrize(("streams", "frames"), [(False, [-1, -1]), (True, [0, 1])])
def test_a_model_of_single_frames_has_no_memory(monkeypatch, streams, frames):
    """Its BEV features and markers of earlier frames are none that it has learned to use."""
    monkeypatch.setattr(marker_drive, "fitted_views", lambda views, source: views)
    model = DriveModel(Remembering(streams), {}, ProceduralConfig())  # pyright: ignore
    drive = MarkerDrive(MarkerReader(STORE), model)
    seen, gap = (drive.step(seen_from(x, boards), i, ego(x)) for i, (x, boards) in enumerate([(0.0, None), (4.0, {})]))
    assert [int(frame.prediction) for frame in (seen, gap)] == frames  # pyright: ignore
    assert seen.guidance.valid.any()
    assert gap.guidance.valid.any() == gap.remembered == streams


def test_a_pause_longer_than_the_memory_is_a_new_start():
    """Six frames half a second apart fit into the memory: 3 s."""
    for pause, remembered in ((3.0, True), (3.5, False)):
        drive = MarkerDrive(MarkerReader(STORE))
        seen, gap = (
            drive.step(seen_from(x, boards), round(time * SECOND), ego(x))
            for x, boards, time in ((0.0, None, 0.0), (4.0, {}, pause))
        )
        assert seen.guidance.valid.any()
        assert (gap.remembered, bool(gap.guidance.valid.any())) == (remembered, remembered)


@pytest.mark.parametrize("interval", [None, 0.5])
def test_residuals_do_not_compare_across_a_pause(interval):
    """Regression: with `residual_interval=None` the frame before the pause counted, wherever the vehicle was then."""
    for pause, compared in ((2.0, interval is None), (1000.0, False)):
        drive = MarkerDrive(MarkerReader(STORE, ReaderConfig(residual_interval=interval)))
        drive.step(seen_from(0.0), 0, ego(0.0))
        after = drive.step(seen_from(0.0), round(pause * SECOND), ego(500.0))  # the boards have moved along, too
        residual = np.asarray(after.reading.observed.markers.residual)
        assert (residual.max() > 400.0) == compared


@pytest.mark.parametrize(
    ("fusion", "trust", "gate"),
    [
        (SHOWN, np.exp(-6.0), np.exp(-6.0)),
        (uniform_fusion(SHOWN), 1.0, 1.0),
        (replace(SHOWN, fusion="hard"), np.exp(-6.0), 0.0),  # ignored, as by the model
    ],
)
def test_a_distrusted_board_is_shown_as_the_model_takes_it(monkeypatch, fusion, trust, gate):
    """A board with a residual of 60 m, in the first frame: no lanes are remembered."""
    monkeypatch.setattr(marker_drive, "SHOWN", fusion)
    board = {3: BOARDS[3]}
    frame = MarkerDrive(MarkerReader(STORE, ReaderConfig(first_residual=60.0))).step(seen_from(0.0, board), 0, ego(0.0))
    far = np.exp(-np.hypot(20.0, 5.0) / 40.0) if trust < 1.0 else 1.0
    assert frame.confidence.tolist() == [pytest.approx(trust * far, rel=0.01), 0.0]
    assert float(frame.guidance.gate) == pytest.approx(gate * far, rel=0.01)
    assert frame.guidance.valid.any() == (gate > 0.0)
    assert not frame.remembered


def test_another_drive_starts_without_the_memory_of_the_last_one():
    drive = MarkerDrive(MarkerReader(STORE))
    drive.step(seen_from(0.0), SECOND, ego(0.0))
    drive.restart(MarkerReader(STORE))
    assert not drive.step(seen_from(0.0, {}), 0, ego(0.0)).guidance.valid.any()


@pytest.mark.parametrize(("seconds", "warns"), [(0.1, True), (0.26, False), (0.5, False), (0.74, False), (0.8, True)])
def test_frames_at_another_rate_than_in_training_are_warned_of(seconds, warns):
    times = (np.arange(6) * seconds * SECOND).astype(np.int64)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_rate(times.tolist(), 0.5, 0.5)
        check_rate([*times[times < 0], 0, SECOND // 2, SECOND, 60 * SECOND], 0.5, 0.5)  # a pause is no rate
        check_rate([0], 0.5, 0.5)
    assert [warning.category for warning in found] == [FrameRateWarning] * warns
    # A drive can be thinned only.
    assert all(("--interval" in str(warning.message)) == (seconds < 0.5) for warning in found)


@pytest.mark.parametrize(("seconds", "interval", "warns"), [(0.8, 0.5, True), (0.7, 0.5, False), (2.0, None, False)])
def test_a_drive_too_slow_for_residuals_is_warned_of_whatever_the_model_remembers(seconds, interval, warns):
    times = (np.arange(4) * seconds * SECOND).astype(np.int64).tolist()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_rate(times, None, interval)
    assert [warning.category for warning in found] == [FrameRateWarning] * warns
    assert all("4 of 4 frames have none about 0.5 s before them" in str(warning.message) for warning in found)


def test_a_drive_is_thinned_to_the_frames_nearest_to_an_interval():
    camera = DriveCamera("front", AHEAD.intrinsics, np.eye(4))
    times = [0.0, 0.1, 0.24, 0.38, 0.52, 0.6, 0.95, 3.0, 3.1, 3.2]
    every = Drive((camera,), tuple(DriveFrame(round(t * SECOND), ego(0.0), {}) for t in times))
    assert [frame.timestamp_ns / SECOND for frame in thinned(every, 0.5).frames] == [0.0, 0.52, 0.95, 3.0]
    assert thinned(every, 0.01) == every


def test_a_drive_has_the_settings_of_training():
    simulation = MarkerSimulationConfig(residual_interval=None, first_residual=7.0)
    world = WorldConfig(duration_s=5.6, keyframes=8)
    example = ExampleConfig(markers=MarkerConfig(markers=3, lanes=5, points=7, simulation=simulation))
    model = DriveModel(LaneGraphTask(), {}, ProceduralConfig(world=world, example=example))
    config = as_trained(ReaderConfig(), model)
    assert (config.markers, config.lanes, config.points) == (3, 5, 7)
    assert (config.residual_interval, config.first_residual) == (None, 7.0)
    assert as_trained(config, None) == config
    assert model.interval == pytest.approx(0.5)
    slower = ProceduralConfig(world=replace(world, duration_s=9.1))
    assert DriveModel(LaneGraphTask(), {}, slower).interval == pytest.approx(1.0)
    assert DriveModel(LaneGraphTask(), {}, OpenLaneV2Config(Path("data"))).interval == 0.5
    assert DriveModel(LaneGraphTask(), {}, replace(slower, world=replace(world, keyframes=1))).interval == 0.5

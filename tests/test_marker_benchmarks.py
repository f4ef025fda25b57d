"""Benchmarks of markers in images: composites in photographs, and rendered drives from pixels to lanes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import (
    marker_composites,
    marker_occlusion,
    marker_scene_pictures,
    marker_scene_scores,
    marker_scenes,
)
from tests.models.cases import CAMERA_TOPONET, make_camera_example
from tests.models.test_marker_fusion import CONFIG as MARKERS
from tests.parameters import random_params
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.evaluation.results import SceneRatio
from tflane_jax.markers.detection import DetectedMarkers
from tflane_jax.markers.image_search import DetectorConfig
from tflane_jax.markers.pixels import PixelConfig
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.markers.square_pose import solve_square
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.scene import CameraViews, MarkerObservations
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.marker_drive import DriveModel
from tflane_jax.world.cameras.ring import CameraMount, CameraRigConfig
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.simulate import WorldConfig


@pytest.mark.parametrize("damage", ["none", "bar 10 %"])
def test_composites_show_the_board_where_they_say(damage, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TFLANE_SHARED", str(tmp_path))
    photo = marker_composites.photographs()[0]
    assert "invented pictures" in capsys.readouterr().out
    drawn = [marker_composites.composite(photo, 10.0, damage, np.random.default_rng(seed)) for seed in range(2)]
    for each in drawn:
        found = marker_occlusion.search(each.image, "OpenCV")
        if damage == "none":
            assert found.marker_id.tolist() == [each.marker_id]
            assert np.abs(found.corners[0] - each.outline).max() < 1.0
            fit = solve_square(found.corners[0], each.camera, marker_composites.CAMERA)
            assert abs(fit.camera_from_marker[0, 2, 3] - 10.0) < 0.4
        else:
            assert not len(found.marker_id)


def test_a_whole_composite_is_the_photograph_around_its_part():
    photo = np.random.default_rng(0).integers(0, 255, (900, 1600, 3), np.uint8)
    whole, part = (
        marker_composites.composite(photo, 20.0, "corner", np.random.default_rng(1), shown, 5)
        for shown in ("whole", "part")
    )
    assert whole.image.shape == photo.shape
    assert whole.ids == part.ids
    assert len(whole.ids) == 5
    assert whole.marker_id in whole.ids
    x, y = np.round(whole.outline[0] - part.outline[0]).astype(int)
    height, width = part.image.shape[:2]
    np.testing.assert_array_equal(whole.image[y : y + height, x : x + width], part.image)
    np.testing.assert_allclose(whole.camera[:2, 2] - part.camera[:2, 2], (x, y))
    # Away from the board the photograph is untouched.
    assert (whole.image != photo).any(-1).mean() < 0.02


def test_a_sample_of_composites_has_every_damage():
    every = [(photo, 10.0, kind, 0) for photo in range(3) for kind in range(len(marker_composites.DAMAGE))]
    some = marker_composites.spread(every, 12)
    assert len(set(some)) == 12
    kinds = [kind for _, _, kind, _ in some]
    assert {kinds.count(kind) for kind in range(len(marker_composites.DAMAGE))} == {1, 2}


def test_a_drive_that_is_not_its_parts_is_noticed():
    markers = MarkerObservations.empty(2, 3, 4)
    reading = SimpleNamespace(observed=SimpleNamespace(markers=markers))
    step = SimpleNamespace(reading=reading, guidance=[np.ones(2)], prediction=[np.ones(3)])
    parts = SimpleNamespace(markers=markers), [np.ones(2)], [np.ones(3)]
    marker_scenes._check(step, *parts)
    other = markers.replace(residual=markers.residual + np.float32(1e-6))
    for place, wrong in enumerate((SimpleNamespace(markers=other), [np.zeros(2)], [np.nextafter(np.ones(3), 2.0)])):
        with pytest.raises(AssertionError):
            marker_scenes._check(step, *(wrong if i == place else part for i, part in enumerate(parts)))


def test_a_sighting_is_the_nearest_board_that_gives_lanes():
    detected = DetectedMarkers.empty(4)
    detected.valid[:3] = True
    detected.marker_id[:3], detected.camera[:3] = (4, 5, 6), (0, 2, 1)
    detected.pose[:3, 0, 3] = 30.0, 10.0, 20.0
    views = CameraViews(
        image=np.arange(3, dtype=np.uint8)[:, None, None, None] + np.zeros((3, 8, 8, 3), np.uint8),
        size=np.full((3, 2), 8),
        intrinsics=np.tile(np.eye(3), (3, 1, 1)),
        camera_from_ego=np.tile(np.eye(4), (3, 1, 1)),
        valid=np.ones(3, bool),
    )

    def step(outcomes):
        observed = SimpleNamespace(outcomes=outcomes)
        return SimpleNamespace(reading=SimpleNamespace(detected=detected, observed=observed))

    found = marker_scene_pictures.sighting(views, None, step({4: "used", 5: "unknown", 6: "used"}))
    assert (found.board, found.camera) == (2, 1)
    np.testing.assert_array_equal(found.views.image, views.image[1:2])
    assert marker_scene_pictures.sighting(views, None, step({4: "stale", 5: "unknown", 6: "dropped"})) is None


def test_what_boards_change_is_told_with_intervals_over_scenes():
    """Three scenes of 30 lanes at three thresholds; in gaps the second one has none, and the boards bring 2 a scene."""
    ratios = {
        "with": {"all/recall": SceneRatio((10, 20, 30), (90, 90, 90)), "gap/recall": SceneRatio((5, 0, 5), (9, 0, 9))},
        "same": {"all/recall": SceneRatio((10, 20, 30), (90, 90, 90)), "gap/recall": SceneRatio((3, 0, 3), (9, 0, 9))},
    }
    overall, gap = marker_scene_scores.differences(ratios, "with")
    assert (overall["difference"], overall["low"], overall["high"]) == (0.0, 0.0, 0.0)
    assert (gap["frames"], gap["scenes"], gap["against"]) == ("gap", 2, "same")
    assert gap["difference"] == pytest.approx(4 / 18)
    assert gap["high"] == pytest.approx(4 / 18)
    assert gap["low"] in (0.0, pytest.approx(4 / 18))  # a sample may have the scene without gaps alone
    assert "+22.2" in marker_scene_scores.differences_table([gap])


@pytest.mark.slow
def test_rendered_drives_are_scored_with_and_without_their_boards(tmp_path, monkeypatch):
    """A random model of two cameras, on two short scenes."""
    front = CameraMount("front", 0.0, 0.0, 1.5, 0.0, 0.0, 900.0, 960, 540)
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    model = replace(CAMERA_TOPONET, denoising=None, priors=PriorsConfig(markers=MARKERS))
    task = LaneGraphTask(model)
    rig = CameraRigConfig(cameras=(front, replace(front, name="again")), scale=0.1, multiple=32)
    markers = MarkerConfig(pixels=PixelConfig(detector=DetectorConfig()))
    source = ProceduralConfig(
        "test",
        scenes=2,
        world=WorldConfig(duration_s=3.1, keyframes=3, markers=PlacementConfig(side="both")),
        example=ExampleConfig(range=model.range, sensor=None, cameras=rig, markers=markers),
    )
    drive = DriveModel(task, random_params(task.init, make_camera_example()), source)
    measured, frames = marker_scenes.measure(source, drive, drive, tmp_path, marker_scenes.Clock())
    scores = {name: metric.compute() for name, metric in measured.items()}
    assert sum(frames.values()) == 6
    assert (tmp_path / "marker_scenes_confidence.png").is_file()
    assert list(scores) == [marker_scenes.WITH, marker_scenes.WITHHELD, marker_scenes.WITHOUT]
    assert scores[marker_scenes.WITHHELD] == scores[marker_scenes.WITHOUT]
    assert all(0.0 <= groups["all"]["recall"] <= 1.0 for groups in scores.values())

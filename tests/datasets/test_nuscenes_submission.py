"""MapTR's file of results for nuScenes: points around the lidar, tokens of samples, what the model predicts."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tests.models.cases import SMALL_LINES
from tflane_jax.cli import main
from tflane_jax.commands import submit
from tflane_jax.config import RunConfig
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesData, NuScenesDataset
from tflane_jax.evaluation.predict import predictions
from tflane_jax.evaluation.vector_maps import detections_of_lines
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.metrics.map_matching import MapDetections
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.runs import open_run, train_run
from tflane_jax.scoring.maptr import read_predictions
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

pytest.importorskip("shapely")
SIZES = ExampleConfig(lanes=6, segments=6, areas=6, tracks=4, elements=2)


@pytest.fixture
def root(tmp_path):
    return write_nuscenes(tmp_path)


@pytest.mark.parametrize("frame", ["ego", "lidar"])
def test_points_of_examples_in_maptrs_axes(root, frame):
    """The lidar is 0.94 m ahead of the rear axle; x is right there, y forward, and heights stay."""
    dataset = NuScenesDataset(NuScenesConfig(root, frame=frame, example=SIZES))
    ahead = 10.0 if frame == "ego" else 9.06
    found = dataset.in_lidar_axes(0, np.array([[[ahead, 3.0, 0.5], [0.94 - 10.0 + ahead, 0.0, 0.0]]]))
    np.testing.assert_allclose(found, [[[-3.0, 9.06, 0.5], [0.0, 0.0, 0.0]]], atol=1e-9)
    np.testing.assert_allclose(dataset.in_lidar_axes(0, np.array([[ahead, 3.0]])), [[-3.0, 9.06]], atol=1e-9)
    assert dataset.in_lidar_axes(0, np.zeros((0, 20, 2))).shape == (0, 20, 2)
    assert dataset.token(1) == dataset.frames("scene-0061").samples[1]["token"]


def test_frames_are_written_in_order_of_time(monkeypatch):
    """MapTR's evaluation pairs the n-th result with the n-th frame by time; scenes are not sorted by it."""
    times = [30, 40, 10, 20]
    points = np.arange(4.0)[:, None, None, None] * np.ones((1, 5, 2))
    dataset = SimpleNamespace(
        info=lambda index: SimpleNamespace(timestamp_ns=times[index]),
        token=lambda index: f"token {times[index]}",
        in_lidar_axes=lambda index, points: points,
    )
    monkeypatch.setattr(submit, "detections_of_lines", lambda lines: MapDetections(lines, np.zeros(1, int), np.ones(1)))
    answers = ((index, SimpleNamespace(lines=points[index])) for index in range(4))
    frames = submit._map_frames(dataset, answers)
    assert [token for token, _ in frames] == ["token 10", "token 20", "token 30", "token 40"]
    assert [found.points[0, 0, 0] for _, found in frames] == [2.0, 3.0, 0.0, 1.0]


@pytest.mark.slow
def test_maptrs_file_holds_what_the_model_predicts(root, tmp_path, capsys):
    """A model of BEV evidence in the vehicle's frame: lines, classes and scores, around the lidar."""
    model = replace(SMALL_LINES, priors=PriorsConfig())
    example = replace(SIZES, map_lines=MapLinesConfig(lines=8, points=5))
    config = RunConfig(
        task=LaneGraphTask(model, MapTrLossConfig()),
        data=NuScenesData(root, example=example),
        optim=OptimConfig(warmup_steps=0),
        training=TrainingConfig(steps=1, batch_size=2, eval_every=1, checkpoint_every=1, best_metric="lines/mAP"),
    )
    train_run(config, tmp_path / "run", progress=False)
    out = tmp_path / "nuscmap_results.json"
    assert main(["submit", str(tmp_path / "run"), "--split", "train", "--out", str(out)]) == 0
    assert "4 frames of nuscenes-train" in capsys.readouterr().out
    written, source = read_predictions(out), config.data.source("train")
    dataset, params = NuScenesDataset(source), open_run(tmp_path / "run").params[0]
    assert list(written) == [dataset.token(i) for i in range(4)]
    for indices, answers in predictions(config.task, params, config.task.load(source, progress=False), 4):
        for row, index in enumerate(indices):
            wanted = detections_of_lines(jax.tree.map(lambda leaf, i=row: leaf[i], answers.lines))
            found = written[dataset.token(index)]
            x, y = np.moveaxis(np.asarray(wanted.points, float), -1, 0)
            np.testing.assert_allclose(found.points, np.stack([-y, x - 0.94], -1), rtol=1e-3, atol=1e-2)
            np.testing.assert_array_equal(found.classes, wanted.classes)
            np.testing.assert_allclose(found.scores, wanted.scores, atol=1e-4)

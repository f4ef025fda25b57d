"""A world exported as OpenLane-V2 gives clips with virtual markers and the SD map, and trains with both and memory."""

import json
import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import CAMERA, CAMERA_TOPONET
from tests.models.test_marker_fusion import CONFIG as MARKERS
from tests.parameters import random_params
from tflane_jax.cli import main
from tflane_jax.config import OpenLaneV2Data, RunConfig
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.batches import batches, count, first_example
from tflane_jax.datasets.openlane_sd_map import read_sd_lines
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Dataset
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.evaluation.centerlines import detections_of_centerlines
from tflane_jax.evaluation.predict import predictions
from tflane_jax.geometry.polylines import resample
from tflane_jax.markers.simulation import PERFECT, MarkerConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.sd_map_encoder import SdMapModuleConfig
from tflane_jax.runs import open_run, train_run
from tflane_jax.scene import stack_examples
from tflane_jax.scoring.openlane_v2 import read_predictions
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.roads.sd_map import SdMapConfig

SCENES, FRAMES, CLIP = 5, 4, 2
EXPORTED = """
from tflane_jax.config import RunConfig, WorldData
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, CameraRigConfig
from tflane_jax.world.roads.sd_map import SdMapConfig

def get_config():
    cameras = CameraRigConfig(cameras=ARGOVERSE2_RING, scale=0.05)
    example = ExampleConfig(sensor=None, cameras=cameras, sd_map=SdMapConfig())
    return RunConfig(data=WorldData(train=5, val=1, test=1, example=example))
"""
EXAMPLE = ExampleConfig(
    lanes=8,
    elements=3,
    markers=MarkerConfig(lanes=6, points=5, simulation=PERFECT),
    sd_map=SdMapConfig(lines=6, points=5),
)
TASK = LaneGraphTask(
    replace(
        CAMERA_TOPONET,
        priors=PriorsConfig(markers=MARKERS, sd_map=SdMapModuleConfig()),
        encoder=replace(CAMERA, bev=replace(CAMERA.bev, cameras=7)),
    ),
    clip=CLIP,
)


pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::tflane_jax.datasets.base.TruncationWarning"),
]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> OpenLaneV2Data:
    folder = tmp_path_factory.mktemp("world")
    (folder / "config.py").write_text(EXPORTED)
    command = ["data", "export", "--config", str(folder / "config.py"), "--splits", "train"]
    assert main([*command, "--out", str(folder / "made")]) == 0
    return OpenLaneV2Data(
        folder / "made",
        val="train",
        image=ImageConfig(divisor=16),
        example=EXAMPLE,
        loading=StreamingConfig(threads=2, ahead=2),
    )


def test_clips_have_markers_and_the_sd_map(data):
    assert read_sd_lines(data.root / "train/00000/sdmap.json").lines
    frames = TASK.load(data.source("train"), progress=False)
    clips = TASK.examples(frames)
    assert count(clips) == SCENES * FRAMES // CLIP
    plain, coloured = (next(batches(clips, (0,), range(1), 10, prepare))[0] for prepare in (None, TASK.prepare(data)))
    assert plain.markers.valid.shape == (10, CLIP, 2)
    assert np.asarray(plain.markers.valid).any(-1).sum() >= FRAMES
    assert plain.sd_map.valid.any(-1).all()
    changed = np.asarray(plain.cameras.image != coloured.cameras.image).any((2, 3, 4, 5))
    assert changed.all()
    scaled = TASK.prepare(replace(data, augmentation=PhotometricConfig(scale=(0.5, 0.9))))
    smaller = next(batches(clips, (0,), range(1), 10, scaled))[0]
    assert jax.tree.map(np.shape, smaller) == jax.tree.map(np.shape, plain)
    sizes = np.asarray(smaller.cameras.size[:, :, 0]) / np.asarray(plain.cameras.size[:, :, 0])
    assert len(np.unique(sizes[..., 0])) > CLIP  # each frame has its own
    assert 0.45 < sizes.min() < sizes.max() < 0.95
    assert jax.tree.map(jnp.shape, first_example(frames)) == jax.tree.map(jnp.shape, TASK.shapes(data))


def test_a_model_learns_from_markers_and_the_sd_map_with_memory(data):
    frames = TASK.load(data.source("train"), progress=False)
    clips = TASK.examples(frames)
    batch = stack_examples([clips.example(i) for i in (8, 9)])  # a scene that shows a board in every frame
    assert batch.markers.valid.any(-1).all()
    params = random_params(TASK.init, first_example(clips))
    (loss, _), gradient = jax.jit(jax.value_and_grad(TASK.loss, has_aux=True))(params, batch, jax.random.key(0))
    assert np.isfinite(loss)
    for name in ("marker_tokens", "sd_map_tokens"):
        assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(gradient[name])) > 0
    found = [answer.centerlines.points for _, answer in predictions(TASK, params, frames, FRAMES)]
    assert np.isfinite(found).all()


def test_a_run_trains_resumes_and_is_measured_on_the_folder(data, tmp_path):
    """Clips from disk, with markers, SD map and memory: the same bits with and without a stop, and scores by stream."""
    training = TrainingConfig(steps=4, batch_size=2, eval_every=2, checkpoint_every=2)
    config = RunConfig(task=TASK, data=data, optim=OptimConfig(warmup_steps=0), training=training)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    train_run(config, whole, progress=False)
    shutil.copytree(whole, killed)
    shutil.rmtree(killed / "checkpoints/step_00000004")
    train_run(config, killed, start="resume", progress=False)
    [params], [resumed] = (open_run(folder, "last").params for folder in (whole, killed))
    jax.tree.map(np.testing.assert_array_equal, params, resumed)
    before = open_run(whole, 2).params[0]
    for name in ("marker_tokens", "sd_map_tokens", "encoder"):
        assert not all(map(np.array_equal, jax.tree.leaves(params[name]), jax.tree.leaves(before[name])))

    assert main(["eval", str(whole), "--split", "val", "--out", str(tmp_path / "scores")]) == 0
    rows = {row["lanes of"]: row for row in json.loads((tmp_path / "scores.json").read_text())["rows"]}
    assert rows["all"]["frames"] == SCENES * FRAMES
    assert sum(rows[group]["frames"] for group in ("seen", "gap", "before")) == SCENES * FRAMES
    assert rows["seen"]["frames"] >= FRAMES
    assert 0.0 < rows["all"]["OLS"] < 1.0
    assert "DET_l" not in rows["occluded"]  # its files say nothing of occlusion


def test_a_missing_sd_map_is_named(data):
    (data.root / "train/00000/sdmap.json").rename(data.root / "sdmap.json")
    try:
        with pytest.raises(
            UserError, match=r"1 of 5 SD maps are missing .*train/00000/sdmap\.json.*: unpack the SD maps"
        ):
            TASK.shapes(data)
    finally:
        (data.root / "sdmap.json").rename(data.root / "train/00000/sdmap.json")


def test_a_submission_holds_what_the_model_predicts(data, tmp_path, capsys):
    """Boxes are in pixels of the files, which the model sees at another size."""
    example = replace(EXAMPLE, lanes=64, elements=16, markers=None, sd_map=None)
    model = replace(CAMERA_TOPONET, priors=PriorsConfig(), encoder=replace(CAMERA, bev=replace(CAMERA.bev, cameras=7)))
    config = RunConfig(
        task=LaneGraphTask(model),
        data=replace(data, test="val", example=example, image=ImageConfig(divisor=16, scale=0.8)),
        optim=OptimConfig(warmup_steps=0),
        training=TrainingConfig(steps=1, batch_size=2, eval_every=1, checkpoint_every=1),
    )
    train_run(config, tmp_path / "run", progress=False)
    submission = tmp_path / "submission.pkl"
    command = ["submit", str(tmp_path / "run"), "--out", str(submission), "--method", "one step"]
    assert main(command) == 2  # no frame of the official test split is there
    assert main([*command, "--split", "train"]) == 0
    assert f"{SCENES * FRAMES} frames" in capsys.readouterr().out
    small = tmp_path / "small.pkl"
    few = ["--out", str(small), "--split", "train", "--most-lanes", "3", "--most-elements", "1"]
    assert main([*command, *few]) == 0
    assert {(len(one.points), len(one.elements.scores)) for one in read_predictions(small).values()} == {(3, 1)}
    assert main([*command, *few[:-1], "0"]) == 2
    run, source = open_run(tmp_path / "run"), config.data.source("train")
    written, keys = read_predictions(submission), OpenLaneV2Dataset(source).keys
    assert list(written) == keys
    arrays = config.task.load(source, progress=False)
    for indices, answers in predictions(config.task, run.params[0], arrays, 8):
        for row, index in enumerate(indices):
            answer = jax.tree.map(lambda leaf, i=row: leaf[i], answers)
            wanted, found = detections_of_centerlines(answer.centerlines, answer.elements), written[keys[index]]
            lines = np.array([resample(np.asarray(line, float), 11) for line in wanted.points])
            np.testing.assert_allclose(np.array(found.points), lines, rtol=1e-4, atol=1e-3)
            np.testing.assert_allclose(found.scores, wanted.scores, atol=1e-4)
            np.testing.assert_allclose(found.successor, wanted.successor, atol=1e-4)
            np.testing.assert_allclose(found.elements.boxes, wanted.elements.boxes / 0.8, rtol=1e-2, atol=0.1)
            np.testing.assert_allclose(found.elements.lane, wanted.elements.lane, atol=1e-4)

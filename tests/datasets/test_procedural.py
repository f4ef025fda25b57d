"""The built-in world as a dataset: splits, order of frames, determinism."""

import pickle
import re
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from tflane_jax.datasets import procedural
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.cache import cached
from tflane_jax.datasets.loading import load_arrays
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset, WorldData
from tflane_jax.errors import UserError
from tflane_jax.world.cameras.ring import CameraRigConfig

CONFIG = ProceduralConfig(split="val", scenes=2, first=5)


@pytest.fixture(scope="module")
def dataset():
    return ProceduralDataset(CONFIG)


def test_cameras_without_opencv_are_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    ProceduralDataset(CONFIG)
    with pytest.raises(UserError, match=re.escape("pip install -e '.[images]'")):
        ProceduralDataset(replace(CONFIG, example=ExampleConfig(cameras=CameraRigConfig())))


def test_splits_own_disjoint_ranges_of_scene_ids():
    everything = [ProceduralConfig(split, procedural.SCENES_PER_SPLIT) for split in ("train", "val", "test")]
    ends = []
    for config in everything:
        dataset = ProceduralDataset(config)
        ends.append((dataset.scene_id(0), dataset.scene_id(len(dataset) - 1)))
    assert ends == [(0, 10**8 - 1), (10**8, 2 * 10**8 - 1), (2 * 10**8, 3 * 10**8 - 1)]


@pytest.mark.parametrize(("scenes", "first"), [(-1, 0), (1, -1), (1, 10**8), (10**8 + 1, 0)])
def test_scenes_outside_the_split_are_refused(scenes, first):
    with pytest.raises(UserError, match="train has scenes 0 to 99999999"):
        ProceduralDataset(ProceduralConfig(scenes=scenes, first=first))


def test_frames_of_a_scene_follow_each_other(dataset):
    frames = CONFIG.world.keyframes
    assert len(dataset) == 2 * frames
    assert [dataset.scene_id(i) - 10**8 for i in range(len(dataset))] == [5] * frames + [6] * frames
    infos = [dataset.info(i) for i in range(len(dataset))]
    assert len({info.scene for info in infos}) == 2
    times = [info.timestamp_ns for info in infos[:frames]]
    assert times == sorted(set(times))
    previous = [bool(dataset.example(i).has_previous) for i in (0, 1, frames)]
    assert previous == [False, True, False]


@pytest.mark.parametrize("index", [-1, 2 * CONFIG.world.keyframes])
def test_indices_outside_the_dataset_are_errors(dataset, index):
    with pytest.raises(IndexError, match="procedural-val"):
        dataset.example(index)


def test_an_example_depends_on_its_scene_alone(dataset):
    """Same bits from another dataset that holds the scene elsewhere, and after a round trip through pickle."""
    frames = CONFIG.world.keyframes
    other = pickle.loads(pickle.dumps(ProceduralDataset(replace(CONFIG, scenes=1, first=6))))
    procedural._simulated.cache_clear()
    jax.tree.map(np.testing.assert_array_equal, other.example(1), dataset.example(frames + 1))


def test_scenes_are_simulated_once_for_all_their_frames(monkeypatch):
    calls = []
    simulate = procedural.simulate
    monkeypatch.setattr(procedural, "simulate", lambda *args: (calls.append(args[0]), simulate(*args))[1])
    procedural._simulated.cache_clear()
    dataset = ProceduralDataset(CONFIG)
    for index in range(len(dataset)):
        dataset.info(index)
        dataset.example(index)
    assert calls == [10**8 + 5, 10**8 + 6]
    procedural._simulated.cache_clear()


@pytest.mark.parametrize("preset", [WorldData.city, WorldData.street])
def test_every_key_frame_of_a_preset_has_its_whole_history(preset):
    source = replace(preset(1, 1, 1).source("val"), first=3)
    dataset = ProceduralDataset(source)
    log = procedural._simulated(10**8 + 3, source.world, 100)
    for index in range(len(dataset)):
        flow, moment = dataset.example(index).traffic_flow, log.keyframes[index]
        frames = moment.track_frame - 5 * np.arange(20, 0, -1)
        assert frames.min() >= 0
        # As many road users as the log has in the frame 10 s ago.
        assert flow.valid[:, 0].sum() == log.tracks.valid[frames[0]].sum() > 0
        assert flow.valid.any(-1).sum() == log.tracks.valid[frames].any(0).sum()


def test_scenes_are_long_enough_for_a_longer_history():
    """Regression: without history_hz, scenes had 20 frames before the first key frame, however many were asked for."""
    data = WorldData(1, 1, 1)
    for history, frames in ((5, 20), (40, 40)):
        source = replace(data, example=replace(data.example, history=history)).source("val")
        assert ProceduralDataset(source).history(source.world) == frames
    source = replace(data, example=replace(data.example, history=40)).source("val")
    flow = ProceduralDataset(source).example(0).traffic_flow
    assert flow.valid[:, 0].any()


def test_the_box_of_a_preset_lies_within_its_raster_and_its_map():
    for data in (WorldData.city(), WorldData.street()):
        ground, box = data.example.ground, data.example.range
        assert ground.contains(np.array([[box.x[0], box.y[0]], [box.x[1], box.y[1]]])).all()
        half_diagonal = np.hypot(box.x[1], box.y[1])
        for scene in range(6):
            log = procedural._simulated(scene, data.world, 100)
            roads = np.concatenate([segment.centerline for segment in log.map.segments.values()])
            reach = np.abs(roads[:, :2]).max()
            for moment in log.keyframes:
                assert np.hypot(*moment.global_from_ego[:2, 3]) + half_diagonal < reach


def test_a_scene_too_short_for_the_history_says_so():
    short = replace(WorldData.city().source("val"), world=replace(WorldData.city().world, duration_s=9.0))
    with pytest.raises(UserError, match="100 frames of history each do not fit in the 90 frames"):
        ProceduralDataset(short).example(0)


def test_the_cache_holds_the_same_examples(tmp_path, dataset):
    kept = cached(dataset, root=tmp_path, workers=1, progress=False)
    arrays = load_arrays(kept, progress=False)
    assert len(arrays.has_previous) == len(dataset)
    for index in (0, len(dataset) - 1):
        example = dataset.example(index)
        example.validate()
        jax.tree.map(np.testing.assert_array_equal, kept.example(index), example)
        jax.tree.map(lambda a, b, i=index: np.testing.assert_array_equal(a[i], b), arrays, example)
        assert kept.info(index).scene == dataset.info(index).scene

"""What a nuScenes dataset keeps, and what it passes to worker processes."""

import pickle

import jax
import numpy as np
import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tflane_jax.datasets import nuscenes
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesDataset

pytest.importorskip("shapely")
SIZES = ExampleConfig(lanes=6, segments=6, areas=6, tracks=4, elements=2)


def test_only_the_logs_last_asked_for_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(nuscenes, "KEPT_LOGS", 1)
    dataset = NuScenesDataset(NuScenesConfig(write_nuscenes(tmp_path), example=SIZES))
    name = dataset.info(0).scene
    first = dataset.log(name)
    assert dataset.log(name) is first
    made = []
    monkeypatch.setattr(nuscenes, "scene_log", lambda *args, **kwargs: made.append(1) or first)
    for other in [name, "other", name]:
        dataset.scenes[other] = dataset.scenes[name]
        dataset.log(other)
    assert len(made) == 2  # the other one, and the first one again


def test_a_copy_for_a_worker_keeps_nothing_and_gives_the_same_examples(tmp_path):
    dataset = NuScenesDataset(NuScenesConfig(write_nuscenes(tmp_path), example=SIZES))
    before = len(pickle.dumps(dataset))
    example = dataset.example(1)
    copy = pickle.loads(pickle.dumps(dataset))
    assert len(pickle.dumps(dataset)) < before + 1000  # logs, maps and poses would be more
    jax.tree.map(np.testing.assert_array_equal, copy.example(1), example)

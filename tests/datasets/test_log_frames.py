"""Datasets of logs: opening them reads no map and no box, and each log is read when an example needs it."""

import pickle

import jax
import numpy as np
import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tests.datasets.small_argoverse2 import write_log
from tests.datasets.test_nuscenes_scenes import content
from tflane_jax.datasets import log_frames, nuscenes_scenes
from tflane_jax.datasets.nuscenes_scenes import SceneFileConfig, SceneFileDataset
from tflane_jax.datasets.recorded_logs import RecordedConfig, RecordedDataset
from tflane_jax.datasets.road_maps import MapFile, find_maps
from tflane_jax.errors import UserError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with logs of every format that has recordings."""
    pytest.importorskip("pyarrow")
    pytest.importorskip("shapely")
    root = tmp_path_factory.mktemp("logs")
    write_log(root / "log-a")
    write_nuscenes(root / "nuscenes")
    (root / "scenes").mkdir()
    for name in ("scene-0553", "scene-0655"):
        np.savez(root / "scenes" / f"{name}.npz", **content(name))
    return root


@pytest.fixture
def read(monkeypatch):
    """The names of the logs that are read as a whole, in order."""
    names, scene_file, log = [], nuscenes_scenes.read_scene_file, MapFile.log

    def noted(name, make):
        names.append(name)
        return make()

    monkeypatch.setattr(nuscenes_scenes, "read_scene_file", lambda path: noted(path.stem, lambda: scene_file(path)))
    monkeypatch.setattr(MapFile, "log", lambda self: noted(self.name, lambda: log(self)))
    return names


def test_an_outline_has_the_key_frames_of_its_log(folder):
    for one in find_maps(folder):
        outline, log = one.outline(), one.log()
        assert (outline.name, outline.source, outline.area) == (log.name, log.source, log.area)
        assert len(outline.keyframes) == len(log.keyframes) > 0
        for found, expected in zip(outline.keyframes, log.keyframes, strict=True):
            assert (found.timestamp_ns, found.track_frame) == (expected.timestamp_ns, expected.track_frame)
            np.testing.assert_array_equal(found.global_from_ego, expected.global_from_ego)


def test_recorded_logs_are_read_when_an_example_needs_them(folder, read):
    dataset = RecordedDataset(RecordedConfig(folder))
    scenes = [dataset.info(index).scene for index in range(len(dataset))]
    assert list(dict.fromkeys(scenes)) == ["log-a", "scene-0061", "scene-0103", "scene-0553", "scene-0655"]
    assert read == []
    examples = [dataset.example(index) for index in range(len(dataset))]
    assert read == ["log-a", "scene-0061", "scene-0103", "scene-0553", "scene-0655"]
    copy = pickle.loads(pickle.dumps(dataset))
    jax.tree.map(np.testing.assert_array_equal, copy.example(len(copy) - 1), examples[-1])
    assert [log.name for log in dataset.drives()] == ["log-a", "scene-0061", "scene-0103", "scene-0553", "scene-0655"]
    assert len(read) == 6  # the copy read its own


def test_scene_files_are_read_when_an_example_needs_them_and_few_are_kept(folder, read, monkeypatch):
    monkeypatch.setattr(log_frames, "KEPT_LOGS", 1)
    dataset = SceneFileDataset(SceneFileConfig(folder / "scenes"))
    assert [dataset.info(index).timestamp_ns for index in range(len(dataset))] == [0, 500_000_000, 10**9] * 2
    assert read == []
    for index in (0, 1, 5, 4, 2):
        dataset.example(index).validate()
    assert read == ["scene-0553", "scene-0655", "scene-0553"]


def test_a_damaged_map_is_named_when_it_is_read_and_a_damaged_pose_at_opening(tmp_path):
    np.savez(tmp_path / "scene-0061.npz", **content() | {"polygon_len": np.array([1, 2])})
    np.savez(tmp_path / "scene-0099.npz", **content("scene-0099"))
    for dataset in (SceneFileDataset(SceneFileConfig(tmp_path)), RecordedDataset(RecordedConfig(tmp_path))):
        dataset.example(5)
        for _ in range(2):
            with pytest.raises(UserError, match=r"scene-0061\.npz: polygon_len"):
                dataset.example(0)
    for changes, message in (
        ({"ego_position": np.full((3, 3), np.nan)}, "scene-0099.npz: ego_position"),
        ({"ego_yaw": np.zeros(2)}, "scene-0099.npz: ego_yaw"),
        ({"ego_position": np.zeros((0, 3)), "ego_yaw": np.zeros(0)}, "ego_position holds no key frame"),
        ({"meta": np.array("{")}, "scene-0099.npz: meta"),
    ):
        np.savez(tmp_path / "scene-0099.npz", **content("scene-0099") | changes)
        with pytest.raises(UserError, match=message):
            SceneFileDataset(SceneFileConfig(tmp_path))
        with pytest.raises(UserError, match=message):
            RecordedDataset(RecordedConfig(tmp_path))

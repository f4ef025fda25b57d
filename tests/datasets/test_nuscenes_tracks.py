"""Tracks of nuScenes for frames of another data set, at its own times and poses."""

import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import sleep

import numpy as np
import pytest

from tests.datasets.nuscenes_small import PITCH, tables, write_nuscenes
from tests.datasets.small_argoverse2 import write_log
from tflane_jax.datasets import nuscenes_tracks, openlane_tracks
from tflane_jax.datasets.examples import traffic_flow
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesDataset
from tflane_jax.datasets.nuscenes_log import level_poses
from tflane_jax.datasets.nuscenes_tracks import SceneTracks
from tflane_jax.datasets.openlane_tracks import SourceTracks
from tflane_jax.errors import UserError
from tflane_jax.scene.logs import KeyFrame


def test_scenes_by_name_and_token_need_no_map(tmp_path):
    write_nuscenes(tmp_path)
    shutil.rmtree(tmp_path / "maps")
    tracks = SceneTracks(tmp_path)
    assert "scene-0061" in tracks
    assert "scene-0001" not in tracks
    log = tracks.log("scene-0061")
    assert log is tracks.log("scene-a")
    assert (log.map.segments, log.tracks.uuid.tolist()) == ({}, ["bus", "car", "walker"])
    with pytest.raises(UserError, match="has no scene scene-0001"):
        tracks.log("scene-0001")
    assert SceneTracks(tmp_path, least_visibility="v60-80").log("scene-0061").tracks.occluded[2, 0]


def test_a_frame_of_its_own_pose_gets_the_history(tmp_path):
    """A frame 0.1 m and 10 ms beside sample 3, from a pose with pitch: the car 15 m before sample 3 was 10 m ahead."""
    log = SceneTracks(write_nuscenes(tmp_path)).log("scene-0061")
    pitched = np.array([[np.cos(PITCH), 0, np.sin(PITCH)], [0, 1, 0], [-np.sin(PITCH), 0, np.cos(PITCH)]])
    pose = log.global_from_ego[3].copy()
    pose[:3, :3] = pose[:3, :3] @ pitched
    pose[:2, 3] += (0.0, 0.1)
    moment = KeyFrame(int(log.timestamps_ns[3]) + 10_000_000, level_poses(pose[None])[0], 3)
    flow, dropped = traffic_flow(replace(log, keyframes=(moment,)), 0, history=20, capacity=4)
    assert dropped == 0
    car = int(np.flatnonzero(flow.valid[:, 17])[0])
    np.testing.assert_allclose(flow.position[car, 17], [-5.1, 3.0, 1.0], atol=1e-5)


@pytest.mark.parametrize("subset", ["A", "B"])
def test_threads_read_a_log_once_and_a_copy_for_a_worker_keeps_none(tmp_path, monkeypatch, subset):
    """Regression: every thread of a loader that asked for a log at once read it, and copies held all logs so far."""
    if subset == "A":
        pytest.importorskip("pyarrow")
        write_log(tmp_path / "log-a")
        module, reader, name = openlane_tracks, "load_log", "log-a"
    else:
        write_nuscenes(tmp_path)
        module, reader, name = nuscenes_tracks, "scene_log", "scene-0061"
    tracks = SourceTracks(tmp_path, subset, {})
    before, read, made = len(pickle.dumps(tracks)), getattr(module, reader), []

    def slowly(*args, **kwargs):
        made.append(1)
        sleep(0.1)
        return read(*args, **kwargs)

    monkeypatch.setattr(module, reader, slowly)
    with ThreadPoolExecutor(4) as threads:
        logs = list(threads.map(tracks._logs.log, [name] * 4))
    assert (len(made), {id(log) for log in logs}) == (1, {id(logs[0])})
    assert len(pickle.dumps(tracks)) == before
    assert pickle.loads(pickle.dumps(tracks))._logs.log(name).name == name


def test_a_missing_key_frame_is_an_empty_frame(tmp_path):
    """The last sample comes 1 s late: two frames are missing, and the history counts half seconds."""
    content = tables()
    for row in content["sample"]:
        row["timestamp"] += 1_000_000 * (row["token"] == "sample-a3")
    sound, late = (
        NuScenesDataset(NuScenesConfig(write_nuscenes(tmp_path / name, each), split="train")).log("scene-0061")
        for name, each in (("sound", tables()), ("late", content))
    )
    assert [moment.track_frame for moment in sound.keyframes] == [0, 1, 2, 3]
    assert [moment.track_frame for moment in late.keyframes] == [0, 1, 2, 5]
    np.testing.assert_allclose(np.diff(late.timestamps_ns) / 1e9, 0.5, atol=1e-3)
    assert late.actors is late.tracks
    assert sound.tracks.valid[:3].any(1).all()
    seen = [traffic_flow(log, 3, history=3, capacity=4)[0].valid.any(0).tolist() for log in (sound, late)]
    assert seen == [[True, True, True], [True, False, False]]

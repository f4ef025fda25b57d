"""Markers and store of a log are made once, whoever asks."""

import gc
import threading
import time

import numpy as np

from tests.datasets.small_logs import lane_map, log, segment, tracks
from tflane_jax.datasets import marker_observations
from tflane_jax.geometry import PerceptionRange
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.scene.logs import PlacedMarkers
from tflane_jax.world.roads.markers import marker_pose


def test_threads_that_stream_frames_share_a_store(monkeypatch):
    """Each of four threads made its own, and the second release of one log failed."""
    markers = PlacedMarkers(np.array([3]), marker_pose(np.array([[20.0, -5.0, 3.0]]), np.full(1, np.pi)))
    lanes = lane_map(segment(0, [(-40.0, 0.0), (40.0, 0.0)]))
    drive = log(
        lanes, tracks(np.zeros((4, 0, 3))), [np.eye(4)] * 4, [(i, np.eye(4)) for i in range(4)], markers=markers
    )
    made, store_of_log = [], marker_observations.store_of_log

    def slow(*arguments, **named):
        made.append(threading.get_ident())
        time.sleep(0.1)
        return store_of_log(*arguments, **named)

    monkeypatch.setattr(marker_observations, "store_of_log", slow)
    before = set(marker_observations._REMEMBERED._kept)

    def read(frame):
        marker_observations.marker_observations(drive, frame, MarkerConfig(), PerceptionRange(), bike_lanes=True)

    threads = [threading.Thread(target=read, args=(frame,)) for frame in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    del drive, threads, read
    gc.collect()
    assert set(marker_observations._REMEMBERED._kept) <= before

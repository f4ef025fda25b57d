"""Clips of data in memory and on disk."""

import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tflane_jax.datasets.batches import batches, count, first_example
from tflane_jax.datasets.clips import as_clips
from tflane_jax.datasets.loading import load_arrays
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.errors import UserError

DRIVE = DriveDataset(DriveConfig(scenes=4))


class Named(DriveDataset):
    """Tells scenes without reading a frame."""

    def scene(self, index: int) -> str:
        return str(index // FRAMES)

    def example(self, index: int):
        return DRIVE.example(index)

    def info(self, index: int):
        raise AssertionError("read a file for a scene's name")


def streamed(dataset=DRIVE) -> Streamed:
    return Streamed(dataset, StreamingConfig(threads=2, ahead=2))


@pytest.mark.parametrize("dataset", [DRIVE, Named(DRIVE.config)])
def test_clips_on_disk_equal_those_in_memory(dataset):
    whole = as_clips(load_arrays(DRIVE, progress=False), FRAMES)
    clips = as_clips(streamed(dataset), FRAMES)
    assert count(clips) == count(whole) == 4
    one, other = (next(batches(data, (3,), range(1), 2))[0] for data in (whole, clips))
    assert one.lanes.points.shape == (2, FRAMES, 5, 11, 3)
    np.testing.assert_array_equal(one.lanes.points, other.lanes.points)
    np.testing.assert_array_equal(one.has_previous, other.has_previous)


def test_frames_that_fill_no_clip_are_left_out():
    clips = as_clips(streamed(), FRAMES - 1)
    assert count(clips) == 4
    assert first_example(clips).has_previous.tolist() == [False, True]
    assert [clips.dataset.info(i).timestamp_ns for i in range(4)] == [0] * 4
    assert count(as_clips(streamed(), 1)) == 4 * FRAMES


def test_clips_longer_than_every_scene_are_refused():
    with pytest.raises(UserError, match=r"no scene of drive has 4 frames: set task.clip"):
        as_clips(streamed(), FRAMES + 1)
    with pytest.raises(UserError, match="do not split into clips of 2 frames"):
        as_clips(load_arrays(DRIVE, progress=False), 2)

"""Videos are read frame by frame, and written whole or not at all."""

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import is_temporary
from tflane_jax.files.videos import VideoInfo, read_frames, sample_frames, video_info, writing_video

cv2 = pytest.importorskip("cv2")
INFO = VideoInfo(frames=6, rate=10.0, width=64, height=48)


@pytest.fixture
def video(tmp_path):
    with writing_video(tmp_path / "drive.mp4", INFO) as writer:
        for i in range(6):
            writer.add(np.full((48, 64, 3), [40 * i, 20, 200 - 30 * i], np.uint8))
    return tmp_path / "drive.mp4"


def test_frames_return(video):
    frames = list(read_frames(video))
    assert len(frames) == 6
    assert {frame.shape for frame in frames} == {(48, 64, 3)}
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(frame.mean((0, 1)), [40 * i, 20, 200 - 30 * i], atol=12)
    assert video_info(video) == INFO
    assert [path.name for path in video.parent.iterdir()] == ["drive.mp4"]


def test_sampled_frames_are_spread(video):
    reds = [frame[..., 0].mean() for frame in sample_frames(video, 3)]
    np.testing.assert_allclose(reds, [0, 80, 160], atol=12)


def test_frames_of_a_video_without_a_count_are_spread_as_well(tmp_path):
    """Regression: all but the first were the next ones, as every place in it was 0. A bare stream has no header."""
    jpegs = [cv2.imencode(".jpg", np.full((48, 64, 3), 12 * i, np.uint8))[1].tobytes() for i in range(20)]
    (tmp_path / "stream.avi").write_bytes(b"".join(jpegs))
    assert video_info(tmp_path / "stream.avi").frames == 0
    for count, places in ((3, [0, 4, 12]), (30, range(20)), (1, [0])):
        levels = [frame.mean() for frame in sample_frames(tmp_path / "stream.avi", count)]
        np.testing.assert_allclose(levels, [12 * i for i in places], atol=2)


@pytest.mark.parametrize(
    ("rate", "written"),
    [(119.923, 119.92), (66.667, 66.67), (999.987, 25.0), (240.001, 240.0), (119.88, 119.88), (29.97, 29.97)],
)
def test_videos_of_uneven_rates_are_written(tmp_path, rate, written, capfd):
    """Regression: MPEG-4 counts at most 65,535 ticks a second, and OpenCV refused thousandths of more frames."""
    with writing_video(tmp_path / "fast.mp4", VideoInfo(3, rate, 64, 48)) as writer:
        writer.add(np.zeros((48, 64, 3), np.uint8))
    assert len(list(read_frames(tmp_path / "fast.mp4"))) == 1
    assert video_info(tmp_path / "fast.mp4").rate == pytest.approx(written, abs=1e-3)
    assert capfd.readouterr().err == ""


def test_an_interrupted_video_is_not_left(tmp_path):
    def interrupted():
        with writing_video(tmp_path / "drive.mp4", INFO) as writer:
            writer.add(np.zeros((48, 64, 3), np.uint8))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_writer_leaves_is_known_as_temporary(tmp_path):
    with writing_video(tmp_path / "drive.mp4", INFO) as writer:
        writer.add(np.zeros((48, 64, 3), np.uint8))
        left = list(tmp_path.iterdir())
    assert left
    assert all(map(is_temporary, left))


def test_damaged_files_are_named(video, tmp_path, capfd):
    (tmp_path / "bad.avi").write_bytes(b"nothing")
    for path, message in ((tmp_path / "bad.avi", "damaged or no video"), (tmp_path / "none.mp4", "there is no file")):
        for read in (video_info, lambda path: next(read_frames(path)), lambda path: sample_frames(path, 2)):
            with pytest.raises(UserError, match=message):
                read(path)
    whole = video.read_bytes()
    for kept in (1 / 3, 0.9):
        video.write_bytes(whole[: int(kept * len(whole))])
        with pytest.raises(UserError, match=r"drive.mp4"):
            list(read_frames(video))
    assert capfd.readouterr() == ("", "")  # nothing of OpenCV and FFmpeg

"""`tflane predict` on many photos: one that cannot be read, and a run that is stopped, lose nothing else."""

import json
import sys
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.shared import rename
from tflane_jax.commands import predict as predict_command
from tflane_jax.commands import predict_photos, sources
from tflane_jax.datasets.photos import fit_photo
from tflane_jax.errors import UserError
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.tasks.photo_lanes import PhotoLanes

cv2 = pytest.importorskip("cv2")


class Reader:
    """Sees one lane in every photo that the camera fits; the user presses Ctrl-C at a photo 77 pixels wide."""

    def __init__(self, task, params, threshold):
        del task, params, threshold

    def read(self, photo, camera):
        lane = np.array([[1.0, 10.0], [2.0, 20.0]])
        if photo.shape[1] == 77:
            raise KeyboardInterrupt
        return PhotoLanes(fit_photo(photo, camera).placement, (lane,), (0.9,), (0.5,), 0.3, "", 0.2)


@pytest.fixture
def predict(tmp_path, monkeypatch):
    monkeypatch.setattr(predict_photos, "PhotoReader", Reader)
    trained = SimpleNamespace(config=SimpleNamespace(task=None), params=[None], name="model", step=3)

    def run(*files, horizon=None):
        options = Namespace(focal=None, horizon=horizon, threshold=0.5, out=tmp_path / "out")
        return predict_photos.predict(trained, [tmp_path / file for file in files], options)

    return run


def photo(path, size=(40, 60)):
    cv2.imwrite(str(path), np.zeros((*size, 3), np.uint8))


def report(tmp_path):
    return json.loads((tmp_path / "out" / "predictions.json").read_text())


def test_files_that_cannot_be_read_are_recorded_and_the_others_predicted(predict, tmp_path, capsys):
    for name in ("a.png", "z.png"):
        photo(tmp_path / name)
    photo(tmp_path / "low.png", (20, 60))
    (tmp_path / "bad.jpg").write_bytes(b"no image")
    (tmp_path / "drive.mp4").write_bytes(b"no video")
    files = ["a.png", "bad.jpg", "low.png", "z.png", "drive.mp4"]
    assert predict(*files, horizon=30.0) == 2
    found = report(tmp_path)
    assert [record["file"] for record in found["photos"]] == [str(tmp_path / name) for name in ("a.png", "z.png")]
    faults = {record["file"]: record["error"] for record in found["faults"]}
    assert list(faults) == [str(tmp_path / name) for name in ("bad.jpg", "low.png", "drive.mp4")]
    assert "row 30, is below a photo 20 pixels high" in faults[str(tmp_path / "low.png")]
    assert [(record["value"], record["needed"]) for record in found["photos"]] == [(0.3, 0.2)] * 2
    assert (found["videos"], found["complete"]) == ([], True)
    told = capsys.readouterr()
    assert "2 lane lines in 2 photos" in told.out
    assert "3 of 5 files have no answer" in told.err
    for name in ("bad.jpg", "low.png", "drive.mp4"):
        assert told.err.count(str(tmp_path / name)) == 1
    assert predict("a.png") == 0
    assert report(tmp_path)["faults"] == []


def test_a_photo_too_wide_for_opencv_stops_no_other(predict, tmp_path, capsys):
    """Regression: an assertion of OpenCV ended the run."""
    photo(tmp_path / "a.png")
    cv2.imwrite(str(tmp_path / "panorama.png"), np.zeros((20, 33_000), np.uint8))
    assert predict(".") == 2
    assert "panorama.png has 33000 x 20 pixels, more than 32766 on a side" in capsys.readouterr().err
    assert (len(report(tmp_path)["photos"]), report(tmp_path)["complete"]) == (1, True)


def test_every_photo_has_a_picture_of_its_own(predict, tmp_path):
    (tmp_path / "more").mkdir()
    for name in ("a.png", "more/a.png", "more/a-2.png", "more/A.jpg"):
        photo(tmp_path / name)
    assert predict("a.png", "more", "a.png") == 0
    records = report(tmp_path)["photos"]
    assert len(records) == 4  # the one given twice has one answer
    pictures = [record["picture"] for record in records]
    assert len({picture.lower() for picture in pictures}) == 4
    assert all((tmp_path / "out" / picture).is_file() for picture in pictures)


def test_no_photo_is_replaced_by_a_picture(predict, tmp_path):
    (tmp_path / "out").mkdir()
    for name in ("road.png", "road-lanes.png"):
        photo(tmp_path / "out" / name)
    before = (tmp_path / "out" / "road-lanes.png").read_bytes()
    with pytest.raises(
        UserError, match=r"road-lanes.png is one of the files to read, .* from .*road.png would replace it"
    ):
        predict("out")
    assert (tmp_path / "out" / "road-lanes.png").read_bytes() == before
    assert not (tmp_path / "out" / "predictions.json").exists()
    assert predict("out/road.png") == 0  # its earlier picture may be replaced


def test_a_photo_whose_name_is_not_utf8_stops_no_other(predict, tmp_path, capsys):
    photo(tmp_path / "a.png")
    photo(tmp_path / "b.png")
    rename(tmp_path / "b.png", "lat\udce9.png")
    assert predict(".") == 2
    assert "lat\\udce9.png': the name is not UTF-8; rename the file" in capsys.readouterr().err
    written = report(tmp_path)
    assert (len(written["photos"]), len(written["faults"]), written["complete"]) == (1, 1, True)


def test_a_missing_package_is_no_fault_of_the_photos(predict, tmp_path, monkeypatch):
    photo(tmp_path / "a.png")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pictures need matplotlib"):
        predict("a.png")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("inputs", "setting", "said"),
    [
        (["a.png"], {"root": "TUSIMPLE"}, "--root selects labelled examples, and a.png is given too: leave one out"),
        (["a.png"], {"split": "test"}, "--split selects"),
        (["a.png"], {"count": 3}, "--count selects"),
        (["a.png"], {"data_dict": "val"}, "--data-dict selects"),
        ([], {"horizon": 300.0}, "--horizon is of photos: name some, or leave it out"),
        ([], {"focal": 0.0}, "--focal is of photos"),
    ],
)
def test_options_without_effect_are_refused(tmp_path, monkeypatch, inputs, setting, said):
    trained = SimpleNamespace(config=SimpleNamespace(task=LaneShapeTask()), name="model")
    monkeypatch.setattr(predict_command, "opened", lambda options: (trained, [Path(name) for name in inputs]))
    options = dict.fromkeys(
        ("threshold", "split", "data", "root", "openlane", "data_dict", "count", "focal", "horizon")
    )
    options |= {"out": tmp_path} | setting
    with pytest.raises(UserError, match=said):
        predict_command.run(Namespace(**options))


@pytest.mark.parametrize(("name", "what"), [("a.png", "is a file"), ("b.png", "does not exist")])
def test_a_photo_in_place_of_the_model_is_told(tmp_path, name, what):
    photo(tmp_path / "a.png")
    options = Namespace(config=None, weights=None, checkpoint=None, inputs=[tmp_path / name])
    with pytest.raises(UserError, match=f"{name} {what}: the first argument is a run folder, unless --config"):
        sources.opened(options)


def test_a_run_that_is_stopped_keeps_its_answers(predict, tmp_path):
    photo(tmp_path / "a.png")
    photo(tmp_path / "b.png", (40, 77))
    with pytest.raises(KeyboardInterrupt):
        predict("a.png", "b.png")
    found = report(tmp_path)
    assert [record["file"] for record in found["photos"]] == [str(tmp_path / "a.png")]
    assert not found["complete"]


def test_a_video_that_is_stopped_keeps_its_frames(predict, tmp_path, monkeypatch):
    """Regression: all of it was lost, and with a kill nothing was written for as long as it took."""
    video = cv2.VideoWriter(str(tmp_path / "drive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for i in range(9):
        video.write(np.full((48, 64, 3), 20 * i, np.uint8))
    video.release()
    seen = []

    def read(self, photo, camera):
        if len(seen) == 5:
            seen.append(report(tmp_path))
            raise KeyboardInterrupt
        seen.append(photo)
        return PhotoLanes(
            fit_photo(photo, camera).placement, (np.array([[1.0, 10.0], [2.0, 20.0]]),), (0.9,), (0.5,), 0.3, ""
        )

    monkeypatch.setattr(Reader, "read", read)
    monkeypatch.setattr(predict_photos, "_SAVED_EVERY", 0.0)
    monkeypatch.setattr(predict_photos, "_SAVING", np.inf)
    with pytest.raises(KeyboardInterrupt):
        predict("drive.avi", horizon=24.0)
    for found in (seen[-1], report(tmp_path)):  # while it ran, and after
        (record,) = found["videos"]
        assert (len(record["frames"]), record["video"], record["warning"]) == (5, None, "not all frames were read")
        assert not found["complete"]


def test_a_video_that_becomes_unreadable_is_a_fault(predict, tmp_path, monkeypatch):
    """What was read of it is no answer."""
    frames = [np.zeros((48, 64, 3), np.uint8)] * 3

    def broken(path):
        yield from frames
        raise UserError(f"{path}: the frames change their size")

    video = cv2.VideoWriter(str(tmp_path / "drive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for frame in frames:
        video.write(frame)
    video.release()
    monkeypatch.setattr(predict_photos, "read_frames", broken)
    assert predict("drive.avi", horizon=24.0) == 2
    found = report(tmp_path)
    assert (found["videos"], len(found["faults"]), found["complete"]) == ([], 1, True)


def test_a_state_that_cannot_be_written_is_no_fault_of_the_file(predict, tmp_path, monkeypatch):
    """A full disk that is free again costs no answer; one that stays full ends the run."""
    write, failing = predict_photos.write_json, [True]

    def full(path, content):
        if failing and (failing.pop() if len(failing) > 1 else failing[0]):
            raise UserError("no space left")
        write(path, content)

    photo(tmp_path / "a.png")
    monkeypatch.setattr(predict_photos, "_SAVED_EVERY", -1.0)
    monkeypatch.setattr(predict_photos, "write_json", full)
    with pytest.raises(UserError, match="no space left"):
        predict("a.png")
    video = cv2.VideoWriter(str(tmp_path / "drive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for _ in range(3):
        video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    failing[:] = [False, True]  # full while the video is read, once
    assert predict("drive.avi", horizon=24.0) == 0
    found = report(tmp_path)
    assert ([len(one["frames"]) for one in found["videos"]], found["faults"], found["complete"]) == ([3], [], True)


def test_a_photo_with_the_longest_name_that_a_file_can_have_gets_a_picture(predict, tmp_path):
    for end in "ab":
        photo(tmp_path / "photo.png")
        (tmp_path / "photo.png").rename(tmp_path / f"{'道' * 83}{end}.png")  # 254 bytes
    assert predict(".") == 0
    pictures = [record["picture"] for record in report(tmp_path)["photos"]]
    assert pictures == [f"{'道' * 66}-lanes.png", f"{'道' * 66}-2-lanes.png"]


def test_a_video_that_was_cut_off_is_told(predict, tmp_path):
    path = tmp_path / "drive.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for i in range(50):
        video.write(np.full((48, 64, 3), 4 * i, np.uint8))
    video.release()
    for part, said in ((1.0, ""), (0.6, "of 50 frames could be read: is the file whole?")):
        path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
        assert predict("drive.avi", horizon=24.0) == 0
        assert report(tmp_path)["videos"][0]["warning"].endswith(said)
        assert bool(report(tmp_path)["videos"][0]["warning"]) == bool(said)


def test_a_video_says_that_its_horizon_cannot_be_right(predict, tmp_path):
    video = cv2.VideoWriter(str(tmp_path / "drive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for _ in range(3):
        video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    (tmp_path / "drive.avi").rename(tmp_path / "drive.mp4")
    for horizon, said in ((24.0, ""), (46.0, "distorted to 16:9: is row 46 the horizon")):
        assert predict("drive.mp4", horizon=horizon) == 0
        (record,) = report(tmp_path)["videos"]
        assert said in record["warning"]
        assert bool(record["warning"]) == bool(said)

"""`tflane markers`, from the command line to the files that it writes."""

import json
import sys

import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, photo, pose
from tests.shared import rename
from tflane_jax.cli import main
from tflane_jax.commands.markers import _label_place
from tflane_jax.errors import LeftOutWarning
from tflane_jax.markers.curves import Sighting

cv2 = pytest.importorskip("cv2")

INTRINSICS = ["--intrinsics", "900", "900", "480", "270"]


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, places in (("a", {12: pose(9.0, -0.5, 2.0, 15.0)}), ("b", {})):
        cv2.imwrite(str(folder / f"{name}.png"), photo(AHEAD, places)[..., ::-1])
    return folder


def test_detect_writes_poses_and_pictures(photos, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["markers", "detect", str(photos), *INTRINSICS, "--out", str(out)]) == 0
    written = json.loads((out / "detections.json").read_text())
    first, second = written["photos"]
    assert second["markers"] == []
    (marker,) = first["markers"]
    assert marker["id"] == 12
    np.testing.assert_allclose(marker["position"], [9.0, -0.5, 2.0], atol=0.03)
    np.testing.assert_allclose(marker["pose"], pose(9.0, -0.5, 2.0, 15.0), atol=0.03)
    assert marker["turn"] == pytest.approx(15.0, abs=1.0)
    table = capsys.readouterr().out
    assert "a.png" in table
    assert "12" in table
    picture, plain = cv2.imread(str(out / first["picture"])), cv2.imread(str(photos / "a.png"))
    changed = (picture != plain).any(-1)
    assert 100 < changed.sum() < 0.2 * changed.size
    assert (cv2.imread(str(out / second["picture"])) == cv2.imread(str(photos / "b.png"))).all()


def test_no_photo_is_replaced_by_a_picture(photos, capsys):
    other = (photos / "b.png").rename(photos / "000-a-markers.png")
    before = other.read_bytes()
    command = ["markers", "detect", str(photos / "a.png"), str(other), *INTRINSICS]
    assert main([*command, "--out", str(photos)]) == 2
    assert "000-a-markers.png is one of the files to read, and what is made from" in capsys.readouterr().err
    assert other.read_bytes() == before
    assert sorted(path.name for path in photos.iterdir()) == ["000-a-markers.png", "a.png"]


def test_pictures_of_an_earlier_run_are_no_photos(photos, capsys):
    """Regression: the second run in one folder searched those of the first, the third those of both."""
    (photos / "b.png").unlink()
    command = ["markers", "detect", str(photos), *INTRINSICS, "--out", str(photos)]
    assert main(command) == 0
    for _ in range(2):
        with pytest.warns(LeftOutWarning) as told:
            assert main(command) == 0
        assert any("1 picture of an earlier run in" in str(each.message) for each in told)
        assert len(json.loads((photos / "detections.json").read_text())["photos"]) == 1
    assert sorted(path.name for path in photos.iterdir()) == ["000-a-markers.png", "a.png", "detections.json"]
    (photos / "a.png").unlink()
    with pytest.warns(LeftOutWarning):
        assert main(command) == 2
    assert "holds no photos but pictures of an earlier run" in capsys.readouterr().err


def test_a_photo_too_long_for_opencv_is_a_fault(photos, tmp_path, capsys):
    """Regression: cv2.undistort raised, and the answers of all photos were lost."""
    cv2.imwrite(str(photos / "c.png"), np.zeros((40, 33_000, 3), np.uint8))
    intrinsics = ["--intrinsics", "900", "900", "480", "20", "--distortion", "1e-4", "0", "0", "0"]
    assert main(["markers", "detect", str(photos / "c.png"), *intrinsics, "--out", str(tmp_path / "out")]) == 2
    assert "c.png has 33000 x 40 pixels; lens distortion" in capsys.readouterr().err


def test_a_photo_whose_name_is_not_utf8_is_a_fault(photos, tmp_path, capsys):
    rename(photos / "a.png", "K\udcfcste.png")
    assert main(["markers", "detect", str(photos), *INTRINSICS, "--out", str(tmp_path / "out")]) == 2
    assert "the name is not UTF-8; rename the file" in capsys.readouterr().err
    written = json.loads((tmp_path / "out" / "detections.json").read_text())
    assert [photo["file"] for photo in written["photos"]] == [str(photos / "b.png")]
    assert [fault["file"] for fault in written["faults"]] == [f"{photos}/K\\udcfcste.png"]


def two_boards(path, far=(15.0, 2.0, 2.0)):
    """Write a photo with two boards of id 42, the second one in the columns of its own."""
    near, second = (photo(AHEAD, {42: pose(*place)}) for place in ((9.0, -2.0, 2.0), far))
    columns = slice(200, 480)
    near[:, columns] = second[:, columns]
    cv2.imwrite(str(path), near[..., ::-1])


def test_two_boards_with_one_id_are_both_reported(tmp_path, capsys):
    two_boards(tmp_path / "twice.png")
    out = tmp_path / "out"
    assert main(["markers", "detect", str(tmp_path / "twice.png"), *INTRINSICS, "--out", str(out)]) == 0
    found = json.loads((out / "detections.json").read_text())["photos"][0]["markers"]
    assert [(marker["id"], marker["contradictory"]) for marker in found] == [(42, True), (42, True)]
    np.testing.assert_allclose(sorted(marker["position"][0] for marker in found), [9.0, 15.0], atol=0.1)
    assert all(np.shape(marker["corners"]) == (4, 2) for marker in found)
    said = capsys.readouterr()
    assert said.out.count("contradictory") == 2
    assert "twice.png: marker 42 is at several places, x and y (9.0, -2.0) and (15.0, 2.0) m" in said.err
    (picture,) = out.glob("*.png")
    red = (cv2.imread(str(picture))[..., ::-1] == (255, 59, 48)).all(-1)
    assert (cv2.imread(str(tmp_path / "twice.png"))[..., ::-1] == (255, 59, 48)).all(-1).sum() < red.sum() - 100


@pytest.mark.parametrize("middle", [(480, 260), (5, 5), (955, 5), (5, 535), (955, 535)])
def test_the_label_of_a_board_lies_in_the_picture(middle):
    outline = np.add(middle, [(-20, -20), (20, -20), (20, 20), (-20, 20)])
    taken = []
    for _ in range(3):  # of boards at one place: no label lies on another
        left, bottom = _label_place(outline, (130, 12), (960, 540), 4, taken)
        assert 0 <= left <= 960 - 130
        assert 12 <= bottom <= 540
        assert bottom - 12 >= outline[:, 1].max() or bottom <= outline[:, 1].min()
        assert all(bottom - 12 >= lower or bottom <= upper for _, upper, _, lower in taken)
        taken.append((left, bottom - 12, left + 130, bottom))


def test_distance_is_proportional_to_marker_size(photos, tmp_path):
    assert main(["markers", "detect", str(photos / "a.png"), *INTRINSICS, "--size", "0.5", "--out", str(tmp_path)]) == 0
    (marker,) = json.loads((tmp_path / "detections.json").read_text())["photos"][0]["markers"]
    assert marker["position"][0] == pytest.approx(4.5, abs=0.02)


def test_a_damaged_photo_is_named_and_the_others_are_searched(photos, tmp_path, capsys):
    """Sorted by name it comes before the photo with the marker."""
    out, damaged = tmp_path / "out", photos / "0.png"
    damaged.write_bytes((photos / "a.png").read_bytes()[:40])
    assert main(["markers", "detect", str(photos), *INTRINSICS, "--out", str(out)]) == 2
    written = json.loads((out / "detections.json").read_text())
    assert [[marker["id"] for marker in photo["markers"]] for photo in written["photos"]] == [[12], []]
    (fault,) = written["faults"]
    assert fault["file"] == str(damaged)
    said = capsys.readouterr()
    assert fault["error"] in said.err
    assert "photos without an answer: 1 of 3" in said.err
    assert "a.png" in said.out


def test_a_photo_with_the_longest_name_that_a_file_can_have_gets_a_picture(photos, tmp_path):
    """Regression: that of the picture is longer, and the answers of all photos were lost."""
    (photos / "b.png").rename(photos / f"{'道' * 83}é.png")  # 255 bytes
    assert main(["markers", "detect", str(photos), *INTRINSICS, "--out", str(tmp_path / "out")]) == 0
    first, second = json.loads((tmp_path / "out" / "detections.json").read_text())["photos"]
    assert [marker["id"] for marker in first["markers"]] == [12]
    assert second["picture"] == f"001-{'道' * 66}-markers.png"
    assert (tmp_path / "out" / second["picture"]).is_file()


def test_a_picture_that_cannot_be_written_is_a_fault_of_its_photo(photos, tmp_path, capsys):
    out = tmp_path / "out"
    (out / "000-a-markers.png").mkdir(parents=True)
    assert main(["markers", "detect", str(photos), *INTRINSICS, "--out", str(out)]) == 2
    written = json.loads((out / "detections.json").read_text())
    assert [photo["picture"] for photo in written["photos"]] == ["001-b-markers.png"]
    assert written["faults"][0]["file"].endswith("a.png")
    assert "000-a-markers.png" in capsys.readouterr().err


def test_intrinsics_of_another_image_size_are_a_fault(photos, tmp_path, capsys):
    """The principal point lies outside; a pose would be silently wrong."""
    out = tmp_path / "out"
    intrinsics = ["--intrinsics", "1776", "1776", "775", "1024"]
    assert main(["markers", "detect", str(photos / "a.png"), *intrinsics, "--out", str(out)]) == 2
    written = json.loads((out / "detections.json").read_text())
    assert written["photos"] == []
    words = "a.png is 960 x 540, but the principal point is (775, 1024): are the intrinsics of another image size?"
    assert words in written["faults"][0]["error"]
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--family", "QR"], "ARUCO_5X5_100"),
        (["--size", "0"], "tflane: --size is 0.0: it must be"),
        (["--size", "300"], "tflane: --size is 300.0: it must be a finite number from 0.01 to 100 metres"),
        (["--distortion", "0.1"], "--distortion"),
        (["--intrinsics", "0", "900", "1", "1"], "--intrinsics"),
        (["--enlarge", "0"], "tflane: --enlarge is 0: it must be"),
        (["--height", "nan"], "tflane: --height takes finite numbers"),
        (["--pitch", "inf"], "tflane: --pitch takes finite numbers"),
        (
            ["--height", "-1"],
            "--height is that of the camera above the ground, above 0 and up to 100 metres, not -1",
        ),
        (["--height", "1e39"], "above 0 and up to 100 metres, not 1e+39"),
        (["--distortion", "1e30", "0", "0", "0"], "tflane: --distortion holds numbers up to 100, not 1e+30"),
        (["--intrinsics", "1e30", "900", "480", "270"], "with FX and FY above 0 and up to 1,000,000, not 1e+30 900"),
        (["--pitch", "91"], "tflane: --pitch is from -90 to 90 degrees, not 91"),
        (["--distortion", "0.1", "nan", "0", "0"], "tflane: --distortion takes finite numbers"),
        (["--intrinsics", "900", "900", "nan", "1"], "tflane: --intrinsics takes finite numbers"),
    ],
)
def test_errors_name_the_remedy(photos, tmp_path, capsys, change, words):
    assert main(["markers", "detect", str(photos), *INTRINSICS, *change, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "option",
    [
        *(
            "--scales -1",
            "--scales 0.2000001 0.2000002",
            "--seeds 0",
            "--sigma-d 0",
            "--sigma-d inf",
            "--distances 0.5",
        ),
        *("--distances 1e9", "--severity 2", "--enlarge 1000"),
    ],
)
def test_curves_refuse_invalid_settings_by_the_name_of_the_option(option, tmp_path, capsys):
    assert main(["markers", "curves", "--out", str(tmp_path / "out"), *option.split()]) == 2
    said = capsys.readouterr().err
    assert said.startswith("tflane: --")
    assert option.split()[0] in said
    assert not (tmp_path / "out").exists()


def test_curves_name_distances_at_which_no_image_has_a_board(tmp_path, capsys):
    arguments = ["markers", "curves", "--seeds", "1", "--scales", "0.3", "--corners", "subpixel"]
    assert main([*arguments, "--out", str(tmp_path / "out"), "--distances", "1.5"]) == 2
    assert "no board lies wholly in an image at 1.5 m: give larger --distances" in capsys.readouterr().err
    assert main([*arguments, "--out", str(tmp_path / "out"), "--distances", "1.5", "12", "12"]) == 0
    assert "no board lies wholly in an image at 1.5 m, left out of the table" in capsys.readouterr().err
    written = json.loads((tmp_path / "out" / "curves-subpixel-0.3.json").read_text())
    assert [(row["distance m"], row["boards"]) for row in written["rows"]] == [(12.0, 3)]  # once, though given twice


def test_without_matplotlib_curves_are_tables(tmp_path, monkeypatch, capsys):
    seen = [Sighting(0, 0.0, 12.0, False, 20.0)]
    monkeypatch.setattr("tflane_jax.commands.markers.measure", lambda configs: [seen for _ in configs])
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    (tmp_path / "curves.png").touch()  # of an earlier measurement
    arguments = ["--scales", "0.3", "--corners", "subpixel", "--distances", "12", "--out", str(tmp_path)]
    assert main(["markers", "curves", *arguments]) == 0
    said = capsys.readouterr()
    assert said.err.startswith("no pictures, which need matplotlib: ")
    assert said.out.endswith(f"written to {tmp_path}\n")
    assert {path.name for path in tmp_path.iterdir()} == {"curves-subpixel-0.3.md", "curves-subpixel-0.3.json"}

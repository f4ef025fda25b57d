"""`tflane markers run`: from images, poses and a store to pictures and frames.json."""

import datetime
import json
import shutil
import warnings
from argparse import Namespace

import numpy as np
import pytest

from tests.markers.test_detection import AHEAD, pose
from tests.markers.test_reader import BOARDS, LANES, SECOND, ego, seen_from
from tests.tasks.test_marker_drive import Remembering
from tflane_jax.cli import main
from tflane_jax.commands import marker_run
from tflane_jax.datasets.drive_files import Drive, DriveCamera, DriveFrame, load_drive, save_drive
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose
from tflane_jax.markers.store import store_of
from tflane_jax.markers.store_files import save_store
from tflane_jax.priors.markers import MarkerPriorConfig, confidence
from tflane_jax.scene.logs import PlacedMarkers
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.marker_drive import DriveModel, FrameRateWarning

cv2 = pytest.importorskip("cv2")
pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Four frames half a second apart: board 3 in two of them, then none, then an unknown one with an old one."""
    folder = tmp_path_factory.mktemp("drive")
    boards = PlacedMarkers(np.array([3]), BOARDS[3][None])
    near = store_of(LANES, boards, surveyed=datetime.date(2026, 1, 15))
    old = store_of(LANES, PlacedMarkers(np.array([8]), BOARDS[8][None]))
    store = json.loads(save_store(near, folder / "store.json").read_text())
    aged = json.loads(save_store(old, folder / "old.json").read_text())["markers"][0]
    store["markers"].append(aged | {"surveyed": "2025-01-01"})
    (folder / "store.json").write_text(json.dumps(store))
    shown = [(0.0, {3: BOARDS[3]}), (2.0, {3: BOARDS[3]}), (4.0, {}), (6.0, {8: BOARDS[8], 40: pose(25.0, -3.0, 3.0)})]
    frames = []
    for number, (x, there) in enumerate(shown):
        file = folder / f"{number}.png"
        cv2.imwrite(str(file), np.asarray(seen_from(x, there).image[0])[..., ::-1])
        frames.append(DriveFrame(number * SECOND // 2, ego(x), {"front": file}))
    cameras = (DriveCamera("front", AHEAD.intrinsics, invert_pose(AHEAD.camera_from_ego)),)
    save_drive(Drive(cameras, tuple(frames)), folder / "poses.json", folder)
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))


def arguments(folder, out, **changed):
    options = {"store": folder / "store.json", "images": folder, "poses": folder / "poses.json", "out": out}
    options["search"] = "outlines"  # whole boards; the search for hidden ones takes seconds an image
    options |= {"today": "2026-02-01", "max-age-days": 30, "interval": 0.5} | changed
    return ["markers", "run", *(text for name, value in options.items() for text in (f"--{name}", str(value)))]


@pytest.mark.parametrize(("lost", "of"), [("frames.json", "poses"), ("001.png", "images")])
def test_a_drive_is_not_replaced_by_what_is_made_of_it(drive, tmp_path, capsys, lost, of):
    """The images were overwritten by pictures, and the poses by frames.json, with exit code 0."""
    folder = shutil.copytree(drive, tmp_path / "drive")
    if of == "images":
        (folder / "1.png").rename(folder / lost)
        (folder / "poses.json").write_text((folder / "poses.json").read_text().replace('"1.png"', f'"{lost}"'))
    else:
        (folder / "poses.json").rename(folder / lost)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    poses = folder / (lost if of == "poses" else "poses.json")
    assert main(arguments(folder, folder, poses=poses)) == 2
    assert f"{lost} is one of the files to read, and what is made from {poses} would" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_drive_from_pixels_to_lanes(drive, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(arguments(drive, out)) == 0
    record = json.loads((out / "frames.json").read_text())
    first, second, gap, last = record["frames"]
    assert [frame["picture"] for frame in record["frames"]] == ["000.png", "001.png", "002.png", "003.png"]
    assert all(cv2.imread(str(out / frame["picture"])) is not None for frame in record["frames"])
    (board,) = second["boards"]
    assert (board["id"], board["outcome"], board["size"]) == (3, "used", 1.0)
    np.testing.assert_allclose(board["position"], [18.0, -5.0, 2.5], atol=0.1)
    trust = confidence(np.array([board["distance"]]), np.array([board["residual"]]), MarkerPriorConfig())[0]
    assert board["confidence"] == pytest.approx(trust, abs=1e-3)
    assert second["gate"] == pytest.approx(trust, abs=1e-3)
    assert not second["remembered"]
    # Without a board the lanes of the frames before, moved with the vehicle and trusted less.
    assert gap["boards"] == []
    assert gap["remembered"]
    assert gap["gate"] == pytest.approx(0.9 * second["gate"], abs=1e-3)
    for points in (np.array(lane["points"]) for lane in gap["guidance"]):
        np.testing.assert_allclose(points[:, 1], -2.0, atol=0.6)
    assert {board["id"]: board["outcome"] for board in last["boards"]} == {8: "stale", 40: "unknown"}
    assert all("confidence" not in board for board in last["boards"])
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[4].split("|")[1:-1]]
    assert row == ["4", "4", "2", "2", "1", "1", "0", "0", "0", "0"]
    assert first["guidance"]


def test_both_boards_of_one_id_are_counted_and_recorded(drive, tmp_path, capsys):
    images, out = tmp_path / "images", tmp_path / "out"
    shutil.copytree(drive, images)
    left, right = (seen_from(0.0, {3: pose(*place)}).image[0] for place in ((15.0, 3.0, 2.0), (20.0, -5.0, 2.5)))
    both = np.concatenate([left[:, :480], right[:, 480:]], 1)
    cv2.imwrite(str(images / "1.png"), both[..., ::-1])
    assert main(arguments(drive, out, images=images)) == 0
    boards = json.loads((out / "frames.json").read_text())["frames"][1]["boards"]
    assert [(board["id"], board["outcome"], board["camera"]) for board in boards] == [(3, "contradictory", "front")] * 2
    middles = sorted(np.mean(board["corners"], 0)[0] for board in boards)
    assert middles[0] < 480 < middles[1]
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[4].split("|")[1:-1]]
    assert row[3:] == ["1", "1", "1", "2", "0", "0", "0"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"store": "gone.json"}, "gone.json"),
        ({"poses": "gone.json"}, "gone.json"),
        ({"images": "gone"}, "there is no image"),
        ({"today": "July"}, "--today"),
        ({"family": "QR"}, "ARUCO_5X5_100"),
        ({"max-age-days": -1}, "--max-age-days"),
        ({"interval": 0}, "--interval"),
        ({"interval": float("inf")}, "--interval is a positive number of seconds, not inf"),
        ({"model": "gone"}, "gone"),
    ],
)
def test_errors_are_one_message(drive, tmp_path, capsys, change, words):
    assert main(arguments(drive, tmp_path / "out", **change)) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("surveyed", "words"),
    [
        (None, 'store.json: 1 of 2 markers have no day of survey (first: 3), so they count as stale: write "surveyed"'),
        ("2026-02-02", "store.json: 1 of 2 markers were surveyed after 2026-02-01 (first: 3 on 2026-02-02): correct"),
    ],
)
def test_dates_that_make_no_sense_are_told(drive, tmp_path, capsys, surveyed, words):
    record = json.loads((drive / "store.json").read_text())
    record["markers"][0]["surveyed"] = surveyed
    (tmp_path / "store.json").write_text(json.dumps(record))
    assert main(arguments(drive, tmp_path / "out", store=tmp_path / "store.json")) == 0
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("empty", "words"),
    [(True, "it holds no marker, so that no frame gets a prior"), (False, "its 2 markers have no lanes, so that no")],
)
def test_a_store_that_guides_no_frame_is_told(drive, tmp_path, capsys, empty, words):
    record = json.loads((drive / "store.json").read_text())
    markers = [marker | {"lanes": [], "successors": []} for marker in record["markers"]]
    (tmp_path / "store.json").write_text(json.dumps(record | {"markers": [] if empty else markers}))
    assert main(arguments(drive, tmp_path / "out", store=tmp_path / "store.json")) == 0
    assert words in capsys.readouterr().err


def test_a_board_without_lanes_is_not_used(drive, tmp_path, capsys):
    record = json.loads((drive / "store.json").read_text())
    record["markers"][0] |= {"lanes": [], "successors": []}
    (tmp_path / "store.json").write_text(json.dumps(record))
    out = tmp_path / "out"
    assert main(arguments(drive, out, store=tmp_path / "store.json")) == 0
    (board,) = json.loads((out / "frames.json").read_text())["frames"][0]["boards"]
    assert board["outcome"] == "no lanes"
    assert "confidence" not in board
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[4].split("|")[1:-1]]
    assert row[-2] == "2"
    assert row[3] == "0"


def test_any_number_of_days_is_an_age():
    day = datetime.date(2026, 2, 1)
    old = store_of(LANES, PlacedMarkers(np.array([3]), BOARDS[3][None]), surveyed=datetime.date(1, 1, 1)).markers[3]
    age = marker_run._age(Namespace(max_age_days=10**12))
    assert not old.outdated(day, age)
    assert marker_run._age(Namespace(max_age_days=None)) is None


def test_a_damaged_image_counts_as_missing_and_is_named(drive, tmp_path, capsys):
    images, out = tmp_path / "images", tmp_path / "out"
    shutil.copytree(drive, images)
    (images / "1.png").write_bytes(b"cut off")
    assert main(arguments(drive, out, images=images)) == 2
    record = json.loads((out / "frames.json").read_text())
    first, damaged, gap, last = record["frames"]
    assert [[board["id"] for board in frame["boards"]] for frame in (first, damaged, gap)] == [[3], [], []]
    assert damaged["remembered"]
    assert gap["remembered"]
    assert {board["id"] for board in last["boards"]} == {8, 40}
    (fault,) = record["faults"]
    assert fault["file"] == str(images / "1.png")
    said = capsys.readouterr().err
    assert fault["error"] in said
    assert "images of the drive left out: 1" in said
    read = load_drive(images / "poses.json", images)
    with pytest.raises(UserError, match=r"1\.png"):
        read.views(read.frames[1])


def test_a_store_of_another_family_is_refused(drive, tmp_path, capsys):
    """With the wrong family no board is ever found."""
    record = json.loads((drive / "store.json").read_text())
    record["markers"][0]["id"] = 40
    (tmp_path / "store.json").write_text(json.dumps(record))
    change = {"store": tmp_path / "store.json", "family": "APRILTAG_16H5"}
    assert main(arguments(drive, tmp_path / "out", **change)) == 2
    assert "store.json holds marker 40, and ids of APRILTAG_16H5 end at 29" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_model_that_cannot_read_the_images_is_refused_before_they_are_searched(drive, tmp_path, capsys, monkeypatch):
    model = DriveModel(LaneGraphTask(), {}, ProceduralConfig())
    monkeypatch.setattr(marker_run, "_model", lambda folder: model)
    monkeypatch.setattr(marker_run, "search_views", lambda *_: pytest.fail("searched"))
    assert main(arguments(drive, tmp_path / "out", model="evidence")) == 2
    assert "BEV evidence" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("streams", [False, True])
def test_the_rate_of_frames_counts_for_models_with_memory_alone(drive, tmp_path, monkeypatch, streams):
    """Frames of training are 2 s apart, those of the drive half a second."""

    def search(*_):
        raise UserError("searched")

    model = DriveModel(Remembering(streams), {}, ProceduralConfig())  # pyright: ignore
    monkeypatch.setattr(marker_run, "_model", lambda folder: model)
    monkeypatch.setattr(marker_run, "fitted_views", lambda views, source: views)
    monkeypatch.setattr(marker_run, "search_views", search)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert main(arguments(drive, tmp_path / "out", model="any")) == 2
    assert [each.category for each in found] == [FrameRateWarning] * streams


def test_frames_before_an_error_are_kept(drive, tmp_path, monkeypatch):
    drawn = marker_run.save_drive_frame

    def draw(path, *rest, **more):
        if path.name == "002.png":
            raise UserError("full")
        return drawn(path, *rest, **more)

    monkeypatch.setattr(marker_run, "save_drive_frame", draw)
    assert main(arguments(drive, tmp_path / "out")) == 2
    written = json.loads((tmp_path / "out" / "frames.json").read_text())
    assert not written["complete"]
    assert [frame["picture"] for frame in written["frames"]] == ["000.png", "001.png"]


def test_lanes_that_the_prior_does_not_take_are_counted(drive, tmp_path, capsys):
    """The board of the first two frames has 40 lanes side by side, the prior of a model without markers takes 32."""
    content = json.loads((drive / "store.json").read_text())
    (entry,) = [entry for entry in content["markers"] if entry["id"] == 3]
    lane = np.array(entry["lanes"][0])
    entry["lanes"] = [(lane + 0.05 * number * np.array([0.0, 0.0, 1.0])).tolist() for number in range(40)]
    entry["successor"] = []
    (tmp_path / "store.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    assert main(arguments(drive, out, store=tmp_path / "store.json")) == 0
    frames = json.loads((out / "frames.json").read_text())["frames"]
    assert [frame["lanes_dropped"] for frame in frames] == [8, 8, 0, 0]
    assert len(frames[0]["guidance"]) == 32
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[4].split("|")[1:-1]]
    assert row[-1] == "16"


def test_pictures_of_an_earlier_drive_do_not_stay(drive, tmp_path):
    out, poses = tmp_path / "out", tmp_path / "poses.json"
    assert main(arguments(drive, out)) == 0
    (out / "own.png").write_bytes(b"")
    content = json.loads((drive / "poses.json").read_text())
    poses.write_text(json.dumps(content | {"frames": content["frames"][:2]}))
    assert main(arguments(drive, out, poses=poses)) == 0
    assert sorted(path.name for path in out.iterdir()) == ["000.png", "001.png", "frames.json", "own.png"]


def test_a_drive_without_images_is_refused_and_a_camera_without_any_is_told(drive, tmp_path, capsys):
    content = json.loads((drive / "poses.json").read_text())
    poses = tmp_path / "poses.json"
    content["cameras"].append(content["cameras"][0] | {"name": "rear"})
    poses.write_text(json.dumps(content))
    assert main(arguments(drive, tmp_path / "one", poses=poses)) == 0
    assert "warning: " + f"{poses}: no frame has an image of rear" in capsys.readouterr().err
    for frame in content["frames"]:
        frame["images"] = {}
    poses.write_text(json.dumps(content))
    assert main(arguments(drive, tmp_path / "none", poses=poses)) == 2
    assert f"{poses}: no frame names an image" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()

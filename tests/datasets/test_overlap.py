"""The overlap of splits: distances within one city only, for both file formats."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.datasets.nuscenes_small import write_nuscenes
from tests.datasets.test_nuscenes_scenes import content
from tests.datasets.test_nuscenes_scenes import write as write_scene
from tests.shared import shared_root
from tflane_jax.cli import main
from tflane_jax.datasets import nuscenes, nuscenes_scenes
from tflane_jax.datasets.base import FrameInfo
from tflane_jax.datasets.overlap import NEAR_GROUPS, DrivenPath, frame_drives, nearness, overlap, read_drives
from tflane_jax.errors import UserError


def drive(name, *positions, area="PIT"):
    return DrivenPath(name, area, np.array(positions, float).reshape(-1, 2))


def test_distances_by_hand():
    train = [drive("a", (0, 0), (10, 0)), drive("b", (100, 0))]
    found = overlap(train, [drive("x", (13, 4), (40, 0)), drive("y", (100, 12))])
    np.testing.assert_allclose(found.distances[0], [5, 30])
    np.testing.assert_allclose(found.distances[1], [12])
    assert found.nearest == ("a", "b")
    assert found.rows() == [
        {"within m": 5.0, "frames": pytest.approx(1 / 3), "drives": 0.5},
        {"within m": 10.0, "frames": pytest.approx(1 / 3), "drives": 0.5},
        {"within m": 20.0, "frames": pytest.approx(2 / 3), "drives": 1.0},
        {"within m": 50.0, "frames": 1.0, "drives": 1.0},
    ]
    assert [row["drive"] for row in found.worst()] == ["y", "x"]


def test_cities_are_never_compared():
    found = overlap([drive("a", (0, 0))], [drive("x", (0, 0), area="MIA")])
    assert found.nearest == ("-",)
    assert np.isinf(found.distances[0]).all()
    assert found.rows()[-1]["frames"] == 0.0
    assert found.worst() == []


class Frames:
    """A dataset of which only the places of its frames are known: (scene, x, y, area)."""

    name = "frames"

    def __init__(self, *frames):
        self.frames = frames

    def __len__(self):
        return len(self.frames)

    def example(self, index):
        raise AssertionError("places need no examples")

    def info(self, index):
        scene, x, y, area = self.frames[index]
        pose = np.eye(4)
        pose[:2, 3] = x, y
        return FrameInfo("nuscenes", scene, index, pose, area)


def test_frames_are_grouped_by_the_nearest_training_frame_of_their_city():
    near, far = NEAR_GROUPS
    frames = Frames(("x", 3, 4, "PIT"), ("y", 0, 0, "MIA"), ("x", 5.1, 0, "PIT"), ("y", 100, 0, "MIA"))
    found = nearness([drive("a", (0, 0)), drive("b", (100, 1), area="MIA")], frames)
    np.testing.assert_allclose(found.distances, [5.0, 100.005, 5.1, 1.0], atol=1e-3)
    assert found.groups == [near, far, far, near]
    assert found.sentence() == "2 of 4 frames are within 5 m of a training frame; the nearest is 1.0 m away"
    assert nearness([drive("a", (0, 0), area="WDC")], frames).sentence().endswith("none is of the same city")


def test_a_frame_without_a_city_may_be_in_any_and_the_result_says_so():
    frames = Frames(("x", 1, 2, ""), ("z", 300, 4, "PIT"), ("x", 500, 6, ""))
    drives = frame_drives(frames)
    assert [(one.name, one.area) for one in drives] == [("x", ""), ("z", "PIT")]
    np.testing.assert_array_equal(drives[0].positions, [[1, 2], [500, 6]])
    train = [drive("a", (1, 3)), drive("b", (300, 4), area="MIA"), drive("c", (500, 7), (300, 8), area="")]
    found = nearness(train, frames)
    np.testing.assert_allclose(found.distances, [1.0, 4.0, 1.0])  # not 0: Miami is not Pittsburgh
    assert found.assumed.tolist() == [True, True, True]
    assert "city of 3 of them, which may be another with equal coordinates" in found.sentence()
    named = nearness([*train[:2], drive("d", (300, 5))], frames)
    np.testing.assert_allclose(named.distances, [1.0, 1.0, 200.0], atol=0.01)
    assert named.assumed.tolist() == [True, False, True]
    assert "city of 1 of them" in named.sentence()


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(1, 30), st.integers(1, 30))
def test_distances_equal_a_plain_loop(seed, n, m):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-50, 50, (n, 2)), rng.uniform(-50, 50, (m, 2))
    found = overlap([DrivenPath("a", "PIT", a)], [DrivenPath("b", "PIT", b)])
    np.testing.assert_allclose(found.distances[0], np.linalg.norm(a[None] - b[:, None], axis=-1).min(1), atol=1e-9)


@pytest.mark.parametrize("empty", ["training", "validation"])
def test_no_frames_is_an_error(empty):
    sides = {"training": [drive("a", (0, 0))], "validation": [drive("x", (0, 0))]} | {empty: [drive("e")]}
    with pytest.raises(UserError, match=f"the {empty} split has no frames"):
        overlap(sides["training"], sides["validation"])


def write_segment(root, segment, *translations):
    (root / segment / "info").mkdir(parents=True)
    for i, translation in enumerate(translations):
        text = json.dumps({"pose": {"translation": translation}})
        (root / segment / "info" / f"{i}.json").write_text(text)
        (root / segment / "info" / f"{i}-ls.json").write_text("not read")


def test_openlane_folders_on_the_command_line(tmp_path, capsys):
    write_segment(tmp_path / "train", "00001", [0, 0, 1], [10, 0, 1])
    write_segment(tmp_path / "val", "10001", [10, 3, 5])
    out = tmp_path / "overlap"
    assert main(["data", "overlap", str(tmp_path / "train"), str(tmp_path / "val"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "do not name the city" in said
    written = json.loads(out.with_suffix(".json").read_text())
    assert written["rows"][0] == {"within m": 5.0, "frames": 1.0, "drives": 1.0}
    assert written["meta"]["worst"][0]["nearest"] == "00001"


def test_openlane_folders_may_hold_lane_segments_alone(tmp_path):
    write_segment(tmp_path, "00001", [0, 0, 1], [10, 0, 1])
    both = read_drives(tmp_path)
    for i in range(2):
        (tmp_path / "00001" / "info" / f"{i}.json").replace(tmp_path / "00001" / "info" / f"{i}-ls.json")
    (alone,) = read_drives(tmp_path)
    assert alone.name == both[0].name
    np.testing.assert_array_equal(alone.positions, both[0].positions)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ({}, "lacks the entry 'pose'"),
        ({"pose": {"translation": [0, 1]}}, "expected \\(3,\\)"),
        ({"pose": {"translation": [0, float("nan"), 1]}}, "must be finite"),
    ],
)
def test_damaged_frames_are_named(tmp_path, pose, message):
    (tmp_path / "s" / "info").mkdir(parents=True)
    (tmp_path / "s" / "info" / "7.json").write_text(json.dumps(pose))
    with pytest.raises(UserError, match=rf"7\.json.*{message}"):
        read_drives(tmp_path)


def test_a_folder_without_drives_is_named(tmp_path, capsys):
    assert main(["data", "overlap", str(tmp_path), str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_a_folder_of_neither_dataset_is_told_so(tmp_path):
    formats = (
        r"name a folder of Argoverse 2 logs .*, of OpenLane-V2 .*, of nuScenes .* or of its scene files \(\*\.npz\)"
    )
    with pytest.raises(UserError, match=rf"holds no drive: {formats}"):
        read_drives(tmp_path)
    with pytest.raises(UserError, match=rf"^there is no \S+: {formats}"):
        read_drives(tmp_path / "none")


def same_drives(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert (one.name, one.area) == (other.name, other.area)
        np.testing.assert_array_equal(one.positions, other.positions)


def test_nuscenes_is_read_as_evaluation_reads_it(tmp_path):
    root = write_nuscenes(tmp_path)
    drives = {split: nuscenes.SOURCE.drives(nuscenes.NuScenesConfig(root, split=split)) for split in ("train", "val")}
    assert [one.area for one in drives["train"]] == ["singapore-onenorth"]
    same_drives(read_drives(root), drives["train"] + drives["val"])
    for split, expected in drives.items():
        same_drives(read_drives(root, split), expected)
    same_drives(read_drives(root / "v1.0-mini", "val"), drives["val"])
    with pytest.raises(UserError, match="holds no scene of nuScenes' split test: name another folder"):
        read_drives(root, "test")


def test_scene_files_are_read_as_evaluation_reads_them(tmp_path):
    for name in ("scene-0061", "scene-0796"):
        write_scene(tmp_path / f"{name}.npz", content(name))
    config = nuscenes_scenes.SceneFileConfig(tmp_path)
    same_drives(read_drives(tmp_path), nuscenes_scenes.SOURCE.drives(config))
    (val,) = read_drives(tmp_path, "val")
    assert val.name == "scene-0796"
    assert [one.name for one in read_drives(tmp_path / "scene-0061.npz")] == ["scene-0061"]


@pytest.mark.parametrize("files", [False, True])
def test_one_folder_of_nuscenes_is_compared_by_its_official_splits(tmp_path, files, capsys):
    """Of two folders, all scenes are compared: a folder with itself would be all overlap."""
    if files:
        for name in ("scene-0061", "scene-0796"):
            write_scene(tmp_path / f"{name}.npz", content(name))
    else:
        write_nuscenes(tmp_path)
    assert main(["data", "overlap", str(tmp_path), str(tmp_path)]) == 0
    said = capsys.readouterr().out
    frames = 3 if files else 2
    assert f"fraction of {frames} validation frames (1 drives) near a training frame (1 drives)" in said
    assert "official splits, train against val" in said
    assert ("do not name the city" in said) == files
    if files:
        assert main(["data", "overlap", str(tmp_path), str(tmp_path / "scene-0061.npz")]) == 0
        said = capsys.readouterr().out
        assert "near a training frame (2 drives)" in said
        assert "official splits" not in said


def test_real_logs():
    logs = shared_root() / "data" / "argoverse2" / "sensor" / "val"
    if not logs.is_dir():
        pytest.skip("real logs are absent")
    drives = read_drives(logs)
    assert [d.area for d in drives] == ["PIT", "PIT"]
    # The ego vehicle drives 74.9 m in one log and 40.4 m in the other.
    lengths = [np.linalg.norm(np.diff(d.positions, axis=0), axis=-1).sum() for d in drives]
    np.testing.assert_allclose(lengths, [74.9, 40.4], atol=0.3)
    assert overlap(drives, drives).rows()[0] == {"within m": 5.0, "frames": 1.0, "drives": 1.0}
    assert overlap(drives[:1], drives[1:]).rows()[-1]["frames"] == 0.0

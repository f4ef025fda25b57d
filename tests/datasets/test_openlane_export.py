"""A dataset written as OpenLane-V2 and read again."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tests.fakes import FakeConfig, FakeDataset
from tflane_jax.cli import main
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.openlane_export import dense, export_openlane_v2
from tflane_jax.datasets.openlane_frames import SUBSETS
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset
from tflane_jax.datasets.view_images import ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.scoring.openlane_v2 import read_segment_truth, read_truth
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING

SIZES = ExampleConfig(lanes=5, segments=4, areas=2, elements=3)
NATIVE = ImageConfig(divisor=16)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    out = tmp_path_factory.mktemp("openlane") / "made"
    return export_openlane_v2({"train": DriveDataset(), "val": DriveDataset()}, out, images="png", progress=False)


def opened(root, **other) -> OpenLaneV2Dataset:
    config = {"subset": "B", "flavour": "both", "image": NATIVE, "example": SIZES} | other
    return OpenLaneV2Dataset(OpenLaneV2Config(root, **config))


def same_lanes(got, expected, *, boundaries: bool) -> None:
    n = int(expected.valid.sum())
    np.testing.assert_array_equal(got.valid, expected.valid)
    np.testing.assert_array_equal(got.successor, expected.successor)
    np.testing.assert_array_equal(got.is_connector[:n], expected.is_connector[:n])
    for name in ("points", "left", "right")[: 3 if boundaries else 1]:
        np.testing.assert_allclose(getattr(got, name)[:n], getattr(expected, name)[:n], atol=1e-4)
    if boundaries:
        np.testing.assert_array_equal(got.left_type, expected.left_type)
        np.testing.assert_array_equal(got.right_type, expected.right_type)


@pytest.mark.parametrize("index", [0, 4])
def test_written_data_are_read_back(exported, index):
    made, dataset = DriveDataset(), opened(exported)
    assert len(dataset) == len(made)
    expected, got = made.example(index), dataset.example(index)
    got.validate()
    same_lanes(got.lanes, expected.lanes, boundaries=False)
    same_lanes(got.segments, expected.segments, boundaries=True)
    np.testing.assert_allclose(got.areas.points[:1], expected.areas.points[:1], atol=1e-4)
    np.testing.assert_array_equal(got.areas.category, expected.areas.category)
    np.testing.assert_array_equal(got.traffic_elements.valid, [True, True, False])
    for name in ("box", "category", "attribute"):
        theirs = getattr(expected.traffic_elements, name)[1:]
        np.testing.assert_allclose(getattr(got.traffic_elements, name)[:2], theirs, atol=1e-4)
    np.testing.assert_array_equal(got.traffic_elements.lane[:, :2], expected.traffic_elements.lane[:, 1:])
    np.testing.assert_allclose(got.previous_from_ego, expected.previous_from_ego, atol=1e-6)
    assert got.has_previous == expected.has_previous
    np.testing.assert_array_equal(got.cameras.image, expected.cameras.image[:, :32, :48])  # less of the padding
    np.testing.assert_array_equal(got.cameras.size, expected.cameras.size)
    assert got.cameras.valid.all()
    np.testing.assert_allclose(got.cameras.intrinsics, expected.cameras.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(got.cameras.camera_from_ego, expected.cameras.camera_from_ego, atol=1e-6)
    here, there = dataset.info(index), made.info(index)
    assert here.scene == f"train/0100{index // FRAMES}"
    np.testing.assert_allclose(here.global_from_ego, there.global_from_ego)
    if index % FRAMES:
        assert here.timestamp_ns - dataset.info(index - 1).timestamp_ns == 500_000_000


def test_the_layout_is_the_official_one(exported):
    content = json.loads((exported / "data_dict_subset_B.json").read_text())
    assert set(content) == {"train", "val"}
    assert [len(frames) for frames in content["val"].values()] == [FRAMES, FRAMES]
    segment, frames = next(iter(content["val"].items()))
    assert segment == "11000"
    frame = json.loads((exported / "val" / segment / "info" / frames[0]).read_text())
    assert frame["meta_data"]["source_id"] == "scene 0"
    front = frame["sensor"]["CAM_FRONT"]
    assert (exported / front["image_path"]).is_file()
    rotation = np.array(front["extrinsic"]["rotation"])
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-6)  # camera to ego: it looks along x
    assert front["extrinsic"]["translation"] == pytest.approx([1.7, 0.0, 1.51])
    lanes = frame["annotation"]["lane_centerline"]
    assert [len(lane["points"]) for lane in lanes] == [201] * 3
    assert all(isinstance(lane["id"], str) for lane in lanes)
    segments = json.loads((exported / "val" / segment / "info" / frames[0].replace(".json", "-ls.json")).read_text())
    # Element 0 governs lane 0, on which segment 0 lies; element 1 lane 2.
    assert segments["annotation"]["topology_lste"] == [[1, 0], [0, 0], [0, 1]]


def test_ids_stay_with_their_lanes(exported):
    infos = sorted((exported / "train" / "01000" / "info").glob("*[0-9].json"))
    frames = [json.loads(path.read_text())["annotation"] for path in infos]
    lanes = [[lane["id"] for lane in frame["lane_centerline"]] for frame in frames]
    assert [np.roll(lanes[0], k).tolist() for k in range(FRAMES)] == lanes
    elements = [[element["id"] for element in frame["traffic_element"]] for frame in frames]
    assert elements[0] == elements[1] == elements[2]
    assert len(set(elements[0]) | set(lanes[0])) == 5


class Governing(DriveDataset):
    """The same, with elements that tell their segments, crossings by their sides, and as many segments as lanes."""

    def example(self, index):
        example = super().example(index)
        elements, points = example.traffic_elements, example.areas.points.copy()
        points[1, ::] = np.concatenate([np.linspace([9, -3, 0], [9, 3, 0], 10), np.linspace([6, 3, 0], [6, -3, 0], 10)])
        areas = replace(example.areas, points=points, category=np.array([2, 1], np.int32), valid=np.ones(2, bool))
        lanes = jax.tree.map(lambda leaf: leaf[:4], example.lanes)
        lanes = replace(lanes, points=lanes.points[[2, 1, 0, 3]], successor=lanes.successor[:, :4])
        governing = replace(elements, lane=None, segment=elements.lane[:4])
        return replace(example, lanes=lanes, areas=areas, traffic_elements=governing)


def test_segments_govern_lanes_and_sides_become_a_ring(tmp_path):
    """Whatever form an example has, the files have the official one."""
    root = export_openlane_v2({"val": Governing(DriveConfig(scenes=1))}, tmp_path / "made", progress=False)
    path = sorted((root / "val" / "11000" / "info").glob("*-ls.json"))[0]
    segments = json.loads(path.read_text())["annotation"]
    assert segments["topology_lste"] == [[1, 0], [0, 0], [0, 1]]
    ring = [area["points"] for area in segments["area"] if area["category"] == 1]
    assert ring == [[[9, -3, 0], [9, 3, 0], [6, 3, 0], [6, -3, 0], [9, -3, 0]]]
    lanes = json.loads(path.with_name(path.name.replace("-ls", "")).read_text())["annotation"]
    assert lanes["topology_lcte"] == [[0, 1], [0, 0], [1, 0]]  # the first and the third lane have changed places
    sides = OpenLaneV2Config(root, subset="B", split="val", flavour="lane_segment", image=None)
    areas = OpenLaneV2Dataset(replace(sides, example=replace(SIZES, crossings="sides"))).example(0).areas
    np.testing.assert_allclose(areas.points[1], Governing().example(0).areas.points[1], atol=1e-4)


def test_the_scorer_reads_it_too(exported):
    made = DriveDataset().example(0)
    for frames, graph in (
        (read_truth(exported, progress=False), made.lanes),
        (read_segment_truth(exported, progress=False), made.segments),
    ):
        assert len(frames) == 2 * len(DriveDataset())
        truth = next(iter(frames.values()))
        lanes = getattr(truth, "lanes", truth)
        np.testing.assert_allclose(lanes.points, graph.points[:3], atol=1e-4)
        np.testing.assert_array_equal(lanes.elements.attributes, [2, 4])


def test_a_jpeg_looks_the_same(tmp_path):
    made = DriveDataset(DriveConfig(scenes=1, cameras=7))
    root = export_openlane_v2({"test": made}, tmp_path / "made", progress=False)
    views = opened(root, split="test", subset="A").example(1).cameras
    expected = made.example(1).cameras
    np.testing.assert_array_equal(views.size, expected.size)
    assert np.abs(views.image.astype(int) - expected.image[:, :32, :48]).mean() < 1.5


def test_the_command_writes_checks_and_counts(tmp_path, monkeypatch, capsys):
    opened = []

    def open_dataset(source):
        opened.append(source)
        return DriveDataset()

    monkeypatch.setattr("tflane_jax.datasets.sources.open_dataset", open_dataset)
    (tmp_path / "config.py").write_text("from tflane_jax.config import RunConfig as get_config")
    command = ["data", "export", "--config", str(tmp_path / "config.py"), "--out", str(tmp_path / "out")]
    command += ["--data.example.cameras", "default"]
    assert main([*command, "--splits", "val", "test", "--data.val", "5"]) == 0
    # Points along a ring miss its corners, which the official programs read.
    assert {source.example.crossings for source in opened} == {"sides"}
    said = capsys.readouterr().out
    assert "| val " in said
    assert "| test " in said
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["data_dict_subset_B.json", "test", "val"]
    assert main(command) == 2
    assert "is not empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--out full --data.example.cameras default", "full is not empty"),
        ("--out new --tracks full --data.example.cameras default", "full is not empty"),
        ("--out new --tracks ./new --data.example.cameras default", "--out and --tracks are both new"),
        ("--out new/here --tracks new --data.example.cameras default", "--out new/here is inside of --tracks new"),
        ("--out new --config gtn_lane/gtn", "front-views-train are single images"),
        ("--out new", "procedural-train has no camera images, which OpenLane-V2 needs: set data.example.cameras\n"),
        (
            "--out new --data recorded --root .",
            "recorded has no camera images, which OpenLane-V2 needs: choose data with",
        ),
        ("--out new --data argoverse2 --root one", "one has no split train, only val: add --splits val\n"),
        (
            "--out new --data argoverse2 --root one --splits val",
            "argoverse2-val has no camera images, which OpenLane-V2 needs: name a configuration with cameras",
        ),
        (
            "--out new --data argoverse2 --root one/val",
            "one/val is not divided into splits, so --splits train cannot choose among its logs: add --splits val, or ",
        ),
        (
            "--out new --data argoverse2 --root one/val/log",
            "one/val/log is not divided into splits, so --splits train cannot choose among its logs: name a folder ",
        ),
        (
            "--out new --data nuscenes-scenes --root scenes",
            "scenes has no scene of nuScenes' split train: choose --splits val\n",
        ),
    ],
)
def test_what_cannot_be_exported_is_told_before_examples_are_made(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tflane_jax.datasets.sources.open_dataset", lambda source: pytest.fail("opened"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.py").write_text("from tflane_jax.config import RunConfig as get_config")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    (tmp_path / "one" / "val" / "log").mkdir(parents=True)
    (tmp_path / "one" / "val" / "log" / ANNOTATIONS).touch()
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "scene-0103.npz").touch()
    config = [] if "--config" in arguments else ["--config", "config.py"]
    assert main(["data", "export", *config, *arguments.split()]) == 2
    assert capsys.readouterr().err.startswith(f"tflane: {message}")
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix != "") == ["config.py"]
    assert not (tmp_path / "new").exists()


def test_rigs_have_the_official_names():
    assert SUBSETS["A"].cameras == tuple(mount.name for mount in ARGOVERSE2_RING)
    assert SUBSETS["B"].cameras == tuple(mount.name for mount in NUSCENES_RING)


@pytest.mark.parametrize(("points", "stride"), [(11, 20), (5, 50), (21, 10)])
def test_dense_lines_keep_their_own_points(points, stride):
    line = np.random.default_rng(0).uniform(-30, 30, (points, 3))
    assert len(dense(line)) == 201
    np.testing.assert_allclose(dense(line)[::stride], line, atol=1e-12)


def test_a_line_whose_points_do_not_fit_in_is_resampled():
    line = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 2], [9, 0, 2]])
    np.testing.assert_allclose(dense(line)[[0, 100, 200], 0], [0, 4.5, 9])


def test_data_that_cannot_be_written_are_refused(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    with pytest.raises(UserError, match="is not empty"):
        export_openlane_v2({"train": DriveDataset()}, tmp_path / "full", progress=False)
    out = tmp_path / "out"
    with pytest.raises(UserError, match="no examples"):
        export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=0))}, out, progress=False)
    with pytest.raises(UserError, match="has no cameras"):
        export_openlane_v2({"train": FakeDataset(FakeConfig(1))}, out, progress=False)
    with pytest.raises(UserError, match="has 3 cameras"):
        export_openlane_v2({"train": DriveDataset(DriveConfig(cameras=3))}, out, progress=False)
    both = {"train": DriveDataset(), "val": DriveDataset(DriveConfig(cameras=7))}
    with pytest.raises(UserError, match="has 7 cameras"):  # half-way
        export_openlane_v2(both, out, progress=False)
    assert {path.name for path in tmp_path.iterdir()} == {"full"}

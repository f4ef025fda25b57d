"""Scenes of nuScenes as logs and examples, by hand-made values: tracks, traffic flow, frames, cameras."""

import json
import pickle
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.datasets.nuscenes_small import (
    DRIVEN,
    NORTH,
    PITCH,
    START,
    K,
    empty_city,
    other_city,
    tables,
    write_nuscenes,
)
from tflane_jax.cli import main
from tflane_jax.config import RunConfig, SceneFileData
from tflane_jax.config_io import from_json, to_json
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import nuscenes_log
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.batches import batches
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesData, NuScenesDataset
from tflane_jax.datasets.nuscenes_log import road_user, scene_frames, scene_tracks
from tflane_jax.datasets.nuscenes_tables import read_tables
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.sources import load, named_source
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.datasets.view_images import ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, project
from tflane_jax.scene import AreaType, LineClass, RoadUser
from tflane_jax.world.cameras.ring import CameraRigConfig

pytest.importorskip("shapely")
SIZES = ExampleConfig(lanes=6, segments=6, areas=6, tracks=4, elements=2)


@pytest.fixture
def root(tmp_path):
    return write_nuscenes(tmp_path)


def opened(root, **settings):
    return NuScenesDataset(NuScenesConfig(root, example=SIZES, **settings))


def small_tracks(root, name="scene-0061", frame="ego", **settings):
    found = read_tables(root / "v1.0-mini")
    return scene_tracks(found, scene_frames(found, found.scenes()[name], frame), **settings)


def test_boxes_of_an_instance_are_a_track(root):
    """In the frame of their own moment: the car keeps its place ahead, and its gap stays a gap."""
    tracks = small_tracks(root)
    assert tracks.uuid.tolist() == ["bus", "car", "walker"]  # without the cone
    assert tracks.category.tolist() == [RoadUser.BUS, RoadUser.CAR, RoadUser.PEDESTRIAN]
    assert tracks.valid.T.tolist() == [[0, 0, 1, 0], [1, 1, 0, 1], [0, 1, 0, 0]]
    np.testing.assert_allclose(tracks.position[[0, 1, 3], 1], [[10, 3, 1]] * 3, atol=1e-9)
    np.testing.assert_allclose(tracks.position[1, 2], [0, -2, 1], atol=1e-9)
    np.testing.assert_allclose(tracks.position[2, 0], [20, 0, 1.5], atol=1e-9)
    np.testing.assert_allclose(tracks.yaw[[0, 1, 3], 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(tracks.yaw[1, 2], -np.pi / 2)
    # The table has width, length, height.
    np.testing.assert_array_equal(tracks.size, [[12.0, 3.0, 3.5], [4.5, 2.0, 1.6], [0.7, 0.6, 1.8]])
    # Only the walker has no points; "" is no level of visibility.
    assert tracks.occluded.T.tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0]]
    assert small_tracks(root, least_visibility="v40-60").occluded[:, 0].tolist() == [0, 0, 1, 0]


def test_categories_by_the_longest_name_and_by_choice(root):
    assert road_user("vehicle.bus.bendy", "x") == RoadUser.BUS
    assert road_user("human.pedestrian.construction_worker", "x") == RoadUser.PEDESTRIAN
    assert road_user("movable_object.barrier", "x") is None
    assert road_user("vehicle.bus.bendy", "x", {"vehicle": None, "vehicle.bus": RoadUser.TRUCK}) == RoadUser.TRUCK
    cones = {"vehicle": None, "human": None, "movable_object": RoadUser.CAR}
    assert small_tracks(root, categories=cones).uuid.tolist() == ["cone"]
    nothing = small_tracks(root, categories=cones | {"movable_object": None})
    assert nothing.valid.shape == (4, 0)


def test_poses_are_level_and_boxes_keep_their_height(root):
    """The box is 20 m ahead, 1 m left, 0.5 m above the ground of a vehicle that is pitched by 2 degrees."""
    found = read_tables(root / "v1.0-mini")
    frames = scene_frames(found, found.scenes()["scene-0103"])
    np.testing.assert_allclose(frames.global_from_frame[:, 2], [[0, 0, 1, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(frames.global_from_frame[:, :2, 3], [[50, 60]] * 2)
    assert frames.global_from_ego[0, 0, 2] == pytest.approx(np.sin(PITCH))
    tracks = scene_tracks(found, frames)
    np.testing.assert_allclose(tracks.position[1, 0], [20.0, 1.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(tracks.yaw[1, 0], 0.0, atol=1e-9)


def test_maptrs_frame_is_at_the_lidar(root):
    """MapTR's (x right, y forward) is (-y, x) here: a point 9.06 m ahead and 3 m to the left of the lidar."""
    found = read_tables(root / "v1.0-mini")
    frames = scene_frames(found, found.scenes()["scene-0061"], "lidar")
    np.testing.assert_allclose(frames.global_from_frame[0] @ [0, 0, 0, 1], [400.0, 1100.94, 0, 1])
    np.testing.assert_allclose(frames.global_from_frame[0] @ [1, 0, 0, 0], [0, 1, 0, 0], atol=1e-12)
    tracks = small_tracks(root, frame="lidar")
    np.testing.assert_allclose(tracks.position[0, 1], [9.06, 3.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(tracks.yaw[1, 2], -np.pi / 2, atol=1e-9)


def test_traffic_flow_is_the_history_at_2_hz(root):
    """At sample 3 the vehicle is 15 m further than at sample 0, where the car was 10 m ahead."""
    dataset = opened(root)
    assert [len(opened(root, split=split)) for split in ("train", "val")] == [4, 2]
    assert dataset.log("scene-0061").rate_hz == pytest.approx(2.0)
    example = dataset.example(3)
    example.validate()
    flow = example.traffic_flow
    car = int(np.flatnonzero(flow.category[: flow.valid.any(-1).sum()] == RoadUser.CAR)[0])
    assert flow.valid.shape == (4, 20)
    assert flow.valid[car].tolist() == [False] * 17 + [True, True, False]
    np.testing.assert_allclose(flow.position[car, 17:19], [[-5, 3, 1], [0, 3, 1]], atol=1e-5)
    walker = int(np.flatnonzero(flow.category == RoadUser.PEDESTRIAN)[0])
    assert flow.occluded[walker].tolist() == [False] * 18 + [True, False]
    assert not dataset.example(0).traffic_flow.valid.any()  # nothing before the first sample
    for rate in (2.0, 1.0):
        config = NuScenesConfig(root, example=replace(SIZES, history_hz=rate))
        assert NuScenesDataset(config).example(3).traffic_flow.valid.any()


def test_ground_truth_is_in_the_vehicles_frame(root):
    example = opened(root).example(1)
    lanes, areas = example.lanes, example.areas
    # Lane and connector are one centerline (one successor, one predecessor); y = 1105 is x = 0 here.
    (line,) = lanes.points[lanes.valid]
    np.testing.assert_allclose(line[0], [-15, 0, 0], atol=1e-4)
    np.testing.assert_allclose(line[-1], [35, 14, 0], atol=2e-3)
    assert example.segments.valid.sum() == 2
    assert example.segments.successor.sum() == 1
    np.testing.assert_allclose(np.abs(example.segments.left[0, :, 1] - 1.75), 0.0, atol=1e-4)
    kinds = areas.category[areas.valid].tolist()
    assert (kinds.count(AreaType.PEDESTRIAN_CROSSING), kinds.count(AreaType.ROAD_BOUNDARY)) == (1, 2)
    zebra = areas.points[areas.valid][kinds.index(AreaType.PEDESTRIAN_CROSSING)]
    np.testing.assert_allclose([zebra[:, 0].min(), zebra[:, 0].max()], [21, 24], atol=1e-4)
    np.testing.assert_allclose([zebra[:, 1].min(), zebra[:, 1].max()], [-6, 2], atol=1e-4)
    assert example.has_previous
    np.testing.assert_allclose(example.previous_from_ego[:3, 3], [5, 0, 0], atol=1e-5)


def test_examples_do_not_depend_on_copies_of_the_dataset(root):
    dataset = opened(root)
    copy = pickle.loads(pickle.dumps(dataset))
    np.testing.assert_array_equal(copy.example(2).bev, dataset.example(2).bev)
    with pytest.raises(IndexError, match="has 4 examples, no number 4"):
        dataset.example(4)
    info = dataset.info(2)
    assert (info.source, info.scene, info.timestamp_ns) == ("nuscenes", "scene-0061", START * 1000 + 10**9)
    np.testing.assert_allclose(info.global_from_ego[:3, 3], [400, 1110, 0])


def write_images(root, size=(64, 36)):
    cv2 = pytest.importorskip("cv2")
    for row in tables()["sample_data"]:
        if row["filename"].startswith("samples/CAM") and row["is_key_frame"]:
            path = root / row["filename"]
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), np.full((size[1], size[0], 3), (10, 20, 30), np.uint8))


@pytest.mark.parametrize(("frame", "ahead"), [("ego", 10.0), ("lidar", 9.06)])
def test_cameras_go_by_their_own_ego_pose(root, frame, ahead):
    """A point 10 m ahead of the rear axle: 10 - 1.5 - 0.4 m before the camera, which has driven on meanwhile."""
    write_images(root)
    example = opened(root, image=ImageConfig(scale=0.5, divisor=32), frame=frame).example(1)
    example.validate()
    views = example.cameras
    assert views.valid.tolist() == [True] + [False] * 5  # only the front camera exists
    assert views.image.shape == (6, 32, 32, 3)
    assert views.size[0].tolist() == [32, 18]
    np.testing.assert_allclose(views.image[0, :18], np.broadcast_to([30, 20, 10], (18, 32, 3)), atol=3)
    np.testing.assert_allclose(views.intrinsics[0, :2], np.array(K)[:2] / 2)
    pixels, depth, _ = project(np.array([[ahead, 1.0, 1.5]]), views.intrinsics[0], views.camera_from_ego[0])
    np.testing.assert_allclose(depth, 10 - 1.5 - DRIVEN, atol=1e-5)
    np.testing.assert_allclose(pixels[0], [400 - 500 / depth[0], 225.0], rtol=1e-5)
    # The same point in the lidar's axes and in the vehicle's own frame, whatever the frame of the example is.
    point = [ahead, 1.0, 1.5, 1.0]
    np.testing.assert_allclose(views.vehicle.lidar_from_ego @ point, [-1.0, 9.06, 1.5 - 1.84, 1.0], atol=1e-5)
    np.testing.assert_allclose(views.vehicle.vehicle_from_ego @ point, [10.0, 1.0, 1.5, 1.0], atol=1e-5)
    assert views.vehicle.can_bus is None


def test_published_weights_read_the_can_bus_and_cameras_as_calibrated(root):
    write_images(root)
    messages = [{"utime": START + 500_000, "accel": [0, 0, 9], "rotation_rate": [0, 0, 0.1], "vel": [5, 0, 0]}]
    (root / "can_bus").mkdir()
    (root / "can_bus" / "scene-0061_pose.json").write_text(json.dumps(messages))
    settings = {"image": ImageConfig(scale=0.5), "camera_poses": "calibration", "can_bus": "reference"}
    views = opened(root, **settings).example(1).cameras
    depth = project(np.array([[10.0, 1.0, 1.5]]), views.intrinsics[0], views.camera_from_ego[0])[1]
    np.testing.assert_allclose(depth, 10 - 1.5, atol=1e-5)  # without what was driven
    np.testing.assert_allclose(views.vehicle.can_bus[:7], [400, 1105, 0, *[NORTH[0]] * 4], atol=1e-5)
    np.testing.assert_allclose(views.vehicle.can_bus[7:], [0, 0, 9, 0, 0, 0.1, 5, 0, 0, np.pi / 2, 90], atol=1e-5)
    (root / "can_bus" / "scene-0061_pose.json").unlink()
    with pytest.raises(UserError, match=r"scene-0061_pose\.json"):
        opened(root, **settings).example(1)


def test_missing_and_strange_images_are_named(root):
    pytest.importorskip("cv2")
    small = ImageConfig(scale=0.5)
    with pytest.raises(UserError, match=r"cannot read .*samples/CAM_FRONT/a1\.jpg"):
        opened(root, image=small).example(1)
    write_images(root, size=(32, 36))
    with pytest.raises(UserError, match=r"a1\.jpg is 32 x 36 pixels, the first image of CAM_FRONT is 64 x 36"):
        opened(root, image=small).example(1)
    content = tables()
    content["sample_data"][4]["width"] = 32
    with pytest.raises(UserError, match="images of CAM_FRONT are 32 x 36 pixels here and 64 x 36 before"):
        opened(write_nuscenes(root, content), image=small).example(1)
    for row in content["sample_data"]:
        row |= {"width": 10**6, "height": 10**6}
    with pytest.raises(UserError, match=r"images of CAM_FRONT are 1000000 x 1000000 pixels, expected 1 to 20000"):
        opened(write_nuscenes(root, content), image=small).example(1)
    content = tables()
    content["calibrated_sensor"][1]["camera_intrinsic"] = []
    with pytest.raises(UserError, match=r"row calibrated-CAM_FRONT: camera_intrinsic has shape \(0,"):
        opened(write_nuscenes(root, content), image=small).example(1)
    content["calibrated_sensor"][1]["camera_intrinsic"] = [[1e300, 0, 32], [0, 1e300, 18], [0, 0, 1]]
    with pytest.raises(UserError, match=r"row calibrated-CAM_FRONT: camera_intrinsic holds 1e\+300"):
        opened(write_nuscenes(root, content), image=small).example(1)
    content["calibrated_sensor"][1] |= {"camera_intrinsic": K, "translation": [1.0, 1e300, 0.0]}
    with pytest.raises(UserError, match=r"row calibrated-CAM_FRONT: translation holds 1e\+300"):
        opened(write_nuscenes(root, content), image=small).example(1)
    content = tables()
    for row in content["sample_data"]:
        row["filename"] = "/etc/secret.jpg"
    with pytest.raises(UserError, match=r"filename: '/etc/secret.jpg' is not within the folder"):
        opened(write_nuscenes(root, content), image=small).example(0)
    with pytest.raises(UserError, match=r"nuScenes has real cameras: set example\.cameras=None"):
        NuScenesDataset(NuScenesConfig(root, example=replace(SIZES, cameras=CameraRigConfig())))


def test_false_places_are_errors(root, monkeypatch):
    """Else examples would hold no lane, or images of another place, and no one would know."""
    write_nuscenes(root, maps={"singapore-onenorth": other_city()})
    with pytest.raises(UserError, match="scene-0061 on the map of singapore-onenorth: the vehicle never comes within"):
        opened(root).example(0)
    write_nuscenes(root, maps={"singapore-onenorth": empty_city()})
    with pytest.raises(UserError, match="the map is empty or of another place"):
        opened(root).example(0)
    monkeypatch.setattr(nuscenes_log, "MISPLACED", {"scene-0061"})
    assert not opened(root).example(0).lanes.valid.any()
    content = tables()
    content["ego_pose"][4]["translation"] = [400.0, 1130.0, 0.0]
    dataset = opened(write_nuscenes(root, content), image=ImageConfig())
    with pytest.raises(UserError, match="row data-a1-CAM_FRONT-40000: its ego_pose is 25 m from that of the lidar"):
        dataset.example(1)


def test_splits_of_a_run(root):
    data = NuScenesData(root, example=SIZES)
    assert [data.source(split).split for split in ("train", "val", "test")] == ["train", "val", "val"]
    assert data.source("train") == NuScenesConfig(root, "train", example=SIZES)
    assert [named_source("nuscenes").title(data.source(split)) for split in ("train", "val")] == [
        "nuscenes-train",
        "nuscenes-val",
    ]
    stacked = load(data.source("train"), progress=False)
    assert stacked.lanes.points.shape == (4, 6, 11, 3)
    with pytest.raises(UserError, match="split test has no scene"):
        opened(root, split="test")
    file = root / "splits.json"
    file.write_text(json.dumps({"test": ["scene-0061", "scene-0103"]}))
    assert len(opened(root, split="test", splits=file)) == 6


def test_frames_from_disk_are_those_in_memory(root):
    kept, read = (
        load(NuScenesConfig(root, example=SIZES, loading=StreamingConfig(where=where, threads=2)), progress=False)
        for where in ("memory", "disk")
    )
    assert isinstance(read, Streamed)
    for one, other in zip(*(batches(data, (1,), range(3), 3) for data in (kept, read)), strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_configuration_is_saved_and_changed(root):
    config = RunConfig(data=NuScenesData(root, frame="lidar", splits=root / "s.json", augmentation=PhotometricConfig()))
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    changed = apply_overrides(config, ["--data.least-visibility", "v40-60", "--data.version", "v1.0-mini"])
    assert (changed.data.least_visibility, changed.data.source("val").version) == ("v40-60", "v1.0-mini")
    scenes = RunConfig(data=SceneFileData(root, ("a", "b"), ("c",), ("c",)))
    assert from_json(RunConfig, json.loads(json.dumps(to_json(scenes)))) == scenes


def test_check_counts_and_lists_every_fault(root, capsys):
    write_images(root)
    assert main(["data", "check", "--format", "nuscenes", str(root)]) == 0
    text = capsys.readouterr().out
    assert "nuScenes, v1.0-mini" in text
    assert "| singapore-onenorth |      1 |          4 |          3 |     5 |              0 |     2 |" in text
    (root / "maps" / "expansion" / "boston-seaport.json").unlink()
    (root / "samples" / "CAM_FRONT" / "a2.jpg").unlink()
    content = tables()
    content["sample"][5]["timestamp"] = START
    write_nuscenes(root, content, maps={})
    assert main(["data", "check", "--format", "nuscenes", str(root)]) == 2
    text = capsys.readouterr().out
    assert "3 faults" in text
    assert "boston-seaport.json is missing" in text
    assert "scene-0061 lacks 1 image (first samples/CAM_FRONT/a2.jpg)" in text
    assert "row sample-b1: its timestamp is not later" in text


def test_lines_are_cut_by_maptrs_rules(root):
    """In the patch around the lidar at sample 1, (400, 1105.94) northward: 60 m along the road, 30 m across."""
    patch = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))
    example = replace(SIZES, range=patch, map_lines=MapLinesConfig(lines=10, centerlines="include"))
    lines = NuScenesDataset(NuScenesConfig(root, frame="lidar", example=example)).example(1).map_lines
    found = {kind: lines.points[lines.valid & (lines.category == kind)][..., :2] for kind in LineClass}
    assert {kind.name: len(one) for kind, one in found.items()} == {
        "DIVIDER": 2,
        "CROSSING": 1,
        "BOUNDARY": 1,
        "CENTERLINE": 1,
    }
    start, end = 1090 - 1105.94, 1130 - 1105.94
    # Every record is a divider of its own, whatever the sides of lanes are.
    dividers = found[LineClass.DIVIDER]
    np.testing.assert_allclose(sorted(dividers[:, 0, 1]), [-5.25, -1.75], atol=1e-3)
    np.testing.assert_allclose(dividers[:, [0, -1], 0], [[start, end]] * 2, atol=1e-3)
    (crossing,) = found[LineClass.CROSSING]
    np.testing.assert_array_equal(crossing[0], crossing[-1])
    np.testing.assert_allclose(np.ptp(crossing, axis=0), [3.0, 8.0], atol=0.6)
    # The road ahead leaves the patch: its border is cut 0.2 m inside, and the patch's own border is no boundary. From
    # left to right: 13.05 m beside the road segment's near edge, around two lanes of 7 m by 40 m, 9.55 m.
    (boundary,) = found[LineClass.BOUNDARY]
    ends = boundary[[0, -1]][np.argsort(-boundary[[0, -1], 1])]
    np.testing.assert_allclose(ends, [[end, 14.8], [end, -14.8]], atol=1e-3)
    length = np.linalg.norm(np.diff(boundary, axis=0), axis=-1).sum()
    assert length == pytest.approx(13.05 + 40 + 7 + 40 + 9.55, abs=6.0)  # 20 points cut the corners
    # One path through the lane graph: the lane and its connector, on the circle of 10 m around (390, 1130), up to the
    # patch's border 5.94 m north of its center.
    (path,) = found[LineClass.CENTERLINE]
    np.testing.assert_allclose(path[0], [start, 0.0], atol=1e-3)
    np.testing.assert_allclose(path[-1], [30.0, 10 - np.sqrt(100 - 5.94**2)], atol=2e-2)

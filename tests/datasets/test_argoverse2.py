"""The Argoverse 2 reader on a hand-made log and on damaged logs."""

import json
import pickle
import shutil

import numpy as np
import pytest

from tflane_jax.datasets.argoverse2 import Argoverse2Config, Argoverse2Dataset
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, POSES, check_log, find_logs, load_log
from tflane_jax.datasets.argoverse2_map import line_type
from tflane_jax.errors import UserError
from tflane_jax.scene import LineType, RoadUser

pa = pytest.importorskip("pyarrow")
feather = pytest.importorskip("pyarrow.feather")

FRAMES = 6
POSE = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx_m": 0.0, "ty_m": 0.0, "tz_m": 0.0}


def write(path, rows, columns=None):
    columns = columns or list(rows[0])
    feather.write_feather(pa.table({c: [row[c] for row in rows] for c in columns}), str(path))


def box(frame, uuid, category, x, *, points=9):
    return {
        "timestamp_ns": 1000 + 100 * frame,
        "track_uuid": uuid,
        "category": category,
        "length_m": 4.0,
        "width_m": 2.0,
        "height_m": 1.5,
        **POSE,
        "tx_m": x,
        "qw": 0.0,
        "qz": 1.0,
        "num_interior_pts": points,
    }


def points(*xy):
    return [{"x": float(x), "y": float(y), "z": 0.5} for x, y in xy]


LANE = {
    "id": 5,
    "is_intersection": False,
    "lane_type": "BIKE",
    "left_lane_boundary": points((0, 2), (40, 2)),
    "left_lane_mark_type": "DASHED_WHITE",
    "right_lane_boundary": points((0, -2), (20, -2), (40, -2)),
    "right_lane_mark_type": "NONE",
    "successors": [6],
    "predecessors": [],
    "left_neighbor_id": None,
    "right_neighbor_id": None,
}
MAP = {
    "lane_segments": {"5": LANE},
    "pedestrian_crossings": {"1": {"id": 1, "edge1": points((0, 0), (0, 5)), "edge2": points((3, 0), (3, 5))}},
    "drivable_areas": {
        "1": {"id": 1, "area_boundary": points((0, -9), (20, -9), (20, 9), (0, 9))},
        "2": {"id": 2, "area_boundary": points((20, -9), (40, -9), (40, 9), (20, 9))},
    },
}


@pytest.fixture
def folder(tmp_path):
    """Write a log of six frames: a car throughout, a walker in frame 1, a bollard."""
    folder = tmp_path / "sensor" / "val" / "log-a"
    (folder / "map").mkdir(parents=True)
    boxes = [box(f, "car", "REGULAR_VEHICLE", 10.0 + f, points=f) for f in range(FRAMES)]
    boxes += [box(1, "walker", "PEDESTRIAN", 3.0), box(2, "post", "BOLLARD", 4.0)]
    write(folder / ANNOTATIONS, boxes)
    poses = [{"timestamp_ns": t, **POSE, "tx_m": t / 100} for t in (990, *range(1000, 1600, 100), 1590)]
    write(folder / POSES, poses)
    (folder / "map" / "log_map_archive_log-a____PIT_city_1.json").write_text(json.dumps(MAP))
    return folder


def test_reads_tracks_poses_and_map(folder):
    log = load_log(folder)
    assert (log.name, log.source, log.tracks.frames) == ("log-a", "argoverse2", FRAMES)
    assert log.tracks.uuid.tolist() == ["car", "walker"]
    assert log.tracks.category.tolist() == [RoadUser.CAR, RoadUser.PEDESTRIAN]
    assert log.tracks.valid.T.tolist() == [[True] * FRAMES, [False, True, *[False] * 4]]
    assert log.tracks.position[:, 0, 0].tolist() == [10, 11, 12, 13, 14, 15]
    assert log.tracks.occluded.T.tolist() == [[True, *[False] * 5], [False] * 6]
    np.testing.assert_allclose(np.abs(log.tracks.yaw[0, 0]), np.pi)
    assert log.global_from_ego[:, 0, 3].tolist() == [10, 11, 12, 13, 14, 15]
    assert [k.track_frame for k in log.keyframes] == [0, 5]
    assert len(load_log(folder, keyframes="annotations").keyframes) == FRAMES
    (lane,) = log.map.segments.values()
    assert (lane.left_type, lane.right_type, lane.vehicle) == (LineType.DASHED, LineType.NONE, False)
    assert lane.successors == (6,)
    np.testing.assert_allclose(lane.centerline, np.column_stack([np.linspace(0, 40, 10), [0] * 10, [0.5] * 10]))
    np.testing.assert_array_equal(log.map.crossings[0][:, :2], [(0, 0), (0, 5), (3, 5), (3, 0), (0, 0)])
    # Two areas that share an edge are one road.
    (boundary,) = log.map.road_boundaries
    np.testing.assert_array_equal(boundary[0], boundary[-1])
    assert np.linalg.norm(np.diff(boundary[:, :2], axis=0), axis=-1).sum() == pytest.approx(2 * (40 + 18))
    assert set(boundary[:, 2]) == {0.5}


def test_openlane_timestamps_take_their_own_pose_and_the_nearest_boxes(folder, tmp_path):
    openlane = tmp_path / "openlane"
    (openlane / "OpenLane-V2").mkdir(parents=True)
    frames = {"train": {}, "val": {"10003": ["1590.json", "990.json"], "10004": ["7.json"]}}
    (openlane / "OpenLane-V2" / "data_dict_subset_A.json").write_text(json.dumps(frames))
    logs = openlane / "subset_A_segment_to_av2_log.json"
    logs.write_text(json.dumps({"val": {"10003": "log-a", "10004": "log-b"}}))
    moments = load_log(folder, openlane=openlane).keyframes
    assert [(k.timestamp_ns, k.track_frame) for k in moments] == [(990, 0), (1590, 5)]
    assert [k.global_from_ego[0, 3] for k in moments] == [9.9, 15.9]
    # A log that the split files do not hold falls back to every fifth annotated frame.
    other = folder.with_name("log-c")
    shutil.copytree(folder, other)
    assert [k.timestamp_ns for k in load_log(other, openlane=openlane).keyframes] == [1000, 1500]
    with pytest.raises(UserError, match="split files"):
        load_log(folder, openlane=tmp_path)


def test_dataset_orders_logs_by_name_and_survives_pickling(folder):
    shutil.copytree(folder, folder.with_name("another"))
    root = folder.parents[2]
    for where in (root, root / "sensor" / "val", root / "sensor"):
        assert [path.name for path in find_logs(where)] == ["another", "log-a"]
    assert find_logs(folder) == [folder]
    dataset = Argoverse2Dataset(Argoverse2Config(root))
    assert len(dataset) == 4
    assert [dataset.info(i).scene for i in range(4)] == ["another"] * 2 + ["log-a"] * 2
    assert dataset.info(3).timestamp_ns == 1500
    example = pickle.loads(pickle.dumps(dataset)).example(3)
    example.validate()
    np.testing.assert_array_equal(example.bev, dataset.example(3).bev)
    assert example.traffic_flow.valid.sum(-1)[:3].tolist() == [5, 1, 0]


def test_a_log_of_one_frame_or_of_furniture_only_is_an_empty_flow(folder):
    for rows in ([box(0, "car", "REGULAR_VEHICLE", 9.0)], [box(0, "post", "BOLLARD", 9.0)]):
        write(folder / ANNOTATIONS, rows)
        dataset = Argoverse2Dataset(Argoverse2Config(folder))
        assert len(dataset) == 1
        assert not dataset.example(0).traffic_flow.valid.any()


def missing_map(folder):
    shutil.rmtree(folder / "map")


def broken_map(folder):
    next((folder / "map").iterdir()).write_text('{"lane_segments": {')


def other_map(folder):
    next((folder / "map").iterdir()).write_text('{"lanes": {}}')


def cut_annotations(folder):
    content = (folder / ANNOTATIONS).read_bytes()
    (folder / ANNOTATIONS).write_bytes(content[: len(content) // 2])


def wrong_columns(folder):
    write(folder / ANNOTATIONS, [box(0, "car", "REGULAR_VEHICLE", 1.0)], columns=["timestamp_ns", "category"])


def no_boxes(folder):
    empty = feather.read_table(folder / ANNOTATIONS).slice(0, 0)
    feather.write_feather(empty, str(folder / ANNOTATIONS))


def strange_category(folder):
    write(folder / ANNOTATIONS, [box(0, "x", "HOVERCRAFT", 1.0)])


def other_poses(folder):
    write(folder / POSES, [{"timestamp_ns": 1, **POSE}])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / ANNOTATIONS).unlink(), r"annotations\.feather is missing: download"),
        (lambda f: (f / POSES).unlink(), r"city_SE3_egovehicle\.feather is missing: download"),
        (missing_map, r"map holds no log_map_archive"),
        (broken_map, "not valid json"),
        (other_map, "not an Argoverse 2 vector map"),
        (cut_annotations, "not a readable feather file"),
        (wrong_columns, "lacks the column"),
        (no_boxes, "holds no annotated frame"),
        (strange_category, "HOVERCRAFT"),
        (other_poses, "has no pose at 6 of 6 frames"),
    ],
)
def test_damage_is_named_with_its_remedy(folder, damage, message):
    assert check_log(folder) == []
    damage(folder)
    with pytest.raises(UserError, match=message):
        load_log(folder)
    (lacking,) = check_log(folder)
    assert message.replace("\\", "") in lacking
    assert str(folder) in lacking


def test_check_names_everything_that_is_missing(tmp_path):
    assert len(check_log(tmp_path)) == 3
    assert "is no folder" in check_log(tmp_path / "nowhere")[0]
    with pytest.raises(UserError, match="holds no Argoverse 2 log"):
        find_logs(tmp_path)


@pytest.mark.parametrize(
    ("mark", "expected"),
    [
        ("NONE", 0),
        ("UNKNOWN", 0),
        ("SOLID_BLUE", 1),
        ("DOUBLE_SOLID_YELLOW", 1),
        ("DASHED_WHITE", 2),
        ("DOUBLE_DASH_WHITE", 2),
        ("SOLID_DASH_YELLOW", 1),
        ("DASH_SOLID_WHITE", 2),
    ],
)
def test_line_types(mark, expected):
    assert line_type(mark) == expected

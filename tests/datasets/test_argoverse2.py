"""The Argoverse 2 reader on a hand-made log and on damaged logs."""

import gc
import json
import pickle
import shutil
import weakref

import numpy as np
import pytest

from tests.datasets.small_argoverse2 import FRAMES, MAP, MS, POSE, box, points, write, write_log
from tflane_jax.datasets import argoverse2, log_frames
from tflane_jax.datasets.argoverse2 import Argoverse2Config, Argoverse2Dataset
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, check_log, find_logs, load_log
from tflane_jax.datasets.argoverse2_map import line_type, read_map
from tflane_jax.datasets.argoverse2_poses import POSES
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.scene import LineType, RoadUser

feather = pytest.importorskip("pyarrow.feather")
pc = pytest.importorskip("pyarrow.compute")


@pytest.fixture
def folder(tmp_path):
    return write_log(tmp_path / "sensor" / "val" / "log-a")


def test_reads_tracks_poses_and_map(folder):
    log = load_log(folder)
    assert (log.name, log.source, log.tracks.frames) == ("log-a", "argoverse2", FRAMES)
    assert log.tracks.uuid.tolist() == ["car", "walker"]
    assert log.tracks.category.tolist() == [RoadUser.CAR, RoadUser.PEDESTRIAN]
    assert log.tracks.size.tolist() == [[4.0, 2.0, 1.5]] * 2  # length, width, height
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


def test_a_crossing_reaches_from_end_to_end_of_edges_with_more_points(tmp_path):
    edges = {"edge1": points((0, 0), (0, 2), (0, 5)), "edge2": points((3, 0), (3, 5))}
    path = tmp_path / "log_map_archive_log-a____PIT_city_1.json"
    path.write_text(json.dumps(MAP | {"pedestrian_crossings": {"1": {"id": 1, **edges}}}))
    (ring,) = read_map(tmp_path).crossings
    np.testing.assert_array_equal(ring[:, :2], [(0, 0), (0, 5), (3, 5), (3, 0), (0, 0)])


def test_a_log_that_links_lead_to_twice_is_found_once_and_a_copy_is_refused(tmp_path):
    log = write_log(tmp_path / "logs" / "log-a")
    (tmp_path / "logs" / "loop").symlink_to(tmp_path / "logs")
    assert find_logs(tmp_path / "logs") == [log]
    shutil.copytree(log, tmp_path / "logs" / "copies" / "log-a")
    with pytest.raises(UserError, match=r"holds the log log-a twice: take out .*/log-a or .*/log-a"):
        find_logs(tmp_path / "logs")


def test_maps_of_two_logs_in_one_folder_are_refused(folder):
    other = folder / "map" / "log_map_archive_log-b____MIA_city_1.json"
    other.write_text(json.dumps(MAP))
    with pytest.raises(UserError, match=r"holds two maps, log_map_archive_log-a.* and log_map_archive_log-b"):
        load_log(folder)
    assert len(check_log(folder)) >= 1


def test_openlane_timestamps_take_their_own_pose_and_the_nearest_boxes(folder, tmp_path):
    openlane = tmp_path / "openlane"
    (openlane / "OpenLane-V2").mkdir(parents=True)
    frames = {"train": {}, "val": {"10003": [f"{1590 * MS}.json", f"{990 * MS}.json"], "10004": ["7.json"]}}
    (openlane / "OpenLane-V2" / "data_dict_subset_A.json").write_text(json.dumps(frames))
    logs = openlane / "subset_A_segment_to_av2_log.json"
    logs.write_text(json.dumps({"val": {"10003": "log-a", "10004": "log-b"}}))
    moments = load_log(folder, openlane=openlane).keyframes
    assert [(k.timestamp_ns, k.track_frame) for k in moments] == [(990 * MS, 0), (1590 * MS, 5)]
    assert [k.global_from_ego[0, 3] for k in moments] == [9.9, 15.9]
    # A log that the split files do not hold falls back to every fifth annotated frame.
    other = folder.with_name("log-c")
    shutil.copytree(folder, other)
    assert [k.timestamp_ns for k in load_log(other, openlane=openlane).keyframes] == [1000 * MS, 1500 * MS]
    with pytest.raises(UserError, match="OpenLane-V2's list of frames"):
        load_log(folder, openlane=tmp_path)
    # The folder of the list itself will do; the logs of its segments are no part of the download.
    with pytest.raises(UserError, match=r"OpenLane-V2.subset_A_segment_to_av2_log\.json is missing.*not part of"):
        load_log(folder, openlane=openlane / "OpenLane-V2")
    logs.rename(openlane / "OpenLane-V2" / logs.name)
    found = load_log(folder, openlane=openlane / "OpenLane-V2").keyframes
    assert [k.timestamp_ns for k in found] == [k.timestamp_ns for k in moments]


def test_key_frames_of_openlane_beyond_the_annotations_are_left_out(folder, tmp_path):
    """Regression: they took the tracks and boxes of the last annotated frame, seconds away."""

    def openlane(name, *times):
        (made := tmp_path / name).mkdir()
        frames = {"train": {}, "val": {"10003": [f"{time * MS}.json" for time in times]}}
        (made / "data_dict_subset_A.json").write_text(json.dumps(frames))
        (made / "subset_A_segment_to_av2_log.json").write_text(json.dumps({"val": {"10003": "log-a"}}))
        return made

    table = feather.read_table(folder / ANNOTATIONS)
    feather.write_feather(table.filter(pc.less(table["timestamp_ns"], 1300 * MS)), folder / ANNOTATIONS)
    some, none = openlane("some", 1000, 1590, 1990), openlane("none", 1590, 1990)
    with pytest.warns(LeftOutWarning, match=r"feather: 2 of 3 key frames have no annotated frame within 0.1 s"):
        kept = load_log(folder, openlane=some).keyframes
    assert [key.timestamp_ns for key in kept] == [1000 * MS]
    with pytest.raises(UserError, match="no key frame of OpenLane-V2 has an annotated frame within"):
        load_log(folder, openlane=none)


def test_a_key_frame_without_a_box_takes_the_time_of_a_pose(folder):
    """Regression: its time was made from those of its neighbours, at which a real log has no pose."""

    def time(frame):  # as of a lidar, not quite even
        return (1000 + 100 * frame + frame % 3) * MS

    boxes = [box(frame, "car", "REGULAR_VEHICLE", 10.0) for frame in range(11) if frame not in (5, 6)]
    write(folder / ANNOTATIONS, [row | {"timestamp_ns": time(row["timestamp_ns"] // MS // 100 - 10)} for row in boxes])
    write(folder / POSES, [{"timestamp_ns": time(frame), **POSE, "tx_m": frame} for frame in range(11)])
    log = load_log(folder)
    assert log.timestamps_ns.tolist() == [time(frame) for frame in range(11)]
    assert [(k.timestamp_ns, k.track_frame) for k in log.keyframes] == [(time(f), f) for f in (0, 5, 10)]


def test_frames_without_a_box_are_frames_of_the_history(folder):
    """The file has no rows of them: frames 2 and 3 of six."""
    write(folder / ANNOTATIONS, [box(frame, "car", "REGULAR_VEHICLE", 10.0) for frame in (0, 1, 4, 5)])
    log = load_log(folder)
    assert (log.timestamps_ns // MS).tolist() == [1000, 1100, 1200, 1300, 1400, 1500]
    assert log.tracks.valid[:, 0].tolist() == [True, True, False, False, True, True]
    assert log.global_from_ego[:, 0, 3].tolist() == [10, 11, 12, 13, 14, 15]
    assert [k.track_frame for k in log.keyframes] == [0, 5]
    moments = load_log(folder, keyframes="annotations").keyframes
    assert [(k.timestamp_ns // MS, k.track_frame) for k in moments] == [(1000, 0), (1100, 1), (1400, 4), (1500, 5)]
    config = Argoverse2Config(folder, example=ExampleConfig(sensor=None, history=5))
    flow = Argoverse2Dataset(config).example(1).traffic_flow
    assert flow.valid[0].tolist() == [True, True, False, False, True]
    # Boxes are 10 m ahead of a vehicle that drives a metre a frame.
    np.testing.assert_allclose(flow.position[0, flow.valid[0], 0], [5.0, 6.0, 9.0])


def test_dataset_orders_logs_by_name_and_survives_pickling(folder):
    shutil.copytree(folder, folder.with_name("another"))
    root = folder.parents[2]
    for where in (root, root / "sensor" / "val", root / "sensor"):
        assert [path.name for path in find_logs(where)] == ["another", "log-a"]
    assert find_logs(folder) == [folder]
    dataset = Argoverse2Dataset(Argoverse2Config(root))
    assert len(dataset) == 4
    assert [dataset.info(i).scene for i in range(4)] == ["another"] * 2 + ["log-a"] * 2
    assert dataset.info(3).timestamp_ns == 1500 * MS
    example = pickle.loads(pickle.dumps(dataset)).example(3)
    example.validate()
    np.testing.assert_array_equal(example.bev, dataset.example(3).bev)
    assert example.traffic_flow.valid.sum(-1)[:3].tolist() == [5, 1, 0]


def test_logs_are_read_when_they_are_needed_and_few_are_kept(folder, monkeypatch):
    shutil.copytree(folder, folder.with_name("log-b"))
    read = []

    def counted(path, **options):
        made = load_log(path, **options)
        read.append(weakref.ref(made))
        return made

    monkeypatch.setattr(argoverse2, "load_log", counted)
    monkeypatch.setattr(log_frames, "KEPT_LOGS", 1)
    dataset = Argoverse2Dataset(Argoverse2Config(folder.parent))
    assert (len(dataset), dataset.info(3).scene, dataset.info(3).area, read) == (4, "log-b", "PIT", [])
    alone = load_log(folder)
    for index, moment in enumerate(alone.keyframes):
        found = dataset.info(index)
        assert found.timestamp_ns == moment.timestamp_ns
        np.testing.assert_array_equal(found.global_from_ego, moment.global_from_ego)
    for index in range(4):
        dataset.example(index)
    gc.collect()
    assert [one() is not None for one in read] == [False, True]


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
        (broken_map, "is no JSON file"),
        (other_map, "lacks the entry 'lane_segments'"),
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


def test_the_content_of_logs_is_that_of_boxes_poses_and_maps(folder):
    config = Argoverse2Config(folder.parent)
    found = [argoverse2.SOURCE.content(config)]
    for file in (folder / ANNOTATIONS, folder / POSES, *folder.glob("map/log_map_*.json")):
        file.write_bytes(file.read_bytes() + b" ")
        found.append(argoverse2.SOURCE.content(config))
    shutil.copytree(folder, folder.parent / "log-b")
    found.append(argoverse2.SOURCE.content(config))
    assert len(set(found)) == len(found) == 5

"""The Argoverse 2 reader on a hand-made log, on damaged logs, and on the two real logs against known counts."""

import functools
import json
import pickle
import shutil

import numpy as np
import pytest

from tests.shared import shared_path
from tflane_jax.datasets.argoverse2 import Argoverse2Config, Argoverse2Dataset
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, CATEGORIES, POSES, check_log, find_logs, load_log
from tflane_jax.datasets.argoverse2_map import line_type
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example, traffic_flow
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.scene import AreaType, LineType, RoadUser

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


# The two real logs. Counts: specs/data_formats.md sections 1.2, 1.3 and 3, all categories and all lane types.
FLAT = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
FORKED = "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
EVERYTHING = dict.fromkeys(CATEGORIES, RoadUser.CAR)
RANGE = PerceptionRange()


@functools.cache
def real_log(name, categories):
    return load_log(
        shared_path(f"data/argoverse2/sensor/val/{name}"),
        openlane=shared_path("data/openlanev2"),
        categories=EVERYTHING if categories == "all" else CATEGORIES,
    )


@functools.cache
def real_examples(name):
    config = ExampleConfig(tracks=160)
    return [make_example(real_log(name, "traffic"), i, config) for i in range(32)]


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "boxes", "all_tracks", "lengths", "furniture"),
    [(FLAT, 11364, 114, (121.5, 112, 104), 676 + 118), (FORKED, 12078, 146, (74, 141, 130), 1699 + 600 + 332)],
)
def test_real_tracks(name, boxes, all_tracks, lengths, furniture):
    log = real_log(name, "all")
    valid = log.tracks.valid
    assert valid.shape == (156, all_tracks)
    assert valid.sum() == boxes
    frames = valid.sum(0)
    assert (np.median(frames), (frames >= 5).sum(), (frames >= 20).sum()) == lengths
    assert real_log(name, "traffic").tracks.valid.sum() == boxes - furniture
    # Every track is one unbroken run.
    assert (np.abs(np.diff(valid.astype(int), axis=0)).sum(0) <= 2).all()
    assert 0.1 < log.tracks.occluded[valid].mean() < 0.25
    assert [k.track_frame for k in log.keyframes][:5] == [0, 5, 10, 15, 20]
    nearest = log.timestamps_ns[[k.track_frame for k in log.keyframes]]
    early = nearest - [k.timestamp_ns for k in log.keyframes]
    assert (early > 9.3e6).all()
    assert (early < 10.8e6).all()


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "means", "largest", "crowded"), [(FLAT, (30.2, 29.2, 27.4), 39, 18), (FORKED, (30.2, 29.6, 28.2), 41, 14)]
)
def test_real_histories(name, means, largest, crowded):
    counts = []
    for i in range(32):
        flow, dropped = traffic_flow(real_log(name, "all"), i, history=20, capacity=160)
        assert dropped == 0
        inside = (flow.valid & RANGE.contains(flow.position)).sum(-1)
        counts.append([(inside >= least).sum() for least in (1, 5, 10)])
    assert np.mean(counts, 0).round(1).tolist() == list(means)
    assert np.max(counts) == largest
    assert (np.array(counts)[:, 1] > 30).sum() == crowded


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "counts", "means"),
    [
        (
            FLAT,
            [[38, 21, 27], [40, 21, 27], [19, 12, 20], [21, 12, 20], [4, 4, 4], [4, 4, 7]],
            (25.2, 25.2, 14.4, 14.4),
        ),
        (
            FORKED,
            [[52, 52, 55], [53, 53, 56], [26, 26, 28], [27, 27, 29], [4, 4, 4], [4, 4, 4]],
            (53.7, 54.6, 26.9, 27.8),
        ),
    ],
)
def test_real_ground_truth(name, counts, means):
    found = [
        [
            e.segments.valid.sum(),
            e.segments.successor.sum(),
            e.lanes.valid.sum(),
            e.lanes.successor.sum(),
            (e.areas.category[e.areas.valid] == AreaType.PEDESTRIAN_CROSSING).sum(),
            (e.areas.category[e.areas.valid] == AreaType.ROAD_BOUNDARY).sum(),
        ]
        for e in real_examples(name)
    ]
    assert np.array(found)[[0, 15, 31]].T.tolist() == counts
    assert np.mean(found, 0)[:4].round(1).tolist() == list(means)


@pytest.mark.golden
@pytest.mark.parametrize("name", [FLAT, FORKED])
def test_real_truth_is_where_it_should_be(name):
    for number, example in enumerate(real_examples(name)):
        example.validate()
        for graph in (example.lanes, example.segments):
            lines = graph.points[graph.valid]
            assert RANGE.contains(lines).all()
            # Measured at every fourth frame; in others the vehicle pitches and far lanes rise or sink further.
            if number % 4 == 0:
                assert -1.55 < lines[..., 2].min() < lines[..., 2].max() < 1.15
            i, j = np.nonzero(graph.successor)
            np.testing.assert_allclose(graph.points[i, -1], graph.points[j, 0], atol=2e-3)
            # The centerline runs between its boundaries: the left one lies to the left.
            heading = lines[:, 6] - lines[:, 4]
            across = (graph.left - graph.right)[graph.valid][:, 5]
            assert (heading[:, 0] * across[:, 1] - heading[:, 1] * across[:, 0] > 0).all()
        ground = example.lanes.points[example.lanes.valid].reshape(-1, 3)
        nearest = np.linalg.norm(ground[:, :2], axis=-1).argmin()
        assert ground[nearest, 2] == pytest.approx(-0.33, abs=0.15)
        assert 0.0 < example.hidden.mean() < 0.9


@pytest.mark.golden
@pytest.mark.parametrize("name", [FLAT, FORKED])
def test_real_traffic_keeps_to_the_lanes(name):
    """Cars that move drive along a lane segment: their own poses and the map agree."""
    agree = []
    for example in real_examples(name)[4::7]:
        flow, lanes = example.traffic_flow, example.segments
        step = flow.position[:, -1, :2] - flow.position[:, -6, :2]
        fast = flow.valid[:, -1] & flow.valid[:, -6] & (flow.category == RoadUser.CAR)
        fast &= np.linalg.norm(step, axis=-1) > 2.0
        fast &= PerceptionRange((-45, 45), (-20, 20)).contains(flow.position[:, -1])
        for k in np.flatnonzero(fast):
            starts, ends = lanes.points[lanes.valid][:, :-1, :2], lanes.points[lanes.valid][:, 1:, :2]
            near = np.linalg.norm((starts + ends) / 2 - flow.position[k, -1, :2], axis=-1) < 3.5
            heading = (ends - starts)[near]
            heading /= np.linalg.norm(heading, axis=-1, keepdims=True)
            agree.append(bool(((heading @ step[k]) / np.linalg.norm(step[k]) > 0.9).any()))
    assert len(agree) > 5
    assert np.mean(agree) > 0.85

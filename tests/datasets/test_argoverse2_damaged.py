"""Damaged Argoverse 2 logs: every one is refused by name, none becomes false truth.

False truth is worse than an error: NaN quaternions used to give frames without lanes, NaN boxes valid traffic.
"""

import copy
import json

import numpy as np
import pytest

from tests.datasets.small_argoverse2 import LANE, MAP, points, write, write_log
from tflane_jax.datasets.argoverse2 import Argoverse2Config, Argoverse2Dataset
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, check_log, load_log
from tflane_jax.datasets.argoverse2_poses import POSES
from tflane_jax.errors import UserError

feather = pytest.importorskip("pyarrow.feather")

NUMBERS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
SIZES = ("length_m", "width_m", "height_m")
WRONG = {"nan": np.nan, "inf": -np.inf, "empty": None, "text": "1.0"}
STANDS = {ANNOTATIONS: {}, POSES: {"tx_m": 0.0}}
FILES = ((ANNOTATIONS, (*NUMBERS, *SIZES)), (POSES, NUMBERS))


@pytest.fixture
def folder(tmp_path):
    return write_log(tmp_path / "log")


def change(path, column, value, rows=(1,)):
    """Set a column in some rows; text makes the whole column text, as a wrong writer would."""
    table = feather.read_table(path).to_pylist()
    for i, row in enumerate(table):
        if isinstance(value, str) and column not in ("category", "track_uuid"):
            row[column] = str(row[column])
        elif i in rows:
            row[column] = value(row) if callable(value) else value
    write(path, table)


def refused(folder, said):
    """Assert that reading and checking name the fault."""
    with pytest.raises(UserError) as error:
        load_log(folder)
    for text in said:
        assert text in str(error.value), str(error.value)
    assert any(all(text in fault for text in said) for fault in check_log(folder))


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize(("file", "column"), [(file, column) for file, columns in FILES for column in columns])
def test_a_wrong_number_is_named_by_file_and_column(folder, file, column, wrong):
    change(folder / file, column, WRONG[wrong])
    row = () if wrong == "text" else ("row 1",)
    refused(folder, (file, column, *row))


@pytest.mark.parametrize("file", [ANNOTATIONS, POSES])
@pytest.mark.parametrize("wrong", ["text", "empty", "fraction"])
def test_a_wrong_time_is_named(folder, file, wrong):
    value = {"text": "1", "empty": None, "fraction": lambda row: row["timestamp_ns"] + 0.5}[wrong]
    rows = range(100) if wrong == "fraction" else (1,)
    change(folder / file, "timestamp_ns", value, rows)
    refused(folder, (file, "timestamp_ns"))


@pytest.mark.parametrize(
    ("file", "column", "value", "rows", "said"),
    [
        (ANNOTATIONS, "track_uuid", None, (2,), ("track_uuid", "row 2")),
        (ANNOTATIONS, "category", None, (2,), ("category", "row 2")),
        (ANNOTATIONS, "category", "", (2,), ("unknown category",)),
        (ANNOTATIONS, "num_interior_pts", None, (0,), ("num_interior_pts",)),
        (ANNOTATIONS, "num_interior_pts", "many", (0,), ("num_interior_pts",)),
        (ANNOTATIONS, "length_m", 0.0, (3,), ("length_m", "row 3", "extent")),
        (ANNOTATIONS, "width_m", -2.0, (3,), ("width_m", "row 3", "extent")),
        (ANNOTATIONS, "height_m", -1.0, (3,), ("height_m", "row 3", "extent")),
        (ANNOTATIONS, "qz", 0.0, (0,), ("row 0", "unit quaternion")),  # all four are zero
        (ANNOTATIONS, "qz", 3.0, (0,), ("row 0", "unit quaternion")),
        (POSES, "qw", 0.0, range(100), ("unit quaternion",)),
        (POSES, "qw", 0.5, (1,), ("row 1", "unit quaternion")),
        (POSES, "tx_m", 5000.0, (3,), ("the vehicle is 4989 m from its place",)),
        (POSES, "tx_m", lambda row: row["tx_m"] + 5000.0, range(100), ("never comes within 200 m", "another place")),
        (POSES, "ty_m", lambda row: row["ty_m"] - 900.0, range(100), ("never comes within 200 m", "another place")),
        (ANNOTATIONS, "tx_m", 7000.0, (2,), ("row 2", "7000 m from the vehicle")),
        (POSES, "timestamp_ns", lambda row: row["timestamp_ns"] + 1, range(100), ("has no pose at 6 of 6 frames",)),
        (POSES, "timestamp_ns", 1_000_000_000, (2,), ("two poses at 1000000000",)),
        (ANNOTATIONS, "timestamp_ns", 1_000_000_000, (1,), ("track car twice at 1000000000",)),
        (ANNOTATIONS, "track_uuid", "car", range(100), ("track car twice",)),  # as is the walker
        (ANNOTATIONS, "timestamp_ns", 7, (1,), ("has no pose at 1 of",)),
    ],
)
def test_values_that_cannot_be_are_named(folder, file, column, value, rows, said):
    change(folder / file, column, value, rows)
    refused(folder, said)


def lane(**changes):
    """Return a change of the map that replaces entries of its lane; None removes an entry."""

    def apply(content):
        record = content["lane_segments"]["5"]
        for name, value in changes.items():
            if value is None:
                del record[name]
            else:
                record[name] = value

    return apply


def spoiled(axis, value):
    """Return the lane's left boundary with a wrong coordinate."""
    line = copy.deepcopy(LANE["left_lane_boundary"])
    if value is None:
        del line[1][axis]
    else:
        line[1][axis] = value
    return line


def second_lane(number):
    """Add the lane again under another key, with the given id."""

    def apply(content):
        content["lane_segments"]["6"] = copy.deepcopy(LANE) | {"id": number, "successors": []}

    return apply


def entry(kind, name, value):
    def apply(content):
        content[kind]["1"][name] = value

    return apply


MAPS = {
    "no lanes": (lambda content: content["lane_segments"].clear(), ("no lane segment",)),
    "lanes are a list": (lambda content: content.update(lane_segments=[LANE]), ("no Argoverse 2 vector map",)),
    "no crossings": (lambda content: content.pop("pedestrian_crossings"), ("pedestrian_crossings",)),
    "no areas": (lambda content: content.pop("drivable_areas"), ("drivable_areas",)),
    "NaN in a lane": (lane(left_lane_boundary=spoiled("x", float("nan"))), ("lane_segments.5", "left_lane_boundary")),
    "infinite lane": (lane(left_lane_boundary=spoiled("y", float("inf"))), ("left_lane_boundary", "finite")),
    "lane around the Earth": (lane(left_lane_boundary=spoiled("x", 4e7)), ("left_lane_boundary", "km apart")),
    "missing coordinate": (lane(left_lane_boundary=spoiled("z", None)), ("left_lane_boundary[1]", "'z'")),
    "text coordinate": (lane(left_lane_boundary=spoiled("x", "12.0")), ("left_lane_boundary", "text")),
    "null coordinate": (lane(left_lane_boundary=[{"x": None, "y": 0.0, "z": 0.0}] * 2), ("left_lane_boundary",)),
    "one point": (lane(right_lane_boundary=points((0, 0))), ("right_lane_boundary", "1 points")),
    "no point": (lane(right_lane_boundary=[]), ("right_lane_boundary", "0 points")),
    "boundary is text": (lane(right_lane_boundary="line"), ("right_lane_boundary",)),
    "no boundary": (lane(right_lane_boundary=None), ("right_lane_boundary",)),
    "sides swapped": (
        lane(left_lane_boundary=LANE["right_lane_boundary"], right_lane_boundary=LANE["left_lane_boundary"]),
        ("lane_segments.5", "to the right of the right one"),
    ),
    "same ids": (second_lane(5), ("two lane segments with the id 5",)),
    "id is text": (lane(id="five"), ("lane_segments.5.id",)),
    "no id": (lane(id=None), ("'id'",)),
    "id is a fraction": (lane(id=5.5), ("lane_segments.5.id",)),
    "own successor": (lane(successors=[5]), ("its own successor",)),
    "successor is text": (lane(successors=["six"]), ("successors",)),
    "successors missing": (lane(successors=None), ("'successors'",)),
    "unknown marking": (lane(left_lane_mark_type="PURPLE_STARS"), ("left_lane_mark_type", "PURPLE_STARS")),
    "marking is a number": (lane(left_lane_mark_type=3), ("left_lane_mark_type",)),
    "intersection is text": (lane(is_intersection="False"), ("is_intersection",)),
    "lane type is a number": (lane(lane_type=2), ("lane_type",)),
    "crossing without an edge": (lambda content: content["pedestrian_crossings"]["1"].pop("edge2"), ("edge2",)),
    "crossing edge of one point": (entry("pedestrian_crossings", "edge1", points((0, 0))), ("edge1", "1 points")),
    "NaN in a crossing": (entry("pedestrian_crossings", "edge1", points((0, 0), (np.nan, 1))), ("edge1", "finite")),
    "crossing around the Earth": (
        entry("pedestrian_crossings", "edge1", points((4e7, 0), (4e7, 5))),
        ("pedestrian_crossings.1", "km apart"),
    ),
    "area of two points": (entry("drivable_areas", "area_boundary", points((0, 0), (1, 1))), ("area_boundary",)),
    "NaN in an area": (
        entry("drivable_areas", "area_boundary", points((0, 0), (1, np.nan), (2, 0))),
        ("area_boundary", "finite"),
    ),
}


@pytest.mark.parametrize("fault", MAPS)
def test_a_damaged_map_is_named_by_its_entry(folder, fault):
    damage, said = MAPS[fault]
    content = copy.deepcopy(MAP)
    damage(content)
    next((folder / "map").iterdir()).write_text(json.dumps(content))
    refused(folder, ("log_map_archive", *said))


def test_tracks_of_the_vehicle_itself_are_no_traffic(folder):
    """The tools of Argoverse write the ego vehicle as a track, at the origin of every frame."""
    before = load_log(folder).tracks
    table = feather.read_table(folder / ANNOTATIONS).to_pylist()
    own = [
        row | {"track_uuid": "ego", "category": "EGO_VEHICLE", "tx_m": 0.0}
        for row in table
        if row["track_uuid"] == "car"
    ]
    write(folder / ANNOTATIONS, table + own)
    assert check_log(folder) == []
    after = load_log(folder).tracks
    np.testing.assert_array_equal(after.uuid, before.uuid)
    np.testing.assert_array_equal(after.position, before.position)


def test_what_is_read_is_finite(folder):
    example = Argoverse2Dataset(Argoverse2Config(folder)).example(1)
    flow, lanes = example.traffic_flow, example.lanes
    assert flow.valid.any()
    assert np.isfinite(flow.position[flow.valid]).all()
    assert lanes.valid.any()
    assert np.isfinite(lanes.points[lanes.valid]).all()


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (lambda time: time // 1000, ("0.0001 s apart", "nanoseconds")),  # microseconds
        (lambda time: time * 1000, ("1e+02 s apart", "nanoseconds")),
        (lambda time: time + (10**12 if time >= 1300 * 10**6 else 0), ("no box for 1000 s", "several logs")),
    ],
)
def test_times_in_another_unit_are_refused(folder, scale, said):
    for name in (ANNOTATIONS, POSES):
        rows = feather.read_table(folder / name).to_pylist()
        # The vehicle stands: a moving one would jump.
        write(folder / name, [row | {"timestamp_ns": scale(row["timestamp_ns"])} | STANDS[name] for row in rows])
    refused(folder, said)


FRAMES, LOGS = '{"val": {"10003": ["1000000000.json"]}}', '{"val": {"10003": "log"}}'


@pytest.mark.parametrize(
    ("frames", "logs", "message"),
    [
        ("[]", LOGS, r"subset_A\.json is of type list, expected a mapping"),
        (FRAMES, "[]", r"log\.json is of type list, expected a mapping"),
        ('{"val": []}', LOGS, r"subset_A\.json: val is \[\], expected a mapping from segments"),
        (FRAMES, '{"val": 3}', r"log\.json: val is 3, expected a mapping from segments"),
        (FRAMES, '{"val": {"10003": ["log"]}}', r"log\.json: val: 10003 is \['log'\], expected the id of a log"),
        ('{"val": {"10003": 5}}', LOGS, "val: 10003 is of type int, expected a list"),
        ('{"val": {"10003": [1.5]}}', LOGS, r"val: 10003: 1\.5 is no frame, expected <timestamp>"),
        ('{"val": {"10003": ["first.json"]}}', LOGS, r"val: 10003: 'first\.json' is no frame"),
        (f'{{"val": {{"10003": ["{10**30}.json"]}}}}', LOGS, "is no frame"),
        ("[" * 100_000, LOGS, "nested too deep"),
    ],
)
def test_damaged_split_files_are_named(folder, tmp_path, frames, logs, message):
    (tmp_path / "OpenLane-V2").mkdir()
    (tmp_path / "OpenLane-V2" / "data_dict_subset_A.json").write_text(frames)
    (tmp_path / "subset_A_segment_to_av2_log.json").write_text(logs)
    with pytest.raises(UserError, match=message):
        load_log(folder, openlane=tmp_path)

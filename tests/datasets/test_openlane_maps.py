"""A segment of OpenLane-V2 as a map: lanes cut in every frame are joined again, with their topology."""

import json
import shutil

import numpy as np
import pytest

from tests.datasets.small_logs import log, tracks
from tests.world.small_map import crossroads
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.identities import Identities
from tflane_jax.datasets.openlane_export import centerline_annotation, segment_annotation
from tflane_jax.datasets.openlane_maps import joined, read_segment, same_lines, segment_files
from tflane_jax.datasets.road_maps import find_maps
from tflane_jax.errors import UserError
from tflane_jax.geometry import line_distances, yaw_pose
from tflane_jax.geometry.polylines import resample_lines
from tflane_jax.scene import LineType
from tflane_jax.world.roads.map_networks import prepare_roads

SIZES = ExampleConfig(sensor=None, lanes=40, segments=40, tracks=1, history=1)
EAST_TO_WEST = [yaw_pose(x, -1.75, 0.05 * np.sin(x)) for x in np.linspace(-60.0, 60.0, 10)]
TRUTH = crossroads().map


def write_frames(folder, flavours=("", "-ls"), poses=EAST_TO_WEST):
    """Write the frames of a drive over the crossroads, half a second apart, and return the folder of the data."""
    recorded = log(TRUTH, tracks(np.zeros((len(poses), 1, 3))), poses, list(enumerate(poses)))
    info = folder / "val" / "10073" / "info"
    info.mkdir(parents=True)
    for number, pose in enumerate(poses):
        example, ids = make_example(recorded, number, SIZES), Identities()
        ids.step(example)
        annotation = {"": centerline_annotation, "-ls": segment_annotation}
        record = {"pose": {"rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist()}}
        for flavour in flavours:
            content = record | {"annotation": annotation[flavour](example, ids)}
            (info / f"{315_000_000_000_000_000 + 500_000_000 * number}{flavour}.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("openlane"))


def true_lane(line):
    """Return the id of the only lane of the crossroads on which a line lies, and how far it lies off."""
    lanes = list(TRUTH.segments.values())
    distance, place = line_distances(line, resample_lines([lane.centerline for lane in lanes], 101))
    off = np.where(place[:, -1] > place[:, 0], distance.max(-1), np.inf)
    return lanes[off.argmin()].id, off.min()


@pytest.mark.parametrize("flavour", ["-ls", ""])
def test_the_lanes_of_all_frames_are_those_of_the_map(root, flavour):
    files = [path for path in sorted((root / "val/10073/info").iterdir()) if path.stem.endswith("-ls") == bool(flavour)]
    found = read_segment(files)
    assert (found.name, found.source) == ("val-10073", "openlane_v2")
    names = {i: true_lane(lane.centerline) for i, lane in found.map.segments.items()}
    assert max(off for _, off in names.values()) < 0.15
    assert sorted(name for name, _ in names.values()) == sorted(TRUTH.segments)
    for i, lane in found.map.segments.items():
        true = TRUTH.segments[names[i][0]]
        assert {names[j][0] for j in lane.successors} == set(true.successors)
        assert lane.is_intersection == true.is_intersection
        assert lane.left_type == (true.left_type if flavour else LineType.NONE)
        left, right = resample_lines([lane.left, lane.right], 21)
        assert np.linalg.norm(left - right, axis=-1).mean() == pytest.approx(3.5, abs=0.3)
    # Along the drive it reaches 50 m beyond the first and the last frame, to the sides 25 m.
    along = np.concatenate([lane.centerline for lane in found.map.segments.values()])
    np.testing.assert_allclose([along[:, 0].min(), along[:, 0].max()], [-110, 110], atol=1.5)
    np.testing.assert_allclose([along[:, 1].min(), along[:, 1].max()], [-26.75, 23.25], atol=3.5)
    assert bool(found.map.road_boundaries) == bool(flavour)
    kerbs = resample_lines(list(TRUTH.road_boundaries), 201)
    for line in found.map.road_boundaries:
        assert line_distances(line, kerbs)[0].min(0).max() < 0.4
    np.testing.assert_allclose(found.places, np.stack(EAST_TO_WEST)[:, :2, 3])


def test_a_folder_of_segments_is_a_folder_of_maps(root):
    (one,) = find_maps(root)
    assert (one.name, one.kind, one.recorded) == ("val-10073", "openlane_v2", False)
    assert all(path.stem.endswith("-ls") for path in one.files)  # they tell more
    assert [path.stem[:18] for path in one.files] == sorted(path.stem[:18] for path in one.files)
    assert find_maps(root / "val" / "10073")[0].content() == one.content()
    roads = prepare_roads(one.read(), 2.0)
    assert len(roads.junctions) == 1
    assert roads.spots(56.0)
    with pytest.raises(UserError, match="is a map without a recording"):
        one.log()


def test_pieces_are_joined_at_either_end():
    line = np.column_stack([np.arange(20.0), np.zeros(20), np.ones(20)])
    for first, second in ((line[:12], line[5:]), (line[5:], line[:12]), (line[3:9], line), (line, line[3:9])):
        np.testing.assert_allclose(joined(first, second), line)


def test_lines_that_part_or_run_against_each_other_are_different():
    straight = np.column_stack([np.linspace(0, 20, 9), np.zeros(9), np.zeros(9)])
    bent = straight + np.column_stack([np.zeros(9), np.linspace(0, 1, 9) ** 2 * 8, np.zeros(9)])
    assert same_lines([bent, straight], [straight, bent]) == {0: 1, 1: 0}
    assert same_lines([straight[::-1]], [straight]) == {}
    assert same_lines([straight], [bent]) == {}
    assert same_lines([], [straight]) == {}


def test_lines_that_come_and_go_take_no_other_line_its_place():
    """One of two lanes stays and the other is replaced: pairing both crosswise would be the shorter sum."""
    before, now = ([np.array([[0.0, y, 0.0], [30.0, y, 0.0]]) for y in of_frame] for of_frame in ((0, 10), (0.3, -10)))
    assert same_lines(now, before) == {0: 0}
    ids, valid = Identities(), np.ones(2, bool)
    first, second = (ids._next("lane", np.stack(lines), None, valid, np.eye(4)) for lines in (before, now))
    assert second[0] == first[0]
    assert second[1] not in first.values()


def _short(name, field, points):
    """Return damage: the first lane or edge of every frame is as short as where the border cuts off a corner."""

    def damage(annotation):
        one = next(thing for thing in annotation[name] if thing.get("category", 2) == 2)
        x, y, z = one[field][0]
        one[field] = np.linspace([x, y, z], [x + 0.1, y, z], points).tolist()

    return damage


@pytest.mark.parametrize(
    ("flavour", "damage"),
    [
        ("", _short("lane_centerline", "points", 201)),
        ("", _short("lane_centerline", "points", 1)),
        ("-ls", _short("lane_segment", "centerline", 201)),
        ("-ls", _short("lane_segment", "left_laneline", 1)),
        ("-ls", _short("lane_segment", "right_laneline", 201)),
        ("-ls", _short("area", "points", 201)),
    ],
)
def test_lines_without_length_are_passed_over(tmp_path, flavour, damage):
    """They tell nothing; the other lanes and their topology stay."""
    files = segment_files(write_frames(tmp_path, (flavour,), EAST_TO_WEST[:4]) / "val" / "10073" / "info")
    whole = read_segment(files).map
    for file in files:
        frame = json.loads(file.read_text())
        damage(frame["annotation"])
        file.write_text(json.dumps(frame))
    found = read_segment(files).map
    assert 0 <= len(whole.segments) - len(found.segments) <= 1
    for lane in found.segments.values():
        assert all(len(line) > 1 and np.isfinite(line).all() for line in (lane.centerline, lane.left, lane.right))
        left, right = resample_lines([lane.left, lane.right], 21)
        assert np.linalg.norm(left - right, axis=-1).mean() == pytest.approx(3.5, abs=0.5)
    assert all(len(line) > 1 for line in found.road_boundaries)


def _no_annotation(frames):
    frames[3]["annotation"] = None


def _jump(frames):
    frames[3]["pose"]["translation"][0] += 300.0


def _not_a_number(frames):
    frames[3]["annotation"]["lane_segment"][0]["centerline"][0][0] = float("nan")


def _topology(frames):
    frames[3]["annotation"]["topology_lsls"] = [[1]]


def _mirrored(frames):
    frames[3]["pose"]["rotation"][0] = [-1.0, 0.0, 0.0]


def _empty(frames):
    for frame in frames:
        frame["annotation"] |= {"lane_segment": [], "topology_lsls": [], "topology_lste": []}


def _zigzag(frames):
    """A small file that would become hundreds of millions of points, 2 m apart."""
    frames[1]["annotation"]["lane_segment"][0]["centerline"] = [[(-1) ** i * 9e4, 0.0, 0.0] for i in range(6000)]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_zigzag, r"-ls\.json: a line is 1079820 km long, in a frame of some 100 m"),
        (_no_annotation, "has no annotation, as in the test split"),
        (_jump, "the vehicle is 3.. m from its place 0.5 s before"),
        (_not_a_number, r"lane_segment\[0\]\.centerline"),
        (_topology, "topology_lsls"),
        (_mirrored, "rotation is no rotation"),
        (_empty, "val/10073: no frame has a lane"),
    ],
)
def test_damage_is_named(root, tmp_path, damage, message):
    files = segment_files(root / "val/10073/info")[:4]
    frames = [json.loads(path.read_text()) for path in files]
    damage(frames)
    info = tmp_path / "val" / "10073" / "info"
    info.mkdir(parents=True)
    for path, frame in zip(files, frames, strict=True):
        (info / path.name).write_text(json.dumps(frame))
    with pytest.raises(UserError, match=message):
        read_segment(segment_files(info))


@pytest.mark.parametrize("name", [10**18, 10**16 - 1, 10**25])
def test_times_that_do_not_fit_in_64_bits_are_named(root, tmp_path, name):
    """The last digits of a time as nanoseconds, of one in microseconds, and of neither."""
    info = tmp_path / "val" / "10073" / "info"
    info.mkdir(parents=True)
    (file,) = segment_files(root / "val/10073/info")[:1]
    shutil.copy(file, info / f"{name}-ls.json")
    if name == 10**18:
        assert read_segment(segment_files(info)).map.segments
    else:
        with pytest.raises(UserError, match=rf"{name}-ls\.json is not named after its time in nanoseconds or microsec"):
            read_segment(segment_files(info))

"""Scene files of nuScenes: one by hand, every kind of damage, and the seven real ones."""

import functools
import json

import numpy as np
import pytest

from tests.datasets.test_sources import chosen
from tests.shared import shared_path
from tflane_jax.cli import main
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example, traffic_flow
from tflane_jax.datasets.leaves import example_leaves
from tflane_jax.datasets.nuscenes_scene_files import find_scene_files, read_scene_file
from tflane_jax.datasets.nuscenes_scenes import NUSCENES_SIZES, SceneFileConfig, SceneFileData, SceneFileDataset
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.scene import LineType, RoadUser

SCENES = ("0061", "0655", "0757", "0796", "1077", "1094", "1100")


def content(name="scene-0061"):
    """A vehicle that stands at (10, 20), heading north; a lane under it, a connector after it, a cone and a car."""
    lines = [
        [(10, 0), (10, 20), (10, 20), (10, 40)],  # the joint of two arcs is there twice
        [(10, 40), (12, 45), (15, 50)],
        [(11.75, 0), (11.75, 40)],
        [(8.4, 0), (8.4, 40)],
        [(-20, -20), (-20, 60), (60, 60), (-20, -20)],
    ]
    outlines = [[(8.25, 0), (11.75, 0), (11.75, 40), (8.25, 40), (8.25, 0)], [], [], [], []]
    return {
        "instance_token": np.array(["car", "cone"]),
        "category": np.array(["vehicle.car", "movable_object.trafficcone"]),
        "size_wlh": np.array([[2.0, 4.5, 1.6], [0.3, 0.3, 0.7]]),
        "position": np.array(
            [[[8.0, 30.0, 1.0], [0, 0, 0]], [[0, 0, 0], [5.0, 5.0, 0]], [[8.0, 34.0, 1.0], [0, 0, 0]]]
        ),
        "yaw": np.array([[np.pi / 2, 0.0], [0.0, 0.0], [np.pi, 0.0]]),
        "valid": np.array([[True, False], [False, True], [True, False]]),
        "ego_position": np.tile([10.0, 20.0, 0.0], (3, 1)),
        "ego_yaw": np.full(3, np.pi / 2),
        "map_token": np.array(["lane", "turn", "white", "yellow", "boundary_0"]),
        "map_type": np.array(
            [
                "LANE_SURFACE_STREET",
                "LANE_SURFACE_STREET",
                "ROAD_LINE_BROKEN_SINGLE_WHITE",
                "ROAD_LINE_SOLID_SINGLE_YELLOW",
                "ROAD_LINE_SOLID_SINGLE_WHITE",
            ]
        ),
        "polyline": np.array([point for line in lines for point in line], float),
        "polyline_len": np.array([len(line) for line in lines]),
        "polygon": np.array([point for ring in outlines for point in ring], float),
        "polygon_len": np.array([len(ring) for ring in outlines]),
        "meta": np.array(json.dumps({"scene": name, "rate_hz": 2})),
    }


def write(path, arrays):
    np.savez(path, **arrays)
    return path


def test_a_scene_by_hand(tmp_path):
    log = read_scene_file(write(tmp_path / "scene-0061.npz", content()))
    assert (log.name, log.source, log.rate_hz) == ("scene-0061", "nuscenes-scenes", 2.0)
    tracks = log.tracks
    assert (tracks.uuid.tolist(), tracks.category.tolist()) == (["car"], [RoadUser.CAR])
    assert tracks.valid[:, 0].tolist() == [True, False, True]
    np.testing.assert_allclose(tracks.position[[0, 2], 0], [[10, 2, 1], [14, 2, 1]], atol=1e-9)
    np.testing.assert_allclose(tracks.yaw[[0, 2], 0], [0.0, np.pi / 2], atol=1e-9)
    assert tracks.size[0].tolist() == [4.5, 2.0, 1.6]
    assert not tracks.occluded.any()
    lane, turn = log.map.segments.values()
    assert (lane.successors, turn.successors) == ((turn.id,), ())
    assert (lane.is_intersection, turn.is_intersection) == (False, True)
    np.testing.assert_array_equal(lane.centerline, [(10, 0, 0), (10, 20, 0), (10, 40, 0)])
    np.testing.assert_allclose(lane.left[:, 0], 8.25)
    # 0.15 m beside the solid divider, on the dashed one; nothing is known of connectors.
    assert (lane.left_type, lane.right_type) == (LineType.SOLID, LineType.DASHED)
    assert (turn.left_type, turn.right_type) == (LineType.NONE, LineType.NONE)
    assert [len(line) for line in log.map.dividers] == [2, 2]
    (boundary,) = log.map.road_boundaries
    assert len(boundary) == 4
    example = make_example(log, 2, ExampleConfig(lanes=4, segments=4, areas=4, tracks=2))
    example.validate()
    assert example.traffic_flow.valid[0].tolist() == [False] * 18 + [True, False]


def moved(key, index, far):
    def damage(scene):
        scene[key][index, 0] += far

    return damage


def changed(**arrays):
    return lambda scene: scene.update(arrays)


def with_nan(key, *index):
    def damage(scene):
        scene[key][index] = np.nan

    return damage


DAMAGE = {
    "NaN position": (with_nan("position", 1, 1, 0), r"position holds nan at \[1, 1, 0\]"),
    "infinite yaw": (changed(yaw=np.full((3, 2), np.inf)), "yaw holds inf"),
    "NaN ego": (with_nan("ego_position", 0, 0), "ego_position holds nan"),
    "NaN ego yaw": (with_nan("ego_yaw", 2), r"ego_yaw holds nan at \[2\]"),
    "NaN line": (with_nan("polyline", 3, 1), r"polyline holds nan at \[3, 1\]"),
    "NaN outline": (with_nan("polygon", 0, 1), "polygon holds nan"),
    "NaN size": (with_nan("size_wlh", 0, 1), "size_wlh holds nan"),
    "negative size": (changed(size_wlh=-np.ones((2, 3))), "size_wlh holds a size that is not positive"),
    "frames differ": (changed(ego_yaw=np.zeros(2)), r"ego_yaw has shape \(2,\), expected \(3,\)"),
    "no frames": (changed(valid=np.zeros((0, 2), bool)), r"valid has type bool and shape \(0, 2\)"),
    "valid as numbers": (changed(valid=np.ones((3, 2))), "valid has type float64"),
    "text as numbers": (changed(category=np.array([1, 2])), "category must be a list of texts"),
    "vehicle that jumps": (
        changed(ego_position=np.array([[10, 20, 0], [10, 90, 0], [10, 20, 0]], float)),
        r"ego_position\[1\]: the vehicle is 70 m from its place 0.5 s before",
    ),
    "poses of another place": (changed(ego_position=np.full((3, 3), 5e3)), "the vehicle never comes within 200 m"),
    "box far away": (changed(position=np.full((3, 2, 3), 5e3)), r"position\[0, 0\]: the box is 7\d\d\d m from"),
    "digits as texts": (changed(yaw=np.array([["1", "2"]] * 3)), "yaw is of type ndarray, expected numbers"),
    "texts as numbers": (changed(yaw=np.array([["a", "b"]] * 3)), "yaw is of type ndarray, expected numbers"),
    "other number of categories": (changed(category=np.array(["vehicle.car"])), "category has 1 entries, expected 2"),
    "track twice": (changed(instance_token=np.array(["car", "car"])), "instance_token names a track twice"),
    "unknown category": (changed(category=np.array(["boat", "boat"])), "unknown category 'boat'"),
    "unknown element": (changed(map_type=np.array(["RIVER"] * 5)), "map_type 'RIVER' of lane is neither"),
    "line around the Earth": (moved("polyline", 1, 4e7), r"polyline of lane: points 0 and 1 are .* km apart"),
    "outline around the Earth": (moved("polygon", 1, 4e7), r"polygon of lane: points 0 and 1 are .* km apart"),
    "lengths": (changed(polyline_len=np.array([4, 3, 2, 2, 9])), "polyline_len adds up to 20, but polyline has 15"),
    "lengths as fractions": (changed(polygon_len=np.ones(5)), "polygon_len must be 5 whole numbers"),
    "negative lengths": (changed(polyline_len=np.array([4, 3, 2, 7, -1])), "polyline_len must be 5 whole numbers"),
    "meta no JSON": (changed(meta=np.array("scene")), "meta is no JSON text"),
    "meta too deep": (changed(meta=np.array("[" * 100_000)), "meta is no JSON text of this kind: .* nested too deep"),
    "meta of many digits": (changed(meta=np.array("1" * 5000)), "meta is no JSON text that can be read"),
    "no rate": (changed(meta=np.array('{"scene": "a", "rate_hz": 0}')), "rate_hz must be key frames a second, not 0"),
    "no time at all": (changed(meta=np.array('{"scene": "a", "rate_hz": 1e-300}')), "a second, not 1e-300"),
    **{
        f"name {name!a:.20}": (
            changed(meta=np.array(json.dumps({"scene": name, "rate_hz": 2}))),
            "meta: scene is .*, expected a name that can be that of a file",
        )
        for name in ("", "..", "/elsewhere/a", "../a", "a\\b", "a\nb", "\ud800", "\x1b[2J", "a" * 201, 3)
    },
    "objects": (changed(category=np.array([{}, {}], object)), "no .npz file of plain arrays"),
    **{f"{key} missing": (lambda scene, key=key: scene.pop(key), f"lacks the entry '{key}'") for key in content()},
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_with_file_and_key(tmp_path, name):
    damage, message = DAMAGE[name]
    scene = content()
    damage(scene)
    path = write(tmp_path / "scene.npz", scene)
    with pytest.raises(UserError, match=message) as error:
        read_scene_file(path)
    assert str(path) in str(error.value)


def test_what_is_no_scene_file_is_named(tmp_path):
    path = write(tmp_path / "scene.npz", content())
    whole = path.read_bytes()
    for damaged in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"scene\.npz is no .npz file of plain arrays"):
            read_scene_file(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    for name in ("array.npy", "none.npz"):
        with pytest.raises(UserError, match=name):
            read_scene_file(tmp_path / name)
    with pytest.raises(UserError, match="there is no"):
        find_scene_files(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="holds no scene file"):
        find_scene_files(tmp_path / "empty")


def test_a_scene_without_traffic_is_empty_and_one_without_lanes_an_error(tmp_path):
    scene = content()
    scene["valid"][:] = False
    log = read_scene_file(write(tmp_path / "scene.npz", scene))
    example = make_example(log, 2, ExampleConfig(lanes=4, segments=4, areas=4, tracks=2))
    assert example.lanes.valid.any()
    assert not example.traffic_flow.valid.any()
    scene |= {key: scene[key][:0] for key in ("map_token", "map_type", "polyline", "polygon")}
    scene |= {f"{key}_len": np.zeros(0, int) for key in ("polyline", "polygon")}
    with pytest.raises(UserError, match="the map is empty or of another place"):
        read_scene_file(write(tmp_path / "scene.npz", scene))


def test_scenes_are_chosen_by_name_or_official_split(tmp_path):
    for name in ("scene-0061", "scene-0103"):
        write(tmp_path / f"{name}.npz", content())
    dataset = SceneFileDataset(SceneFileConfig(tmp_path))
    assert len(dataset) == 6
    assert dataset.info(5).timestamp_ns == 10**9
    data = SceneFileData(tmp_path, train=("scene-0103",), val=("scene-0061",), test=("scene-0061",))
    assert len(SceneFileDataset(data.source("train"))) == 3
    with pytest.raises(UserError, match="has no scene scene-7, only scene-0061, scene-0103"):
        SceneFileDataset(SceneFileConfig(tmp_path, ("scene-7",)))
    assert chosen("--data", "nuscenes-scenes", "--root", tmp_path).scenes == ()
    assert chosen("--data", "nuscenes-scenes", "--root", tmp_path, "--split", "val").scenes == ("scene-0103",)
    message = r"has no scene of nuScenes' split test: choose --split train or val, or leave it out to take all$"
    with pytest.raises(UserError, match=message):
        chosen("--data", "nuscenes-scenes", "--root", tmp_path, "--split", "test")


def test_check_lists_damaged_files(tmp_path, capsys):
    write(tmp_path / "a.npz", content())
    assert main(["data", "check", "--format", "nuscenes-scenes", str(tmp_path)]) == 0
    write(tmp_path / "b.npz", content() | {"ego_yaw": np.full(3, np.nan)})
    assert main(["data", "check", "--format", "nuscenes-scenes", str(tmp_path)]) == 2
    text = capsys.readouterr().out
    assert "| a     |          3 |          1 |     2 |        2 |          1 |" in text
    assert "1 fault:" in text
    assert "b.npz: ego_yaw holds nan" in text


@functools.cache
def real(number):
    return read_scene_file(shared_path(f"data/nuscenes_scenes/scene-{number}.npz"))


@pytest.mark.golden
@pytest.mark.parametrize("number", SCENES)
def test_real_scenes_are_finite_and_on_the_road(number):
    log = real(number)
    assert log.rate_hz == 2.0
    examples = [make_example(log, i, NUSCENES_SIZES) for i in range(0, len(log.keyframes), 8)]
    on_lane = []
    for example in examples:
        example.validate()
        for name, leaf in example_leaves(example).items():
            assert np.isfinite(np.asarray(leaf, float)).all(), name
        assert example.lanes.valid.sum() >= 5
        assert example.segments.successor.sum() >= 4
        i, j = np.nonzero(example.segments.successor)
        np.testing.assert_allclose(example.segments.points[i, -1], example.segments.points[j, 0], atol=0.02)
        # The left boundary lies to the left of the centerline, the right one to the right.
        lanes = example.segments
        heading = np.gradient(lanes.points[lanes.valid], axis=1)
        for side, sign in ((lanes.left, 1.0), (lanes.right, -1.0)):
            across = (side - lanes.points)[lanes.valid]
            turn = heading[..., 0] * across[..., 1] - heading[..., 1] * across[..., 0]
            assert (sign * turn[:, 4:6] > 0.0).mean() > 0.95
        on_lane.append(np.linalg.norm(example.segments.points[lanes.valid][..., :2], axis=-1).min() < 6.0)
    assert all(on_lane)


@pytest.mark.golden
@pytest.mark.parametrize("number", SCENES)
def test_real_tracks_are_the_vehicles_and_people(number):
    with np.load(shared_path(f"data/nuscenes_scenes/scene-{number}.npz")) as file:
        traffic = [name.startswith(("vehicle.", "human.")) for name in file["category"].tolist()]
        boxes = file["valid"][:, traffic]
        position, ego = file["position"][:, traffic], file["ego_position"]
        heading = np.exp(1j * file["ego_yaw"])
    tracks = real(number).tracks
    np.testing.assert_array_equal(tracks.valid, boxes)
    # The same in complex numbers: (p - ego) turned back by the vehicle's heading.
    relative = (position - ego[:, None])[..., :2] @ [1.0, 1j] * heading.conj()[:, None]
    np.testing.assert_allclose((tracks.position[..., :2] @ [1.0, 1j])[boxes], relative[boxes], atol=1e-6)


@pytest.mark.golden
def test_a_measured_history():
    """Counted apart from this reader: all objects within 30 m by 15 m of key frame 20 of scene-0061, furniture too."""
    everything = dict.fromkeys(("vehicle", "human", "movable_object"), RoadUser.CAR)
    log = read_scene_file(shared_path("data/nuscenes_scenes/scene-0061.npz"), categories=everything)
    flow, dropped = traffic_flow(log, 20, history=20, capacity=250)
    inside = (flow.valid & PerceptionRange((-30, 30), (-15, 15)).contains(flow.position)).sum(-1)
    assert ([(inside >= least).sum() for least in (1, 5, 10)], dropped) == ([64, 63, 48], 0)


@pytest.mark.golden
def test_moving_cars_keep_to_the_lanes():
    """Cars that drive do so along a lane: tracks, poses and maps agree."""
    agree = []
    for number in SCENES:
        log = real(number)
        for i in range(10, len(log.keyframes), 10):
            example = make_example(log, i, NUSCENES_SIZES)
            flow, lanes = example.traffic_flow, example.segments
            step = flow.position[:, -1, :2] - flow.position[:, -4, :2]
            fast = flow.valid[:, -1] & flow.valid[:, -4] & (flow.category == RoadUser.CAR)
            fast &= (np.linalg.norm(step, axis=-1) > 4.0) & (np.abs(flow.position[:, -1, :2]) < (45, 20)).all(-1)
            starts, ends = lanes.points[lanes.valid][:, :-1, :2], lanes.points[lanes.valid][:, 1:, :2]
            for k in np.flatnonzero(fast):
                near = np.linalg.norm((starts + ends) / 2 - flow.position[k, -1, :2], axis=-1) < 5.0
                heading = (ends - starts)[near]
                heading /= np.maximum(np.linalg.norm(heading, axis=-1, keepdims=True), 1e-6)
                agree.append(bool(((heading @ step[k]) / np.linalg.norm(step[k]) > 0.9).any()))
    assert len(agree) > 40
    assert np.mean(agree) > 0.85


@pytest.mark.golden
def test_the_shared_key_frame_is_one_of_them():
    """Boxes of the key frame of scene-0061 lie on those of the scene file, in the frame of the vehicle."""
    record = json.loads(shared_path("data/nuscenes_keyframe/keyframe_info.json").read_text())["data_list"][0]
    log = real("0061")
    pose = np.array(record["ego2global"])
    frame = int(np.linalg.norm(log.global_from_ego[:, :2, 3] - pose[:2, 3], axis=-1).argmin())
    assert np.linalg.norm(log.global_from_ego[frame, :2, 3] - pose[:2, 3]) < 0.2
    boxes = np.array([instance["bbox_3d"][:3] for instance in record["instances"]])
    there = (np.array(record["lidar_points"]["lidar2ego"])[:3] @ np.column_stack([boxes, np.ones(len(boxes))]).T).T
    ours = log.tracks.position[frame][log.tracks.valid[frame]]
    apart = np.linalg.norm(ours[:, None, :2] - there[:, :2], axis=-1).min(-1)
    # The file's poses are those of the CAN bus, up to 0.2 m away.
    assert np.median(apart) < 0.3

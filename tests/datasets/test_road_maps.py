"""Maps in a folder: logs of several formats, and what is wrong with them."""

import numpy as np
import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tests.datasets.small_argoverse2 import write_log
from tests.datasets.small_logs import drive, lane_map, log, segment, tracks
from tests.datasets.test_geojson_lanes import crossroads_features, write
from tests.datasets.test_nuscenes_scenes import content
from tests.world.small_map import crossroads
from tflane_jax.datasets import road_maps
from tflane_jax.datasets.nuscenes_tables import TABLES
from tflane_jax.datasets.road_maps import chosen_maps, find_maps, road_map_of
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, transform_points


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a log of each format, a map, and an npz file of something else."""
    root = tmp_path_factory.mktemp("maps")
    pytest.importorskip("pyarrow")
    pytest.importorskip("shapely")
    write_log(root / "sensor" / "val" / "log-a")
    (root / "scenes").mkdir()
    np.savez(root / "scenes" / "scene-0061.npz", **content())
    np.savez(root / "weights.npz", kernel=np.zeros(3))
    write(root / "town.geojson", crossroads_features())
    return root


def test_every_known_format_below_a_folder_is_found_by_name(folder):
    found = find_maps(folder)
    assert [(one.name, one.kind) for one in found] == [
        ("log-a", "argoverse2"),
        ("scene-0061", "nuscenes-scenes"),
        ("town", "geojson"),
    ]
    assert [one.recorded for one in found] == [True, True, False]
    maps = [one.read() for one in found]
    assert [one.name for one in maps] == ["log-a", "scene-0061", "town"]
    assert [len(one.map.segments) for one in maps] == [1, 2, len(crossroads().map.segments)]
    assert [one.name for one in find_maps(folder / "scenes" / "scene-0061.npz")] == ["scene-0061"]
    with pytest.raises(UserError, match="a map without a recording"):
        found[2].log()


def test_scenes_of_the_nuscenes_folder_have_the_map_around_them(tmp_path):
    pytest.importorskip("shapely")
    write_nuscenes(tmp_path)
    (tmp_path / "samples" / "v1.0").mkdir(parents=True)
    (tmp_path / "samples" / "v1.0" / "scene.json").write_text("not looked at")
    one, other = find_maps(tmp_path)
    assert [(x.name, x.kind) for x in (one, other)] == [("scene-0061", "nuscenes"), ("scene-0103", "nuscenes")]
    found = one.read()
    assert found.area == "singapore-onenorth"
    assert (len(found.map.segments), found.map.side) == (2, "left")
    np.testing.assert_allclose(found.places[:, 1], [1100.0, 1105.0, 1110.0, 1115.0], atol=0.5)
    before = one.content()
    path = tmp_path / "maps" / "expansion" / "singapore-onenorth.json"
    path.write_text(path.read_text() + " ")
    assert one.content() != before
    path.unlink()
    with pytest.raises(UserError, match=r"singapore-onenorth\.json"):
        one.content()
    path.write_text("{}")
    for table in ("ego_pose", "sample_annotation"):  # the drive, and the parked vehicles
        before, file = one.content(), tmp_path / "v1.0-mini" / f"{table}.json"
        file.write_text(file.read_text() + " ")
        assert one.content() != before
    (tmp_path / "v1.0-mini" / "log.json").write_text("[]")
    with pytest.raises(UserError, match=r"names a log that is not in .*log\.json"):
        find_maps(tmp_path)


def test_a_file_that_scenes_share_is_read_once(tmp_path, monkeypatch):
    """Of 850 scenes, each has the same tables and one of four maps: gigabytes."""
    read, whole = [], road_maps.hashlib.file_digest
    monkeypatch.setattr(
        road_maps.hashlib, "file_digest", lambda file, kind: (read.append(file.name), whole(file, kind))[1]
    )
    for one in find_maps(write_nuscenes(tmp_path)):
        assert one.content() == one.content()
    assert len(read) == len(set(read)) == len(TABLES) + 2


@pytest.mark.parametrize(
    ("table", "content", "message"),
    [
        ("scene", "5", r"scene\.json is no JSON list"),
        ("log", "null", r"log\.json is no JSON list"),
        ("log", "[3]", r"log\.json: a row is of type int"),
        ("log", '[{"token": [1], "location": "x"}]', r"log\.json: token is \[1\], expected text"),
        ("scene", '[{"name": "x", "log_token": {}}]', r"scene\.json: log_token is {}, expected text"),
        ("scene", '[{"name": null, "log_token": "x"}]', r"scene\.json: name is None, expected a name"),
    ],
)
def test_damaged_tables_of_scenes_are_named(tmp_path, table, content, message):
    (write_nuscenes(tmp_path) / "v1.0-mini" / f"{table}.json").write_text(content)
    with pytest.raises(UserError, match=message):
        find_maps(tmp_path)


def test_logs_are_chosen_by_name(folder):
    assert [one.name for one in chosen_maps(folder, ("town",))] == ["town"]
    assert [one.name for one in chosen_maps(folder, (), ("town", "log-a"))] == ["scene-0061"]
    with pytest.raises(UserError, match=r"has no log scene-7, only log-a, scene-0061, town"):
        chosen_maps(folder, ("scene-7",))
    with pytest.raises(UserError, match=r"no map of .* is left"):
        chosen_maps(folder, ("town",), ("town",))


def test_a_folder_without_maps_or_with_a_name_twice_is_refused(tmp_path):
    with pytest.raises(UserError, match="holds no map: expected Argoverse 2"):
        find_maps(tmp_path)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write(tmp_path / name / "town.geojson", [])
    with pytest.raises(UserError, match=r"two maps with the name town: take out .*a/town.geojson or .*b/town.geojson"):
        find_maps(tmp_path)


def test_a_renamed_copy_of_a_scene_is_the_same_scene(tmp_path):
    """Regression: under another name of its file, a test scene was in the training data, too."""
    for name in ("scene-0061", "0061-backup"):
        np.savez(tmp_path / f"{name}.npz", **content())
    with pytest.raises(UserError, match=r"two maps with the name scene-0061: take out .*backup.npz or .*0061.npz"):
        find_maps(tmp_path)
    assert [one.name for one in find_maps(tmp_path / "0061-backup.npz")] == ["scene-0061"]


def test_folders_that_links_lead_to_twice_are_read_once(tmp_path):
    (tmp_path / "maps" / "town").mkdir(parents=True)
    write(tmp_path / "maps" / "town" / "town.geojson", crossroads_features())
    for name, target in (("again", "town"), ("loop", "."), ("ring", "other"), ("other", "ring"), ("gone", "nowhere")):
        (tmp_path / "maps" / name).symlink_to(target)
    assert [one.name for one in find_maps(tmp_path / "maps")] == ["town"]


def test_the_content_tells_changed_files(tmp_path):
    (one,) = find_maps(write(tmp_path / "town.geojson", crossroads_features()).parent)
    before = one.content()
    assert one.content() == before
    write(tmp_path / "town.geojson", crossroads_features()[1:])
    assert one.content() != before
    (tmp_path / "town.geojson").unlink()
    with pytest.raises(UserError, match="cannot read"):
        one.content()


def of_another_version(archive):
    """Return an archive whose directory says that its first member needs version 9.9 of zip."""
    head, sign, entry = archive.partition(b"PK\x01\x02")
    return head + sign + entry[:2] + b"\x63\x00" + entry[4:]


@pytest.mark.parametrize("damage", [lambda archive: b"no zip", of_another_version])
def test_a_damaged_scene_file_is_named_and_not_passed_over(tmp_path, damage):
    np.savez(file := tmp_path / "scene-1.npz", **content())
    file.write_bytes(damage(file.read_bytes()))
    (one,) = find_maps(tmp_path)
    with pytest.raises(UserError, match=r"scene-1\.npz is no .npz file"):
        one.read()


def test_a_map_is_complete_up_to_the_nearest_lane_that_it_cuts():
    lanes = lane_map(segment(1, [(0, 0), (40, 0)], [2]), segment(2, [(40, 0), (90, 0)], [77]))
    poses = drive(3, start=(0.0, 0.0), step=5.0, turn=0.0)
    recorded = tracks(np.zeros((3, 0, 3)))
    found = road_map_of(log(lanes, recorded, poses, [(0, poses[0])]))
    nearest = np.linalg.norm(poses[:, :2, 3] - [90.0, 0.0], axis=-1).min()
    assert found.complete == pytest.approx(nearest)
    np.testing.assert_array_equal(found.places, poses[:, :2, 3])
    uncut = lane_map(segment(1, [(0, 0), (40, 0)]))
    assert road_map_of(log(uncut, recorded, poses, [(0, poses[0])])).complete == 100.0


def test_parked_are_vehicles_that_stand_beside_the_lanes_for_seconds():
    lanes = lane_map(segment(1, [(0, 0), (200, 0)]))
    frames = 60  # 10 Hz
    poses = drive(frames, start=(0.0, 0.0), step=0.5, turn=0.0)
    spots = np.array([[20.0, 5.0, 0.0], [30.0, 0.3, 0.0], [40.0, 5.0, 0.0], [50.0, 5.0, 0.0]])
    where = np.tile(spots, (frames, 1, 1))
    where[:, 2, 0] += np.linspace(0.0, 3.0, frames)  # rolls
    valid = np.ones((frames, 4), bool)
    valid[20:, 3] = False  # seen for 2 s
    recorded = tracks(transform_points(invert_pose(poses), where), valid=valid)
    (found,) = road_map_of(log(lanes, recorded, poses, [(0, poses[0])])).parked
    np.testing.assert_allclose(found[:2], spots[0, :2], atol=1e-6)
    assert found[2] == pytest.approx(0.4)  # the heading of the drive: the boxes have yaw 0 in its frame

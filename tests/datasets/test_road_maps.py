"""Maps in a folder: logs of two formats, lanes as GeoJSON, and what is wrong with them."""

import json

import numpy as np
import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tests.datasets.small_argoverse2 import write_log
from tests.datasets.small_logs import drive, lane_map, log, segment, tracks
from tests.datasets.test_nuscenes_scenes import content
from tests.world.small_map import crossroads
from tflane_jax.datasets import road_maps
from tflane_jax.datasets.geojson_lanes import read_lanes
from tflane_jax.datasets.nuscenes_tables import TABLES
from tflane_jax.datasets.real_maps import check_real_maps
from tflane_jax.datasets.road_maps import chosen_maps, find_maps, road_map_of
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, transform_points
from tflane_jax.scene import LineType
from tflane_jax.world.mirror import mirrored_map
from tflane_jax.world.roads.map_networks import prepare_roads
from tflane_jax.world.roads.road_map import drives_on_left, driving_side

# Degrees of a metre at the equator, near (0, 10).
EAST, NORTH = 1 / 111_319.49, 1 / 110_574.28


def place(*metres):
    return [[10.0 + x * EAST, y * NORTH] for x, y in metres]


def lane(number, *metres, **properties):
    geometry = {"type": "LineString", "coordinates": place(*metres)}
    return {"type": "Feature", "properties": {"lane": number, **properties}, "geometry": geometry}


def crossroads_features():
    """Return the crossroads of `small_map` as GeoJSON, with a kerb, a crossing and a feature that is no lane."""
    features = [
        lane(s.id, *s.centerline[:, :2], width=3.5, left="dashed", right="solid", intersection=bool(s.is_intersection))
        for s in crossroads().map.segments.values()
    ]
    ring = [(9, -6), (9, 6), (11.5, 6), (11.5, -6), (9, -6)]
    others = {
        "boundary": {"type": "LineString", "coordinates": place(*crossroads().map.road_boundaries[0][:, :2])},
        "crossing": {"type": "Polygon", "coordinates": [place(*ring)]},
        "tree": {"type": "Point", "coordinates": [10.0, 0.0]},
    }
    return features + [{"type": "Feature", "properties": {k: True}, "geometry": g} for k, g in others.items()]


def write(path, features):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


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
        ("scene", '[{"name": null, "log_token": "x"}]', r"scene\.json: name is None, expected text"),
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


def test_lanes_of_a_geojson_file_have_their_places_markings_and_successors(tmp_path):
    town = read_lanes(write(tmp_path / "town.geojson", crossroads_features()))
    original = crossroads().map
    got = list(town.map.segments.values())
    middle = np.concatenate([s.centerline for s in original.segments.values()]).mean(0)[:2]
    numbers = {number: i for i, number in enumerate(original.segments)}
    for (number, wanted), lane_ in zip(original.segments.items(), got, strict=True):
        np.testing.assert_allclose(lane_.centerline[:, :2], wanted.centerline[:, :2] - middle, atol=0.02)
        np.testing.assert_allclose(lane_.left[:, :2], wanted.left[:, :2] - middle, atol=0.25)
        assert lane_.id == numbers[number]
        assert lane_.is_intersection == wanted.is_intersection
        assert sorted(lane_.successors) == sorted(numbers[j] for j in wanted.successors)
        assert (lane_.left_type, lane_.right_type) == (LineType.DASHED, LineType.SOLID)
    assert (len(town.map.crossings), len(town.map.road_boundaries)) == (1, 1)
    assert len(prepare_roads(town, 1.8).spots(55.0)) > 10


def test_a_map_across_the_180th_meridian_is_the_same_elsewhere(tmp_path):
    def there(coordinates):
        if not isinstance(coordinates[0], list):
            return [(coordinates[0] - 10.0 + 360.0) % 360.0 - 180.0, coordinates[1]]  # 10 degrees east becomes 180
        return [there(one) for one in coordinates]

    plain, moved = crossroads_features(), crossroads_features()
    for feature in moved:
        feature["geometry"]["coordinates"] = there(feature["geometry"]["coordinates"])
    longitudes = np.concatenate([f["geometry"]["coordinates"] for f in moved if "lane" in f["properties"]])[:, 0]
    assert (longitudes.min(), longitudes.max()) == (pytest.approx(-180, abs=0.01), pytest.approx(180, abs=0.01))
    here, across = (read_lanes(write(tmp_path / "town.geojson", features)) for features in (plain, moved))
    for one, other in zip(here.map.segments.values(), across.map.segments.values(), strict=True):
        np.testing.assert_allclose(other.centerline, one.centerline, atol=1e-6)
    np.testing.assert_allclose(across.map.road_boundaries[0], here.map.road_boundaries[0], atol=1e-6)


@pytest.mark.parametrize("side", ["left", "right", None])
def test_a_map_of_one_way_streets_keeps_to_the_side_that_it_tells(tmp_path, side):
    told = {} if side is None else {"traffic": side}
    streets = [lane(i, (0, 20 * i), (200, 20 * i), **told) for i in range(11)]
    found = read_lanes(write(tmp_path / "town.geojson", streets)).map
    assert driving_side(found) == side
    assert driving_side(mirrored_map(found)) == {"left": "right", "right": "left", None: None}[side]
    assert drives_on_left(found) == (side == "left")
    (row,) = check_real_maps(tmp_path).rows
    assert row["traffic keeps"] == (side or "right, assumed")


def test_oncoming_lanes_say_more_than_what_a_map_tells(tmp_path):
    features = crossroads_features()
    for feature in features:
        feature["properties"] |= {"traffic": "left"} if "lane" in feature["properties"] else {}
    assert driving_side(read_lanes(write(tmp_path / "town.geojson", features)).map) == "right"


def test_a_successor_that_is_listed_twice_is_one(tmp_path):
    streets = [lane(i, (0, 20 * i), (200, 20 * i)) for i in range(11)]
    streets[0]["properties"]["successors"] = [2, 2, "2"]
    found = read_lanes(write(tmp_path / "town.geojson", streets)).map
    assert found.segments[0].successors == (2,)


def test_a_map_as_tables_are_exported(tmp_path):
    """Every geometry as Multi..., truth as 0 and 1, and what a feature does not have as null."""
    features = crossroads_features()
    plain = read_lanes(write(tmp_path / "town.geojson", features))
    columns = {key for one in features for key in one["properties"]}
    for one in features[:-1]:  # not the tree
        geometry, properties = one["geometry"], one["properties"]
        geometry |= {"type": f"Multi{geometry['type']}", "coordinates": [geometry["coordinates"]]}
        if "intersection" in properties:
            properties |= {"intersection": int(properties["intersection"]), "bicycle": 0}
        properties |= {name: 1 for name in ("boundary", "crossing") if name in properties}
        one["properties"] = dict.fromkeys(columns | {"successors"}) | properties
    nothing = dict.fromkeys(columns | {"successors"})
    features += [one | {"properties": nothing | {"name": "sidewalk"}} for one in features[:1]]
    found = read_lanes(write(tmp_path / "town.geojson", features))
    assert (len(found.map.crossings), len(found.map.road_boundaries)) == (1, 1)
    for lane_, wanted in zip(found.map.segments.values(), plain.map.segments.values(), strict=True):
        np.testing.assert_array_equal(lane_.left, wanted.left)
        assert (lane_.successors, lane_.is_intersection, lane_.vehicle) == (
            wanted.successors,
            wanted.is_intersection,
            True,
        )


def shaped(feature, kind, coordinates=None):
    """Return a feature with another type of geometry."""
    given = feature["geometry"]["coordinates"] if coordinates is None else coordinates
    return feature | {"geometry": {"type": kind, "coordinates": given}}


CORNERS = [(0, 0), (0, 5), (3, 5), (3, 2), (2, 0), (0, 0)]
ARM = [(0, 0), (80, 0)]


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ([], "holds no lane"),
        ([lane(1, *ARM), lane(1, *ARM)], "feature 1 has the lane id 1 of an earlier feature"),
        ([lane(None, *ARM)], "holds no lane"),
        ([lane(None, *ARM, successors=[])], "feature 0: lane is None, expected an id"),
        ([lane(True, *ARM)], "feature 0: lane is True, expected an id"),
        ([lane(1, *ARM, successors=[2])], "feature 0: successor 2 is no lane of this file"),
        ([lane(1, *ARM, successors=2)], "feature 0: successors is 2, expected a list"),
        ([lane(1, *ARM, width="wide")], "feature 0: width is 'wide', expected metres"),
        ([lane(1, *ARM, width=30)], "feature 0: width is 30, expected metres"),
        ([lane(1, *ARM, intersection="true")], "feature 0: intersection is 'true', expected true or false"),
        ([lane(1, *ARM, bicycle="yes")], "feature 0: bicycle is 'yes', expected true or false"),
        ([lane(1, *ARM, left=["solid"])], r"feature 0: left is \['solid'\], expected one of none"),
        ([shaped(lane(1), "MultiLineString", [place(*ARM), place(*ARM)])], "lane 1 is a MultiLineString of 2 lines"),
        ([shaped(lane(1), "Polygon", [place(*CORNERS)])], "lane 1 is a Polygon of 1 lines"),
        ([shaped(lane(1), "MultiPolygon", 7)], "feature 0: coordinates is of type int, expected a list"),
        (
            [
                {
                    "type": "Feature",
                    "properties": {"crossing": True},
                    "geometry": shaped(lane(1), "Polygon", [place(*CORNERS)])["geometry"],
                }
            ],
            "feature 0: a crossing is a Polygon of four corners",
        ),
        ([lane(1, *ARM) | {"properties": ["lane"]}], r"feature 0: properties is \['lane'\], expected a mapping"),
        ([lane(1, *ARM) | {"geometry": [1]}], r"feature 0: geometry is \[1\], expected a mapping"),
        ([lane(1, (0, 0), (4e6, 0))], "feature 0: points 0 and 1 are .* km apart"),
        ([lane(1, *ARM, traffic="west")], "feature 0: traffic is 'west', expected left or right"),
        ([lane(1, *ARM, traffic="left"), lane(2, *ARM, traffic="right")], "to the left on some lanes and to the right"),
        ([lane(1, *ARM, left="blue")], "feature 0: left is 'blue', expected one of none, solid, dashed"),
        ([lane(1, (0, 0), (0, 0))], "feature 0 is a lane without length"),
        ([lane(1, *ARM)], "too small a map: .*the most is 2 m"),
        ([lane(1, *ARM, bicycle=True), lane(2, (0, 90), (80, 90), bicycle=True)], "the most is 0 m"),
    ],
)
def test_what_is_wrong_with_a_geojson_map_is_told_with_the_feature(tmp_path, features, message):
    with pytest.raises(UserError, match=message):
        read_lanes(write(tmp_path / "town.geojson", features))

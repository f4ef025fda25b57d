"""Lanes as GeoJSON become a map, and what is wrong with a file is told."""

import json

import numpy as np
import pytest

from tests.world.small_map import crossroads
from tflane_jax.datasets.geojson_lanes import read_lanes
from tflane_jax.datasets.real_maps import check_real_maps
from tflane_jax.errors import UserError
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


@pytest.mark.parametrize("east", [-0.0003, 0.0003])
def test_a_map_across_the_180th_meridian_is_the_same_elsewhere(tmp_path, east):
    """Its middle lies on either side. Regression: on the western one, no map was read."""

    def there(coordinates):
        if not isinstance(coordinates[0], list):
            return [(coordinates[0] - 10.0 + east + 360.0) % 360.0 - 180.0, coordinates[1]]  # 10 degrees become 180
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
    for i, street in enumerate(streets):  # a column of numbers with an empty cell is one of floats
        street["properties"]["lane"] = float(i)
    assert read_lanes(write(tmp_path / "town.geojson", streets)).map.segments[0].successors == (2,)


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
        ([lane(1, *ARM), shaped(lane(2), "GeometryCollection", [])], "feature 1 is a GeometryCollection: give each of"),
        ([lane(1.5, *ARM)], "feature 0: lane is 1.5, expected an id"),
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

"""SD maps from GeoJSON: places on the ground, categories, and what is wrong with a file."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.geojson import Origin, RoadLines, read_geojson, sd_map_around, to_ego
from tflane_jax.errors import LeftOutWarning, UserError
from tflane_jax.scene import SdCategory
from tflane_jax.world.roads.sd_map import SdMapConfig


def earth(latitude, longitude):
    """Return WGS84 places (degrees) in Earth-centered metres."""
    f = 1 / 298.257223563
    e2, lat, lon = f * (2 - f), np.radians(latitude), np.radians(longitude)
    n = 6378137.0 / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.stack([n * np.cos(lat) * np.cos(lon), n * np.cos(lat) * np.sin(lon), n * (1 - e2) * np.sin(lat)], -1)


def east_north(latitude, longitude, origin):
    """Return exact local coordinates of places."""
    lat, lon = np.radians(origin.latitude), np.radians(origin.longitude)
    offset = earth(latitude, longitude) - earth(origin.latitude, origin.longitude)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    return np.stack([offset @ east, offset @ north], -1)


@settings(max_examples=60)
@given(
    st.floats(-60, 60),
    st.floats(-180, 180),
    st.floats(0, 2 * np.pi),
    st.sampled_from([(100.0, 3e-3), (1000.0, 0.3)]),
)
def test_projection_has_the_documented_accuracy(latitude, longitude, bearing, reach):
    distance, tolerance = reach
    origin = Origin(latitude, longitude)
    lat = latitude + np.degrees(distance * np.cos(bearing) / 6.37e6)
    lon = longitude + np.degrees(distance * np.sin(bearing) / (6.37e6 * np.cos(np.radians(latitude))))
    # As a file would have it on the other side of the 180th meridian.
    lon = (lon + 180) % 360 - 180
    x, y = to_ego(np.array([[lon, lat]]), origin)[0]
    np.testing.assert_allclose([-y, x], east_north(lat, lon, origin), atol=tolerance)


@pytest.mark.parametrize(("heading", "expected"), [(0, (10, 0)), (90, (0, 10)), (180, (-10, 0)), (270, (0, -10))])
def test_heading_turns_clockwise_from_north(heading, expected):
    """A place ten metres to the north."""
    place = np.array([[8.4, 49.0 + 10 / 111_200]])
    np.testing.assert_allclose(to_ego(place, Origin(49.0, 8.4, heading))[0], expected, atol=0.01)


def feature(coordinates, kind="LineString", **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


LINE = [[8.4, 49.0], [8.401, 49.0]]


def write(path, *features, **other):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)} | other))
    return path


@pytest.mark.parametrize(
    ("properties", "expected"),
    [
        # As osmnx and OpenStreetMap write roads that were joined.
        ({"highway": ["raceway", "residential", "service"]}, SdCategory.RESIDENTIAL),
        ({"highway": "trunk_link; primary"}, SdCategory.TRUCK_ROAD),
        ({"highway": ["raceway"]}, SdCategory.OTHER),
        # As SMERF sorts the roads.
        ({"highway": "motorway"}, SdCategory.TRUCK_ROAD),
        ({"highway": "tertiary_link"}, SdCategory.HIGHWAY),
        ({"highway": "road"}, SdCategory.ROAD),
        ({"highway": "unclassified"}, SdCategory.OTHER),
        # As a table is exported whose other rows have the column.
        ({"highway": "service", "category": None}, SdCategory.SERVICE),
        ({"highway": None, "category": "road"}, SdCategory.ROAD),
    ],
)
def test_several_values_and_null(tmp_path, properties, expected):
    path = write(tmp_path / "map.geojson", feature(LINE, **properties))
    assert read_geojson(path).category == (expected,)
    path.write_text(path.read_text(), encoding="utf-8-sig")  # as programs on Windows do
    assert read_geojson(path).category == (expected,)


def test_a_file_becomes_a_map_around_the_vehicle(tmp_path):
    path = write(
        tmp_path / "map.geojson",
        feature(LINE, highway="residential"),
        feature([8.4, 49.0], "Point", highway="crossing"),
        feature([[[8.4, 49.0], [8.4, 49.0001]], [[8.5, 49.0], [8.6, 49.0]]], "MultiLineString", category="side_walk"),
        feature([[8.4, 49.0, 110.0], [8.4, 48.9999, 110.0]], highway="motorway_link"),
        feature(LINE, highway="raceway"),
        {"type": "Feature", "geometry": None, "properties": None},
        crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
    )
    roads = read_geojson(path)
    walk = SdCategory.CROSSWALK
    expected = [SdCategory.RESIDENTIAL, walk, walk, SdCategory.TRUCK_ROAD, SdCategory.OTHER]
    assert list(roads.category) == expected
    sd_map = sd_map_around(roads, Origin(49.0, 8.4, 90.0), SdMapConfig(lines=6, points=3))
    sd_map.validate()
    # The second sidewalk lies kilometres away.
    assert sd_map.category[sd_map.valid].tolist() == [expected[i] for i in (0, 1, 3, 4)]
    np.testing.assert_allclose(sd_map.points[0], [[0, 0], [25.6, 0], [51.2, 0]], atol=1e-3)
    np.testing.assert_allclose(sd_map.points[1], [[0, 0], [0, 5.56], [0, 11.12]], atol=5e-3)
    with pytest.warns(TruncationWarning, match="SdMapConfig.lines = 3"):
        sd_map_around(roads, Origin(49.0, 8.4), SdMapConfig(lines=3))
    nothing = sd_map_around(RoadLines((), ()), Origin(0.0, 0.0), SdMapConfig(lines=2))
    assert not nothing.valid.any()


BAD = {
    "no list of points": (feature(7, highway="road"), "feature 1 is no line of at least two points"),
    "one point": (feature([[8.4, 49.0]], highway="road"), "feature 1 is no line of at least two points"),
    "text": (feature([[8.4, 49.0], ["a", "b"]], highway="road"), "feature 1 is no line of at least two points"),
    "no lines": (feature(None, "MultiLineString", highway="road"), "feature 1 is no line of at least two points"),
    "latitude first": (feature([[49.0, 8.4], [49.0, 98.4]], highway="road"), "longitude first"),
    "nan": (feature([[float("nan"), 8.4], [49.0, 8.4]], highway="road"), "feature 1 leaves the Earth"),
    "unknown category": (feature(LINE, category="raod"), "'raod': choose one of road, cross_walk"),
    "category of a list": (feature(LINE, category=["road"]), r"the category \['road'\]: choose one of road"),
    "geometry of a list": (feature(LINE, ["LineString"]), r"feature 1 has a geometry of type \['LineString'\]"),
    "number of hundreds of digits": (
        feature([[10**400, 1], [1, 1]], highway="road"),
        "feature 1 is no line of at least two points",
    ),
    "no feature": ({"type": "Way"}, "feature 1 is no GeoJSON Feature"),
    "a list": ([], "feature 1 is no GeoJSON Feature"),
    "geometry": (feature(LINE, "Line", highway="road"), "feature 1 has a geometry of type 'Line'"),
    "collection": (feature(LINE, "GeometryCollection", highway="road"), "feature 1 is a road as GeometryCollection"),
    "named": (feature(7, highway="road") | {"id": "way/12"}, r"feature 1 \(way/12\) is no line"),
}


@pytest.mark.parametrize(
    "other",
    [
        feature(LINE, waterway="river"),
        feature(LINE, highway=None, category=None),
        feature(LINE) | {"properties": None},
        feature([[8.4, 49.0]], power="line"),
    ],
)
def test_lines_that_are_no_roads_are_left_out_with_a_warning(other, tmp_path):
    """Exports of a region contain rivers, buildings and power lines."""
    path = write(tmp_path / "map.geojson", other | {"id": "way/12"}, feature(LINE, highway="road"), other)
    with pytest.warns(LeftOutWarning, match=r"2 of 3 lines have neither .*: feature 0 \(way/12\)"):
        roads = read_geojson(path)
    assert roads.category == (SdCategory.ROAD,)
    with pytest.raises(UserError, match=r"feature 0 has neither of the properties `highway` and `category`, and no"):
        read_geojson(write(path, other))


def test_a_map_of_another_place_is_refused(tmp_path):
    roads = read_geojson(write(tmp_path / "map.geojson", feature(LINE, highway="road")))
    with pytest.raises(UserError, match=r"the nearest road is about \d,\d\d\d km .*longitude and latitude swapped\?"):
        sd_map_around(roads, Origin(latitude=8.4, longitude=49.0), SdMapConfig())
    # A vehicle that has left the map has no lines.
    assert not sd_map_around(roads, Origin(49.2, 8.4), SdMapConfig()).valid.any()


@pytest.mark.parametrize("name", BAD)
def test_a_bad_feature_is_named_with_its_remedy(name, tmp_path):
    bad, message = BAD[name]
    path = write(tmp_path / "map.geojson", feature(LINE, highway="road"), bad)
    with pytest.raises(UserError, match=message) as raised:
        read_geojson(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is no JSON"),
        ("[" * 100_000, "nested too deep"),
        ("[]", "is no GeoJSON FeatureCollection"),
        ('{"type": "Feature"}', "is no GeoJSON FeatureCollection"),
        ('{"type": "FeatureCollection", "features": {}}', "is no GeoJSON FeatureCollection"),
        ('{"type": "FeatureCollection", "features": [], "crs": {"name": "EPSG:25832"}}', "convert it to EPSG:4326"),
        (b"\xff\xfe", "is no JSON"),
        (None, "cannot read"),
    ],
)
def test_a_bad_file_is_named(content, message, tmp_path):
    path = tmp_path / "map.geojson"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError, match=message) as raised:
        read_geojson(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("pose", [(90.1, 0.0), (0.0, 180.1), (float("nan"), 0.0), (0.0, 0.0, float("nan"))])
def test_a_pose_that_is_not_on_earth_is_refused(pose):
    with pytest.raises(UserError, match="is no pose on Earth"):
        Origin(*pose)

"""The map expansion of nuScenes: hand-made lanes, lines and areas, and damage named with layer and token."""

import json

import numpy as np
import pytest

from tests.datasets.nuscenes_small import city, empty_city, straight
from tflane_jax.datasets.nuscenes_map import read_expansion
from tflane_jax.errors import UserError
from tflane_jax.scene import LineType

pytest.importorskip("shapely")
PATH = np.array([[400.0, 1100.0], [400.0, 1115.0]])


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "singapore-onenorth.json"
    path.write_text(json.dumps(city()))
    return path


def read(path, content):
    path.write_text(json.dumps(content))
    return read_expansion(path)


def test_lanes_with_and_without_outline(file):
    found = read_expansion(file)
    assert found.location == "singapore-onenorth"
    assert found.without_line == ("without",)
    (north, first), (turn, second) = found.lanes.items()
    assert (first.token, second.token) == ("north", "turn")
    assert (first.connector, second.connector) == (False, True)
    assert second.polygon is None
    # The connection stands only in the connector's own record; lanes that the file lacks are left out.
    assert (first.successors, second.successors) == ((turn,), ())
    # Two paths of 25 and 15 m at half a metre share a joint.
    np.testing.assert_allclose(first.centerline, np.column_stack([[400.0] * 81, np.linspace(1090, 1130, 81)]))
    np.testing.assert_allclose(second.centerline[-1], [386.0, 1140.0], atol=1e-3)

    segments = found.around(PATH, 50.0).segments
    assert set(segments) == {north, turn}
    lane, connector = segments[north], segments[turn]
    assert lane.centerline.shape == (81, 3)
    np.testing.assert_allclose(lane.left[:, 0], 398.25)
    np.testing.assert_allclose(lane.right[:, 0], 401.75)
    # Most of the left markings are dashed; connectors have none.
    assert (lane.left_type, lane.right_type) == (LineType.DASHED, LineType.SOLID)
    assert (connector.left_type, connector.right_type, connector.is_intersection) == (0, 0, True)
    # The connector is as wide as the lane before it, on a circle of 10 m around (390, 1130), then straight.
    arc = connector.left[:, :2][connector.centerline[:, 0] > 390.1]
    np.testing.assert_allclose(np.linalg.norm(arc - (390.0, 1130.0), axis=-1), 10.0 - 1.75, atol=2e-3)
    np.testing.assert_allclose(connector.right[-1], [386.0, 1141.75, 0.0], atol=2e-3)


def test_the_polygon_of_a_connector_is_no_outline(file):
    """It is a box around the line: a diagonal one of 10 m would be 10 m wide in the middle."""
    content = city()
    corners = [(400.0, 1130.0), (407.0, 1130.0), (407.0, 1137.0), (400.0, 1137.0)]
    content["node"] += [{"token": f"box{i}", "x": x, "y": y} for i, (x, y) in enumerate(corners)]
    content["polygon"].append({"token": "box", "exterior_node_tokens": [f"box{i}" for i in range(4)], "holes": []})
    content["lane_connector"] = [{"token": "turn", "polygon_token": "box"}]
    content["arcline_path_3"]["turn"] = [straight([400.0, 1130.0, np.pi / 4], 7.0 * np.sqrt(2.0))]
    for polygon in ("box", None):
        content["lane_connector"][0]["polygon_token"] = polygon
        (connector,) = (one for one in read(file, content).around(PATH, 50.0).segments.values() if one.is_intersection)
        width = np.linalg.norm(connector.left - connector.right, axis=-1)
        np.testing.assert_allclose(width, 3.5, atol=1e-9)


def test_lines_and_areas(file):
    found = read_expansion(file).around(PATH, 50.0)
    middle, between = found.dividers  # the empty divider is left out
    np.testing.assert_array_equal(middle, [(405.25, 1090, 0), (405.25, 1130, 0)])
    np.testing.assert_array_equal(between[:, 1], [1090, 1110, 1130])
    (crossing,) = found.crossings  # the one without a polygon is left out
    np.testing.assert_array_equal(crossing[0], crossing[-1])
    assert set(crossing[:, 0]) == {398.0, 406.0}
    # Two lanes and the road segment after them are one road with a hole; exteriors run clockwise, interiors do not.
    outer, hole = found.road_boundaries
    assert signed_area(outer) == pytest.approx(-(7 * 40 + 40 * 20))
    assert signed_area(hole) == pytest.approx(0.5 * 4 * 4)


def signed_area(ring):
    x, y = ring[:, 0], ring[:, 1]
    return 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum()


def test_only_what_is_near_is_taken(file):
    expansion = read_expansion(file)
    near = expansion.around(np.array([[400.0, 1085.0]]), 10.0)
    assert [lane.is_intersection for lane in near.segments.values()] == [False]
    assert len(near.dividers) == 2
    assert near.crossings == ()
    assert near.road_boundaries[0][:, 1].max() == 1130.0
    nothing = expansion.around(np.array([[0.0, 0.0]]), 10.0)
    assert (nothing.segments, nothing.crossings, nothing.road_boundaries, nothing.dividers) == ({}, (), (), ())
    # Ids are those of the city, so that two scenes agree on them.
    assert set(near.segments) < set(expansion.around(PATH, 50.0).segments)


def test_an_empty_map(file):
    found = read(file, empty_city()).around(PATH, 50.0)
    assert (found.segments, found.crossings, found.road_boundaries, found.dividers) == ({}, (), (), ())


def test_polygons_that_cross_themselves_are_no_road(file):
    content = city()
    content["polygon"][2]["exterior_node_tokens"][:2] = content["polygon"][2]["exterior_node_tokens"][1::-1]
    (outer,) = read(file, content).around(PATH, 50.0).road_boundaries
    assert signed_area(outer) == pytest.approx(-7 * 40)
    content["polygon"][3]["exterior_node_tokens"][:2] = content["polygon"][3]["exterior_node_tokens"][1::-1]
    assert read(file, content).around(PATH, 50.0).crossings == ()


def edit(*keys, value):
    """Return damage that sets an entry, or removes it if the value is `...`."""

    def damage(content):
        for key in keys[:-1]:
            content = content[key]
        if value is ...:
            del content[keys[-1]]
        else:
            content[keys[-1]] = value

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (edit("version", value="1.2"), "is version '1.2', which has no arclines: download version 1.3"),
        (edit("version", value=...), "names no version, as the first ones do, .*: download version 1.3"),
        (edit("version", value="1." + 5000 * "3"), "is version '1.3+, which has no arclines: download version 1.3"),
        *(
            (edit(layer, value=...), f"lacks the entry '{layer}'")
            for layer in city()
            if layer not in ("version", "canvas_edge")
        ),
        (edit("node", 3, "x", value=float("nan")), r"node holds nan at \[3, 0\]"),
        (edit("node", 3, "y", value=4e7), "polygon polygon-0: points 2 and 3 are 39998.9 km apart"),
        (edit("node", 3, "y", value="1130.0"), "node is of type list, expected numbers"),
        (edit("node", 3, "y", value="far"), "node is of type list, expected numbers"),
        (edit("node", 3, "y", value=...), "node n3 lacks the entry 'y'"),
        (edit("node", 3, "token", value="n2"), "node: the token 'n2' is no text, or two rows have it"),
        (edit("node", 3, "token", value="other"), "polygon polygon-0: the node 'n3' is not in the file"),
        (edit("lane", 0, "polygon_token", value="gone"), "lane north: the polygon 'gone' is not in the file"),
        (edit("lane", 0, "polygon_token", value=...), "lane north lacks the entry 'polygon_token'"),
        (
            edit("lane_divider", 0, "line_token", value="gone"),
            "lane_divider between: the line 'gone' is not in",
        ),
        (edit("road_divider", 0, "line_token", value=None), "road_divider middle: the line None is not in the file"),
        (edit("ped_crossing", 0, "polygon_token", value=3), "ped_crossing zebra: the polygon 3 is not in the file"),
        (edit("lane_connector", 0, "token", value="north"), "north is both a lane and a lane_connector"),
        (edit("lane", 0, "left_lane_divider_segments", 0, "segment_type", value=3), "segment_type is 3, expected text"),
        (edit("arcline_path_3", value=[]), "arcline_path_3 is of type list, expected a mapping from lanes"),
        (edit("arcline_path_3", "north", 0, "shape", value="LLL"), r"arcline_path_3 north\[0\]\.shape is 'LLL'"),
        (edit("connectivity", "turn", "incoming", value=...), "connectivity turn lacks the entry 'incoming'"),
        (edit("connectivity", "turn", "incoming", value=[{}]), "connectivity turn: {} is no token of a lane"),
        (edit("connectivity", "turn", "incoming", value="north"), "incoming is of type str, expected a list"),
        (edit("polygon", 0, "exterior_node_tokens", value=None), r"polygon polygon-0: exterior_node_tokens is missing"),
        (edit("line", 0, "node_tokens", value=...), "line line-0 lacks the entry 'node_tokens'"),
    ],
)
def test_damage_is_named_with_layer_and_token(file, damage, message):
    content = city()
    damage(content)
    with pytest.raises(UserError, match=message) as error:
        read(file, content)
    assert str(file) in str(error.value)


def test_a_missing_map_is_named(tmp_path):
    with pytest.raises(UserError, match=r"download nuScenes' map expansion, version 1\.3"):
        read_expansion(tmp_path / "boston-seaport.json")


def test_a_lane_is_not_its_own_successor(file):
    content = city()
    content["connectivity"]["north"]["outgoing"] = ["north", "turn"]
    assert [lane.successors for lane in read(file, content).lanes.values()] == [(1,), ()]


def test_a_lane_of_one_point_is_no_lane(file):
    content = city()
    content["arcline_path_3"]["without"] = [straight([401.75, 1090.0, 0.0], 0.0)]
    assert read(file, content).without_line == ("without",)

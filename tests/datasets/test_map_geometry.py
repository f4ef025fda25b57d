"""MapTR's rules for lines in a patch, on maps drawn by hand."""

import numpy as np
import pytest

from tflane_jax.datasets.map_geometry import (
    BOUNDARY_MARGIN,
    SIMPLIFIED,
    MapGeometry,
    cut_polygon,
    join_ends,
    lane_paths,
    merge_polygons,
)
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, invert_pose, yaw_pose
from tflane_jax.scene import LineClass

PATCH = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))


def line(*points, z=0.0):
    return np.array([(*point, z) for point in points], float)


def box(x0, x1, y0, y1, z=0.0):
    return line((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0), z=z)


def cut(geometry, category, pose=None, patch=PATCH, centerlines=True):
    pieces = geometry.cut(np.eye(4) if pose is None else pose, patch, centerlines=centerlines)
    return [piece for piece in pieces if piece.category == category]


def area(ring):
    x, y = ring[:, 0], ring[:, 1]
    return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def test_every_divider_is_cut_on_its_own():
    # The second one continues the first; the third leaves the patch and comes back.
    lines = [
        line((-40, 0), (0, 0)),
        line((0, 0), (10, 0)),
        line((-10, 5), (-10, 20), (10, 20), (10, 5)),
        line((40, 0), (50, 0)),
    ]
    pieces = cut(MapGeometry.of(dividers=lines), LineClass.DIVIDER)
    assert [(p.number, p.points[0, :2].tolist(), p.points[-1, :2].tolist()) for p in pieces] == [
        (0, [-30, 0], [0, 0]),
        (1, [0, 0], [10, 0]),
        (2, [-10, 5], [-10, 15]),
        (2, [10, 15], [10, 5]),
    ]
    assert not any(p.closed for p in pieces)


def test_the_patch_turns_with_the_vehicle():
    pose = yaw_pose(np.float64(600.0), np.float64(1500.0), np.float64(np.pi / 2))
    geometry = MapGeometry.of(dividers=[line((600, 1400), (600, 1600)), line((580, 1500), (620, 1500))])
    along, across = cut(geometry, LineClass.DIVIDER, invert_pose(pose))
    np.testing.assert_allclose(along.points[:, :2], [[-30, 0], [30, 0]], atol=1e-9)
    np.testing.assert_allclose(across.points[:, :2], [[0, 15], [0, -15]], atol=1e-9)


def test_crossings_that_touch_are_merged_and_others_are_not():
    crossings = [[box(0, 4, -6, 0)], [box(4, 8, -6, 0, z=1.0)], [box(9, 12, -6, 0)]]
    pieces = cut(MapGeometry.of(crossings=crossings), LineClass.CROSSING)
    assert sorted(abs(area(p.points)) for p in pieces) == pytest.approx([18.0, 48.0])
    assert all(p.closed for p in pieces)
    assert len({p.number for p in pieces}) == 2
    merged = max(pieces, key=lambda p: abs(area(p.points))).points
    assert area(merged) < 0  # exteriors run clockwise
    assert merged[merged[:, 0] > 4.0, 2].tolist() == [1.0] * (merged[:, 0] > 4.0).sum()


ISLAND = line((2, 1), (9, 1), (9, 3), (5, 6), (2, 1))
HOUSE = line((2, 1), (9, 1), (9, 6), (5, 9), (2, 6), (2, 1))


@pytest.mark.parametrize("steps", [0, 1, 3])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("elements", "category"),
    [
        ({"crossings": [[HOUSE]]}, LineClass.CROSSING),  # whole
        ({"crossings": [[HOUSE + np.array([25, 0, 0])]]}, LineClass.CROSSING),  # cut
        ({"crossings": [[HOUSE], [HOUSE + np.array([7, 0, 0])]]}, LineClass.CROSSING),  # merged
        ({"roads": [[box(-20, 20, -9, 14), ISLAND]]}, LineClass.BOUNDARY),
    ],
)
def test_neither_the_start_nor_the_direction_of_a_source_ring_matters(elements, category, turned, steps):
    def changed(ring):
        corners = np.roll(ring[:-1], steps, 0)
        ring = np.concatenate([corners, corners[:1]])
        return ring[::-1] if turned else ring

    ((name, polygons),) = elements.items()
    other = {name: [[changed(ring) for ring in polygon] for polygon in polygons]}
    expected, found = (cut(MapGeometry.of(**each), category) for each in (elements, other))
    expected, found = (sorted(pieces, key=lambda p: p.points[0].tolist()) for pieces in (expected, found))
    assert len(expected) == len(found) == len(polygons[0]) > 0
    for one, two in zip(expected, found, strict=True):
        assert one.closed
        np.testing.assert_allclose(two.points, one.points, atol=1e-9)
    # The outer rings run clockwise, the island the other way.
    assert [area(p.points) < 0 for p in found].count(False) == len(polygons[0]) - 1


def test_the_start_of_a_whole_boundary_does_not_matter():
    corners = np.roll(ISLAND[:-1], 1, 0)
    rings = ISLAND, np.concatenate([corners, corners[:1]])
    (one,), (two,) = (cut(MapGeometry.of(boundaries=[ring]), LineClass.BOUNDARY) for ring in rings)
    np.testing.assert_allclose(one.points, two.points)


def test_a_crossing_is_closed_along_the_border_that_cuts_it():
    (piece,) = cut(MapGeometry.of(crossings=[[box(28, 34, -20, 4)]]), LineClass.CROSSING)
    assert piece.closed
    assert abs(area(piece.points)) == pytest.approx(2 * 19)
    assert piece.points[:, 0].max() == 30.0


def test_a_ring_of_crossings_has_two_lines_and_a_cut_one_falls_apart():
    around = [[box(-9, 9, 6, 9)], [box(-9, 9, -9, -6)], [box(-9, -6, -9, 9)], [box(6, 9, -9, 9)]]
    geometry = MapGeometry.of(crossings=around)
    whole = cut(geometry, LineClass.CROSSING)
    assert sorted(area(p.points) for p in whole) == pytest.approx([-(18.0**2), 12.0**2])
    assert {p.number for p in whole} == {0}
    # A patch that ends inside the hole sees a U; one that is narrower than the hole sees two strips.
    half = cut(geometry, LineClass.CROSSING, patch=PerceptionRange((-30, 0), (-15, 15)))
    assert [abs(area(p.points)) for p in half] == pytest.approx([9 * 18 - 6 * 12])
    strips = cut(geometry, LineClass.CROSSING, patch=PerceptionRange((-30, 30), (-5, 5)))
    assert [abs(area(p.points)) for p in strips] == pytest.approx([30.0, 30.0])


def test_a_polygon_that_holds_the_whole_patch_is_its_border_and_one_outside_is_nothing():
    (ring,) = cut_polygon([box(-99, 99, -99, 99)], PATCH)
    assert abs(area(ring)) == pytest.approx(60 * 30)
    assert cut_polygon([box(31, 40, -5, 5)], PATCH) == []
    assert cut_polygon([box(30, 40, -5, 5)], PATCH) == []  # touches the border


def test_the_border_of_the_patch_is_never_a_boundary():
    # One road across the patch: only its two kerbs are boundaries, not where the patch ends.
    pieces = cut(MapGeometry.of(roads=[[box(-100, 0, -5, 5)], [box(-1, 100, -5, 5)]]), LineClass.BOUNDARY)
    assert len(pieces) == 2
    assert sorted(p.points[0, 1] for p in pieces) == [-5, 5]
    for piece in pieces:
        np.testing.assert_allclose(sorted(piece.points[[0, -1], 0]), [-30 + BOUNDARY_MARGIN, 30 - BOUNDARY_MARGIN])
    # A road as wide as the patch, and one that covers it, have none.
    assert not cut(MapGeometry.of(roads=[[box(-100, 100, -15, 15)]]), LineClass.BOUNDARY)
    assert not cut(MapGeometry.of(roads=[[box(-100, 100, -99, 99)]]), LineClass.BOUNDARY)


def test_an_island_inside_the_patch_is_a_ring():
    road = [box(-100, 100, -10, 10), box(-5, 5, -1, 1)]
    pieces = cut(MapGeometry.of(roads=[road]), LineClass.BOUNDARY)
    (island,) = (p for p in pieces if p.closed)
    assert abs(area(island.points)) == pytest.approx(20.0)
    assert len(pieces) == 3


def test_centerlines_are_all_paths_from_root_to_leaf():
    #        2 - 4
    # 0 - 1 <
    #        3
    lanes = {
        0: line((-50, 0), (-10, 0)),
        1: line((-10, 0), (0, 0)),
        2: line((0, 0), (10, 10)),
        3: line((0, 0), (10, -10)),
        4: line((10, 10), (10, 40)),
    }
    edges = np.array([[0, 1], [1, 2], [1, 3], [2, 4], [4, 9]])
    geometry = MapGeometry.of(centerlines=[lanes[i] for i in range(5)], edges=edges)
    up, down = (p.points[:, :2].tolist() for p in cut(geometry, LineClass.CENTERLINE))
    assert up == [[-30, 0], [0, 0], [10, 10], [10, 15]]
    assert down == [[-30, 0], [0, 0], [10, -10]]
    assert not cut(geometry, LineClass.CENTERLINE, centerlines=False)


def test_lanes_that_join_outside_the_patch_are_not_one_line():
    lanes = {0: line((0, 0), (0, 40)), 1: line((0, 40), (20, 40), (20, 0))}
    paths = lane_paths(lanes, [(0, 1)], PATCH)
    assert [path[:, :2].tolist() for path in paths] == [[[0, 0], [0, 15]], [[20, 15], [20, 0]]]


def test_a_cycle_of_lanes_ends_and_gives_paths_only_from_its_entries():
    ring = {
        0: line((5, 0), (0, 5), (-5, 0)),
        1: line((-5, 0), (0, -5), (5, 0)),
        2: line((20, 0), (5, 0)),  # entry
        3: line((-5, 0), (-20, 0)),  # exit
    }
    circle = [(0, 1), (1, 0)]
    assert lane_paths({n: ring[n] for n in (0, 1)}, circle, PATCH) == []
    (path,) = lane_paths(ring, [*circle, (2, 0), (0, 3)], PATCH)
    assert path[:, :2].tolist() == [[20, 0], [5, 0], [0, 5], [-5, 0], [-20, 0]]


def test_lanes_of_a_damaged_map_have_no_end_of_paths():
    """Two lanes that both lead to both of the next two, 14 times: 2^14 paths; nine lanes that all follow each other."""
    doubled = {2 * i + k: line((i, 0), (i + 0.5, k), (i + 1, 0)) for i in range(14) for k in (0, 1)}
    merging = [(2 * i + a, 2 * i + 2 + b) for i in range(13) for a in (0, 1) for b in (0, 1)]
    few = {number: lane for number, lane in doubled.items() if number < 10}
    assert len(lane_paths(few, [edge for edge in merging if max(edge) < 10], PATCH)) == 2**5
    knot = {number: line((number, 0), (number + 1, 0)) for number in range(10)}
    tied = [(a, b) for a in range(10) for b in range(1, 10) if a != b]
    for lanes, edges in ((doubled, merging), (knot, tied)):
        with pytest.raises(UserError, match="fork and merge to more than 10000 paths: restore the map"):
            lane_paths(lanes, edges, PATCH)


def test_centerlines_are_simplified_within_their_tolerance():
    x = np.linspace(-20.0, 20.0, 401)
    curve = np.column_stack([x, 10.0 * np.cos(x / 10.0), np.zeros_like(x)])
    (path,) = lane_paths({0: curve}, [], PATCH)
    assert len(path) < 20
    assert np.abs(np.interp(x, path[:, 0], path[:, 1]) - curve[:, 1]).max() < 1.5 * SIMPLIFIED
    # A turn beyond the end is far from the line between the ends, not from its extension.
    (back,) = lane_paths({0: line((0, 0), (10, 0.1), (5, 0))}, [], PATCH)
    assert back[:, 0].tolist() == [0, 10, 5]


def test_lines_are_joined_where_exactly_two_ends_meet():
    a, b, c = line((0, 0), (1, 0), z=2.0), line((3, 0), (2, 0), (1, 0.05)), line((9, 9), (9, 8))
    joined, alone = join_ends([a, b, c])
    assert joined[:, 0].tolist() == [0, 1, 2, 3]
    assert joined[0, 2] == 2.0
    np.testing.assert_array_equal(alone, c)
    fork = [line((0, 0), (1, 0)), line((1, 0), (2, 1)), line((1, 0), (2, -1))]
    assert len(join_ends(fork)) == 3
    assert join_ends([]) == []


def test_lines_that_come_back_are_a_ring():
    (ring,) = join_ends([line((0, 0), (4, 0)), line((4, 3), (0, 0.02)), line((4, 0), (4, 3))])
    np.testing.assert_array_equal(ring[0], ring[-1])
    assert len(ring) == 4
    (island,) = join_ends([box(0, 1, 0, 1)])
    np.testing.assert_array_equal(island, box(0, 1, 0, 1))


def test_nothing_is_merged_without_polygons_that_meet():
    assert merge_polygons([]) == []
    alone = [box(0, 1, 0, 1, z=3.0)]
    (polygon,) = merge_polygons([alone])
    np.testing.assert_array_equal(polygon[0], alone[0][::-1])  # clockwise

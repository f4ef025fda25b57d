"""Cutting maps at the perception range, on maps drawn by hand."""

import gc

import numpy as np
import pytest
import shapely

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.datasets import prepared_map
from tflane_jax.datasets.areas import crop_areas, crossing_sides
from tflane_jax.datasets.ground_truth import lane_graph, traffic_elements
from tflane_jax.datasets.map_geometry import BOUNDARY_MARGIN, clip_ring
from tflane_jax.datasets.prepared_map import prepare_map
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, invert_pose, yaw_pose
from tflane_jax.scene import AreaType, LineType
from tflane_jax.scene.logs import LaneSegment, MapElement

RANGE = PerceptionRange()
NO_BOXES, NO_BUILDINGS = np.zeros((0, 7)), np.zeros((0, 5))


def crop(vector_map, *, flavour="centerlines", pose=None, capacity=8, points=11, buildings=NO_BUILDINGS):
    prepared = prepare_map(vector_map, bike_lanes=True)
    return lane_graph(
        getattr(prepared, flavour),
        np.eye(4) if pose is None else pose,
        RANGE,
        capacity=capacity,
        points=points,
        boxes=NO_BOXES,
        buildings=buildings,
    )


def test_a_lane_is_cut_at_the_border_and_keeps_its_labels():
    result = crop(lane_map(segment(7, [(-90.0, 2.0), (90.0, 2.0)], is_intersection=True)))
    graph = result.graph
    graph.validate()
    assert graph.valid.tolist() == [True] + [False] * 7
    np.testing.assert_allclose(graph.points[0, :, 0], np.linspace(-50, 50, 11), atol=1e-5)
    np.testing.assert_allclose(graph.left[0, :, 1], 3.75)
    np.testing.assert_allclose(graph.right[0, :, 1], 0.25)
    assert graph.is_connector[0]
    assert (graph.left_type[0], graph.right_type[0]) == (LineType.DASHED, LineType.SOLID)
    assert graph.visibility[0] == 1.0
    assert result.dropped == 0


def test_pose_moves_the_map_into_the_ego_frame():
    pose = yaw_pose(np.float64(5000.0), np.float64(-700.0), np.float64(np.pi / 2))
    graph = crop(lane_map(segment(0, [(5000.0, -700.0), (5000.0, -680.0)])), pose=invert_pose(pose)).graph
    np.testing.assert_allclose(graph.points[0, -1], [20.0, 0.0, 0.0], atol=1e-4)


def test_a_boundary_that_is_outside_keeps_the_stretch_beside_the_centerline():
    graph = crop(lane_map(segment(0, [(0.0, 24.0), (40.0, 24.0), (40.0, 60.0)], width=10.0))).graph
    np.testing.assert_allclose(graph.left[0, 0, :2], [0.0, 29.0], atol=1e-5)
    assert graph.left[0, :, 1].min() > 25.0
    # The centerline ends at 41 of 76 m of its length, and so does the stretch of the boundary, which is shorter.
    along = np.linalg.norm(np.diff(graph.left[0, :, :2], axis=0), axis=-1).sum()
    whole = shapely.LineString([(0, 29), (40 - np.sqrt(12.5), 24 + np.sqrt(12.5)), (35, 60)]).length
    assert along == pytest.approx(whole * 41 / 76, abs=1.0)


def test_a_boundary_that_is_inside_elsewhere_keeps_the_stretch_beside_the_centerline():
    """Regression: a lane that turns round outside of the range got the side of its way back."""
    way = [(0.0, 24.5), (-4.0, 24.8), (-8.0, 30.0), (-8.0, 36.0), (0.0, 36.0), (10.0, 26.2), (40.0, 26.2)]
    graph = crop(lane_map(segment(0, way)), flavour="segments").graph
    assert graph.valid.sum() == 1
    np.testing.assert_allclose(graph.points[0, 0, :2], [0.0, 24.5], atol=1e-5)
    assert graph.right[0, :, 0].max() < 3.0
    assert graph.right[0, :, 1].min() > 25.0


@pytest.mark.parametrize("shift", [0.0, 0.3, -0.3])
def test_a_lane_that_turns_back_has_the_side_that_runs_its_way(shift):
    """Regression: the boundary between the legs was taken for that of the first one; the second one's was cut short.

    The boundary lies between the legs, or a little nearer to one of them.
    """
    x, angle = np.arange(61.0), np.linspace(-np.pi / 2, np.pi / 2, 15)[1:-1]

    def there_and_back(y):
        """Return the line at `y` to the right of the legs' middle, round a half circle and back to its left."""
        turn_x, turn_y = 60.0 + y * np.cos(angle), y * np.sin(angle)
        across = np.concatenate([np.full(61, -y), turn_y, np.full(61, y)])
        return np.stack([np.concatenate([x, turn_x, x[::-1]]), across, np.zeros(len(across))], -1)

    left = there_and_back(0.0) + np.array([0.0, shift, 0.0])
    lane = LaneSegment(0, there_and_back(1.75), left, there_and_back(3.5), LineType.SOLID, LineType.DASHED, False, ())
    graph = crop(lane_map(lane), flavour="segments").graph
    assert graph.valid.sum() == 2
    for row, way in enumerate(([0.0, 50.0], [50.0, 0.0])):
        for name in ("points", "left", "right"):
            np.testing.assert_allclose(getattr(graph, name)[row, [0, -1], 0], way, atol=1e-4)


def test_a_lane_cut_in_two_joins_its_neighbours_only_at_its_own_ends():
    # Leaves the range to the left and comes back.
    loop = segment(1, [(-20.0, 0.0), (-20.0, 60.0), (20.0, 60.0), (20.0, 0.0)], [2, 3])
    before = segment(0, [(-40.0, 0.0), (-20.0, 0.0)], [1, 4])
    after, other, fork = (
        segment(n, line)
        for n, line in (
            (2, [(20.0, 0.0), (40.0, 0.0)]),
            (3, [(20.0, 0.0), (40.0, 9.0)]),
            (4, [(-20.0, 0.0), (0.0, 0.0)]),
        )
    )
    result = crop(lane_map(before, loop, after, other, fork), flavour="segments")
    assert result.lane.tolist() == [0, 1, 1, 2, 3, 4]
    edges = np.argwhere(result.graph.successor).tolist()
    assert edges == [[0, 1], [0, 5], [2, 3], [2, 4]]


def test_a_joint_outside_the_range_is_no_edge():
    first = segment(0, [(0.0, 0.0), (0.0, 40.0)], [1])
    second = segment(1, [(0.0, 40.0), (20.0, 40.0), (20.0, 0.0)])
    assert not crop(lane_map(first, second), flavour="segments").graph.successor.any()


def test_overflow_drops_the_farthest_and_counts():
    lanes = [segment(i, [(x, 0.0), (x + 5.0, 0.0)]) for i, x in enumerate((40.0, 0.0, 20.0))]
    result = crop(lane_map(*lanes), capacity=2)
    assert result.lane.tolist() == [1, 2]
    assert result.dropped == 1


def test_distances_are_to_lines_and_not_to_their_vertices():
    """A straight road past the vehicle has only far ends; a road beside it has a vertex every 5 m."""
    past, beside = [(-60.0, 0.0), (60.0, 0.0)], [(x, 20.0) for x in np.arange(-60.0, 61.0, 5.0)]
    result = crop(lane_map(segment(0, past), segment(1, beside)), capacity=1)
    np.testing.assert_allclose(result.graph.points[0, :, 1], 0.0)
    edges = [np.column_stack([np.array(line), np.zeros(len(line))]) for line in (past, beside)]
    areas, _ = areas_of(boundaries=edges, capacity=1)
    np.testing.assert_allclose(areas.points[0, :, 1], 0.0)


def test_nothing_in_range_and_no_map_at_all():
    for vector_map in (lane_map(), lane_map(segment(0, [(90.0, 0.0), (120.0, 0.0)]))):
        result = crop(vector_map)
        assert not result.graph.valid.any()
        assert not result.graph.successor.any()


def test_visibility_is_the_unoccluded_fraction():
    wall = np.array([[10.0, 0.0, 2.0, 100.0, 0.0]])
    graph = crop(lane_map(segment(0, [(0.0, 0.0), (36.0, 0.0)])), buildings=wall).graph
    # All from the wall's near face at 9 m on is hidden: a quarter is seen.
    assert graph.visibility[0] == pytest.approx(0.25, abs=0.011)


def test_bike_lanes_are_left_out_before_chains_are_merged():
    bike = segment(1, [(10.0, 0.0), (20.0, 5.0)], vehicle=False)
    vector_map = lane_map(segment(0, [(0.0, 0.0), (10.0, 0.0)], [1, 2]), bike, segment(2, [(10.0, 0.0), (20.0, 0.0)]))
    assert len(prepare_map(vector_map, bike_lanes=True).centerlines.lanes) == 3
    assert len(prepare_map(vector_map, bike_lanes=False).segments.lanes) == 2


def test_a_map_is_prepared_once_and_forgotten_with_it():
    vector_map = lane_map(segment(0, [(0.0, 0.0), (1.0, 0.0)]))
    first = prepare_map(vector_map, bike_lanes=True)
    assert prepare_map(vector_map, bike_lanes=True) is first
    key = (id(vector_map), True)
    assert key in prepared_map._PREPARED._kept
    del vector_map
    gc.collect()
    assert key not in prepared_map._PREPARED._kept


def areas_of(*, crossings=(), boundaries=(), capacity=6, form="ring"):
    vector_map = lane_map(crossings=crossings, road_boundaries=boundaries)
    prepared = prepare_map(vector_map, bike_lanes=True)
    return crop_areas(prepared, np.eye(4), RANGE, capacity=capacity, points=20, crossings=form)


def ring(*corners):
    return np.column_stack([np.array([*corners, corners[0]], float), np.zeros(len(corners) + 1)])


def test_crossings_stay_whole_if_they_touch_the_range():
    touching = ring((48.0, 0.0), (60.0, 0.0), (60.0, 4.0), (48.0, 4.0))
    outside = ring((52.0, 0.0), (60.0, 0.0), (60.0, 4.0), (52.0, 4.0))
    areas, dropped = areas_of(crossings=(touching, outside))
    assert areas.category[areas.valid].tolist() == [AreaType.PEDESTRIAN_CROSSING]
    assert areas.points[0, :, 0].max() > 58.0
    np.testing.assert_array_equal(areas.points[0, 0], areas.points[0, -1])
    assert dropped == 0


CORNERS = ((10.0, -6.0), (10.0, 6.0), (13.0, 6.0), (13.0, -6.0))


@pytest.mark.parametrize("turn", range(4))
def test_sides_of_a_crossing_are_its_first_and_third_edge(turn):
    outline = ring(*CORNERS) @ np.diag([1.0, 1.0, 0.0])
    c, s = np.round((np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)))
    outline[:, :2] = outline[:, :2] @ np.array([[c, s], [-s, c]])
    boundary = ring((0.0, 1.0), (3.0, 1.0), (3.0, -1.0))
    areas, _ = areas_of(crossings=(outline,), boundaries=(boundary,), form="sides")
    row = np.flatnonzero(areas.category == AreaType.PEDESTRIAN_CROSSING)[0]
    first, second = areas.points[row].reshape(2, 10, 3)
    edges = [np.linspace(*outline[[0, 1]], 10), np.linspace(*outline[[2, 3]], 10)]
    # Seen along +y and -x, the rule takes the first edge, else the third.
    expected = edges if turn in (0, 3) else edges[::-1]
    np.testing.assert_allclose([first, second], expected, atol=1e-5)
    step = first[-1] - first[0]
    assert -45.0 <= np.rad2deg(np.arctan2(step[1], step[0])) <= 135.0
    # The boundary stays a ring.
    np.testing.assert_array_equal(*areas.points[1 - row][[0, -1]])


def test_an_outline_with_further_corners_is_cut_in_two_halves():
    outline = ring((0.0, 0.0), (4.0, 0.0), (8.0, 0.0), (8.0, 3.0), (0.0, 3.0))
    sides = crossing_sides(outline, 8)
    np.testing.assert_allclose(sides[[0, 3, 4, 7], :2], [[0, 0], [8, 3], [8, 3], [0, 0]], atol=0.8)
    with pytest.raises(UserError, match="even number"):
        crossing_sides(outline, 7)


def test_boundaries_are_cut_inside_the_range_and_islands_stay_closed():
    road = ring((0.0, 10.0), (-80.0, 10.0), (-80.0, -10.0), (80.0, -10.0), (80.0, 10.0))
    island = ring((5.0, 1.0), (8.0, 1.0), (8.0, -1.0))
    areas, _ = areas_of(boundaries=(road, island))
    assert areas.category[areas.valid].tolist() == [AreaType.ROAD_BOUNDARY] * 3
    ends = areas.points[:2][:, [0, -1], 0]
    np.testing.assert_allclose(np.abs(ends), 50.0 - BOUNDARY_MARGIN, atol=1e-5)
    np.testing.assert_array_equal(areas.points[2, 0], areas.points[2, -1])


@pytest.mark.parametrize("shift", range(8))
def test_the_seam_of_a_ring_makes_no_difference(shift):
    corners = [(0, 10), (-80, 10), (-80, -10), (-10, -10), (-10, -60), (10, -60), (10, -10), (80, -10), (80, 10)]
    corners = corners[shift:] + corners[:shift]
    pieces = clip_ring(ring(*corners), RANGE)
    cut = shapely.LineString([*corners, corners[0]]).intersection(shapely.box(-50, -25, 50, 25))
    expected = shapely.line_merge(cut)
    assert len(pieces) == len(expected.geoms) == 3
    assert sorted(shapely.LineString(p).length for p in pieces) == pytest.approx(
        sorted(part.length for part in expected.geoms)
    )


def test_traffic_elements_are_tied_to_the_chains_of_their_segments():
    lanes = (
        segment(10, [(0.0, 0.0), (10.0, 0.0)], [11]),
        segment(11, [(10.0, 0.0), (20.0, 0.0)]),
        segment(12, [(0.0, 9.0), (10.0, 9.0)]),
    )

    def element(x, *governed):
        return MapElement(np.array([x, 1.0, 4.0]), 0.0, 1, 2, governed)

    elements = (element(49.0, 12), element(30.0, 11, 404), element(70.0, 10))
    vector_map = lane_map(*lanes, elements=elements)
    cropped = crop(vector_map, capacity=4)
    prepared = prepare_map(vector_map, bike_lanes=True)
    shown = np.array([1, 2, 3])
    out, dropped = traffic_elements(elements, shown, prepared.chain_of, cropped, np.eye(4), RANGE, capacity=3)
    out.validate()
    assert out.valid.tolist() == [True, True, False]
    assert out.attribute[:2].tolist() == [1, 2]
    assert out.lane.tolist() == [[False, True, False], [True, False, False], [False] * 3, [False] * 3]
    assert dropped == 0
    wide = PerceptionRange((-100.0, 100.0), (-50.0, 50.0))
    out, dropped = traffic_elements(elements, shown, prepared.chain_of, cropped, np.eye(4), wide, capacity=3)
    assert (out.valid.sum(), dropped) == (2, 0)  # the third is farther than 60 m
    out, dropped = traffic_elements(elements, shown, prepared.chain_of, cropped, np.eye(4), RANGE, capacity=1)
    assert (out.position[0, 0], dropped) == (30.0, 1)
    # The same elements tied to the segments themselves: 11 is a row of its own.
    segments = crop(vector_map, flavour="segments", capacity=4)
    out, _ = traffic_elements(
        elements, shown, prepared.segment_of, segments, np.eye(4), RANGE, capacity=3, of="segments"
    )
    assert out.lane is None
    assert out.segment.tolist() == [[False] * 3, [False, True, False], [True, False, False], [False] * 3]

"""Placement of fiducial markers."""

from dataclasses import fields, replace

import jax
import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.geometry import invert_pose, transform_points
from tflane_jax.geometry.poses import yaw_pose
from tflane_jax.scene.logs import MapElement, VectorMap
from tflane_jax.world import simulate as simulate_module
from tflane_jax.world.cameras.marker_sites import visible_places
from tflane_jax.world.mirror import markers_beside, mirrored, mirrored_map
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.markers import PlacementConfig, approaching, place_markers
from tflane_jax.world.simulate import Stream, WorldConfig, _stream, simulate
from tflane_jax.world.traffic.simulation import TrafficConfig
from tflane_jax.world.warp import WarpConfig, warped

EMPTY = TrafficConfig(
    vehicles_per_metre=0.0, bicycles_per_metre=0.0, parked_share=0.0, pedestrians_per_metre=0.0, crossers_per_minute=0.0
)
EXACT = PlacementConfig(toe_in=0.0, jitter=0.0)


def two_lanes(**other):
    """Two lanes that drive along x into an intersection at x = 0: the right one is at y = -1.75."""
    return lane_map(
        segment(1, [(-50, 1.75), (0, 1.75)], [3]),
        segment(2, [(-50, -1.75), (0, -1.75)], [4]),
        segment(3, [(0, 1.75), (20, 1.75)], is_intersection=True),
        segment(4, [(0, -1.75), (20, -1.75)], is_intersection=True),
        **other,
    )


def test_a_marker_stands_right_of_the_approach_and_faces_its_traffic():
    kerb = np.array([[-60.0, -4.5, 0.0], [30.0, -4.5, 0.0]])
    placed = place_markers(two_lanes(road_boundaries=(kerb,)), 0, EXACT)
    assert placed.pose.dtype == np.float64
    assert placed.size == 1.0
    (pose,) = placed.pose
    np.testing.assert_allclose(pose[:3, 3], [0.0, -4.5 - 0.8, 3.0], atol=1e-12)
    # Seen by a driver who comes along +x: right is -y, up is z, and the marker looks back at the driver.
    np.testing.assert_allclose(pose[:3, :3].T, [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], atol=1e-12)
    driver = transform_points(invert_pose(pose), np.array([[-20.0, -1.75, 1.5]]))[0]
    assert driver[2] == pytest.approx(20.0)
    assert (driver[:2] < 0.0).all()


def test_a_surveyor_walks_back_until_the_board_is_seen():
    """A mast hides all places within 5 m of the junction; the lane is 50 m long."""
    lanes = two_lanes()
    asked = []

    def visible(place, heading):
        asked.append(place.copy())
        assert heading == pytest.approx(0.0)
        return 1.0 if place[0] < -5.0 else 0.3

    (pose,) = place_markers(lanes, 0, EXACT, visible).pose
    np.testing.assert_allclose(pose[:3, 3], [-6.0, -3.5 - 0.5 - 0.8, 3.0], atol=1e-9)
    assert [round(float(place[0])) for place in asked] == [0, 0, -3, -3, -6]
    np.testing.assert_array_equal(pose[:3, :3], place_markers(lanes, 0, EXACT).pose[0, :3, :3])
    # Where nothing is clear, the best place; where all is, the junction.
    (best,) = place_markers(lanes, 0, EXACT, lambda place, _: 0.5 if abs(place[0] + 15.0) < 0.1 else 0.2).pose
    assert best[0, 3] == pytest.approx(-15.0)
    (first,) = place_markers(lanes, 0, EXACT, lambda *_: 1.0).pose
    np.testing.assert_array_equal(first, place_markers(lanes, 0, EXACT).pose[0])


def test_boards_beyond_a_junction_are_moved_on():
    crossing = lane_map(
        segment(4, [(0, -1.75), (20, -1.75)], [5], is_intersection=True),
        segment(5, [(20, -1.75), (60, -1.75)]),
    )
    placed = place_markers(crossing, 0, replace(EXACT, side="both"), lambda place, _: float(place[0] > 25.0))
    assert placed.pose[0, 0, 3] == pytest.approx(26.0)


@pytest.mark.parametrize("scene", [200_000_000, 200_000_005])
def test_surveyed_boards_are_seen_better(scene):
    pytest.importorskip("cv2")
    world = WorldConfig(markers=PlacementConfig(side="both"), traffic=EMPTY)
    plain = simulate(scene, world)
    clear = simulate(scene, replace(world, markers=replace(world.markers, site="clear")))
    seen = visible_places(plain.map, plain.seed)

    def worst(log):
        # The heading of the traffic is against the board's, but for the toe-in.
        return [seen(pose[:3, 3], float(np.arctan2(-pose[1, 2], -pose[0, 2]) + np.deg2rad(5.0))) for pose in log]

    before, after = (np.array(worst(log.markers.pose)) for log in (plain, clear))
    assert len(before) == len(after)
    assert before.min() < 0.8 < after.mean()
    assert after.mean() > before.mean()


def test_less_of_a_large_board_is_hidden_by_a_thin_post():
    """A lamp post hides most of a board of 20 cm behind it, and little of one of 3 m."""
    pytest.importorskip("cv2")
    post = MapElement(np.array([20.0, 0.0, 3.0]), np.pi, 1, 0, ())
    road = replace(lane_map(segment(2, [(-50, -1.75), (60, -1.75)])), elements=(post,))
    place = np.array([20.6, 0.0, 3.0])
    small, usual, large = (visible_places(road, 0, size)(place, 0.0) for size in (0.2, 1.0, 3.0))
    assert small < usual < large
    assert visible_places(road, 0)(place, 0.0) == usual


@pytest.mark.parametrize(
    ("shown", "scenes"), [({"mirrored": 1.0}, (200_000_000, 200_000_001)), ({"warp": WarpConfig()}, (200_000_000,))]
)
def test_boards_are_surveyed_on_the_ground_that_is_shown(shown, scenes):
    """Trees stand elsewhere in a mirror, and on bent ground: boards that were chosen for the plain scene are worse."""
    pytest.importorskip("cv2")
    world = WorldConfig(markers=PlacementConfig(side="both", site="clear"), traffic=EMPTY)
    before, after = [], []
    for scene in scenes:
        plain, there = simulate(scene, world), simulate(scene, replace(world, **shown))
        warp = None if "mirrored" in shown else shown["warp"].draw(_stream(scene, Stream.WARP))
        seen = visible_places(there.map, scene, on_left=warp is None)
        for log, found in ((mirrored(plain) if warp is None else warped(plain, warp), before), (there, after)):
            # The heading of the traffic is against the board's, but for the toe-in.
            yaw = np.arctan2(-log.markers.pose[:, 1, 2], -log.markers.pose[:, 0, 2])
            yaw += np.deg2rad(-5.0 if warp is None else 5.0)
            found += [seen(at, float(angle)) for at, angle in zip(log.markers.pose[:, :3, 3], yaw, strict=True)]
    assert len(before) == len(after) > 0
    assert np.mean(after) > np.mean(before) + 0.02


def test_boards_behind_a_junction_face_crossing_traffic():
    crossing = lane_map(
        segment(2, [(-50, -1.75), (0, -1.75)], [4]),
        segment(4, [(0, -1.75), (20, -1.75)], [5], is_intersection=True),
        segment(5, [(20, -1.75), (60, -1.75)]),
    )
    near, both = (place_markers(crossing, 0, replace(EXACT, side=side)) for side in ("near", "both"))
    assert (len(near.pose), len(both.pose)) == (1, 2)
    far = both.pose[np.argmax(both.pose[:, 0, 3])]
    np.testing.assert_allclose(far[:3, 3], [20.0, -3.5 - 0.5 - 0.8, 3.0], atol=1e-12)
    np.testing.assert_allclose(far[:3, :3].T, [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], atol=1e-12)


def test_boards_are_turned_towards_the_road():
    straight, turned = (place_markers(two_lanes(), 0, PlacementConfig(toe_in=t, jitter=0.0)) for t in (0.0, 20.0))
    assert straight.pose[0, 1, 2] == pytest.approx(0.0)
    assert turned.pose[0, 1, 2] == pytest.approx(np.sin(np.deg2rad(20.0)))
    drawn = [place_markers(two_lanes(), seed).pose[0, 1, 2] for seed in range(50)]
    assert np.rad2deg(np.arcsin([min(drawn), max(drawn)])) == pytest.approx([2.0, 8.0], abs=0.6)


def test_without_a_kerb_the_lane_ends_the_road_and_a_far_kerb_is_none():
    far = np.array([[-60.0, -20.0, 0.0], [30.0, -20.0, 0.0]])
    for boundaries in ((), (far,)):
        placed = place_markers(two_lanes(road_boundaries=boundaries), 0, EXACT)
        assert placed.pose[0, 1, 3] == pytest.approx(-3.5 - 0.5 - 0.8)


@pytest.mark.parametrize(
    ("segments", "count"),
    [
        ([], 0),
        ([segment(1, [(0, 0), (50, 0)])], 0),
        ([segment(1, [(0, 0), (50, 0)], [2]), segment(2, [(50, 0), (90, 0)])], 0),
        # A split, a merge, and both of a road closed to motor vehicles.
        ([segment(1, [(0, 0), (50, 0)], [2, 3]), segment(2, [(50, 0), (90, 0)]), segment(3, [(50, 0), (90, 20)])], 1),
        ([segment(1, [(0, 0), (50, 0)], [3]), segment(2, [(0, 40), (50, 0)], [3]), segment(3, [(50, 0), (90, 0)])], 2),
        (
            [
                segment(1, [(0, 0), (50, 0)], [2, 3], vehicle=False),
                segment(2, [(50, 0), (90, 0)]),
                segment(3, [(50, 0), (90, 20)]),
            ],
            0,
        ),
        # A successor that the map does not hold.
        ([segment(1, [(0, 0), (50, 0)], [7, 8])], 0),
    ],
)
def test_approaches_end_where_intersections_splits_and_merges_begin(segments, count):
    placed = place_markers(lane_map(*segments), 3)
    assert placed.marker_id.shape == (count,)
    assert placed.pose.shape == (count, 4, 4)


def test_no_marker_stands_in_a_lane():
    lanes = two_lanes()
    beside = segment(5, [(-50, -5.0), (50, -5.0)])
    assert len(place_markers(lanes, 0).marker_id) == 1
    assert len(place_markers(VectorMap({**lanes.segments, 5: beside}), 0).marker_id) == 0


def test_ids_are_unique_and_never_more_than_the_dictionary_holds():
    crossroads = simulate(23, replace(WorldConfig(traffic=EMPTY), roads=RoadConfig(kinds=((SceneKind.FOUR_WAY, 1.0),))))
    everywhere = place_markers(crossroads.map, 1, EXACT)
    count = len(everywhere.marker_id)
    assert count >= 3
    assert len(set(everywhere.marker_id.tolist())) == count
    small = place_markers(crossroads.map, 1, replace(EXACT, dictionary=2))
    assert sorted(small.marker_id.tolist()) == [0, 1]
    one = place_markers(crossroads.map, 1, replace(EXACT, per="scene"))
    assert one.pose.shape == (1, 4, 4)
    assert any(np.array_equal(one.pose[0], pose) for pose in everywhere.pose)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("left", [False, True])
def test_the_only_board_of_a_scene_is_one_that_the_vehicle_approaches(seed, left):
    """Whichever approach of a junction the drive comes along, the board of that approach is kept."""
    crossroads = simulate(23, replace(WorldConfig(traffic=EMPTY), roads=RoadConfig(kinds=((SceneKind.FOUR_WAY, 1.0),))))
    found = mirrored_map(crossroads.map) if left else crossroads.map
    everywhere, scene = (markers_beside(found, seed, replace(EXACT, per=per)) for per in ("approach", "scene"))
    assert len(everywhere.pose) >= 3
    assert scene.pose.shape == (1, 4, 4)
    for board in everywhere.pose:
        ahead = -board[:2, 2]  # heading of the traffic that it faces
        drive = yaw_pose(*(board[:2, 3] + np.arange(-60.0, -10.0, 2.0)[:, None] * ahead).T, np.arctan2(*ahead[::-1]))
        (kept,) = markers_beside(found, seed, replace(EXACT, per="scene"), None, drive).pose
        np.testing.assert_array_equal(kept, board)


def test_simulated_scenes_keep_the_board_that_most_frames_approach():
    several = 0
    for seed in range(10):
        frames = {}
        for per in ("approach", "scene"):
            log = simulate(seed, WorldConfig(traffic=EMPTY, markers=replace(EXACT, per=per, side="both")))
            assert log.markers is not None
            frames[per] = [
                len(approaching(log.global_from_ego, pose[:3, 3], np.arctan2(-pose[1, 2], -pose[0, 2])))
                for pose in log.markers.pose
            ]
        assert frames["scene"] == [max(frames["approach"])] if frames["approach"] else not frames["scene"]
        several += len({count > 0 for count in frames["approach"]}) == 2
    assert several >= 3  # scenes in which another choice would leave a board that the drive never meets


@pytest.mark.parametrize("kind", list(SceneKind))
def test_scenes_have_markers_where_their_roads_are_complex(kind):
    config = replace(WorldConfig(traffic=EMPTY), roads=RoadConfig(kinds=((kind, 1.0),)))
    log = simulate(5, config)
    assert log.markers is not None
    again = simulate(5, config).markers
    assert again is not None
    assert again.pose.tobytes() == log.markers.pose.tobytes()
    assert again.marker_id.tobytes() == log.markers.marker_id.tobytes()
    assert (len(log.markers.marker_id) > 0) == (kind is not SceneKind.ROAD)
    rotation = log.markers.pose[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), identity, atol=1e-9)
    assert (np.linalg.det(rotation) > 0).all()


def test_markers_change_nothing_else(monkeypatch):
    """Roads, traffic, tracks and weather are drawn from streams of their own."""
    with_markers = simulate(7)
    monkeypatch.setattr(simulate_module, "place_markers", lambda *_: None)
    without = simulate(7)
    assert without.markers is None
    for field in fields(with_markers):
        if field.name not in ("map", "keyframes", "tracks", "actors", "markers"):
            a, b = getattr(with_markers, field.name), getattr(without, field.name)
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), field.name
    for part in ("map", "tracks", "actors"):
        a, b = (vars(getattr(log, part)) for log in (with_markers, without))
        jax.tree.map(np.testing.assert_array_equal, _arrays(a), _arrays(b))


def _arrays(part):
    """Return nested containers with dataclasses opened."""
    if hasattr(part, "__dataclass_fields__"):
        return _arrays(vars(part))
    if isinstance(part, dict):
        return {str(k): _arrays(v) for k, v in part.items()}
    return [_arrays(v) for v in part] if isinstance(part, (list, tuple)) else part

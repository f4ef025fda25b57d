"""Examples made from one moment of a log."""

import dataclasses
import math
import warnings

import numpy as np
import pytest

from tests.datasets.small_logs import drive, lane_map, log, segment, tracks
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.examples import make_example, occluder_boxes, traffic_flow
from tflane_jax.datasets.leaves import example_from_leaves, example_leaves
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, invert_pose, pose_yaw, transform_points, yaw_pose
from tflane_jax.geometry.cameras import project
from tflane_jax.scene import stack_examples
from tflane_jax.scene.logs import MapElement
from tflane_jax.world.cameras.ring import CameraRigConfig

ROAD = lane_map(segment(0, [(900.0, -2000.0), (1100.0, -2000.0)]))
POSES = drive(30)


def seen_from(poses, points, yaw=0.0):
    """Return global points (K, 3) and a heading as each frame's ego vehicle saw them."""
    position = np.stack([transform_points(invert_pose(p), points) for p in poses])
    return position, np.stack([np.full(len(points), yaw) - pose_yaw(p) for p in poses])


def test_static_objects_keep_their_position_in_every_frame():
    points = np.array([[1010.0, -1995.0, 0.5], [990.0, -2010.0, 1.0]])
    position, yaw = seen_from(POSES, points, 2.5)
    moment = yaw_pose(1012.3, -1998.4, 1.9)
    recording = log(ROAD, tracks(position, yaw), POSES, [(25, moment)])
    flow, dropped = traffic_flow(recording, 0, history=20, capacity=4)
    flow.validate()
    assert dropped == 0
    assert flow.valid.tolist() == [[True] * 20] * 2 + [[False] * 20] * 2
    c, s = math.cos(-1.9), math.sin(-1.9)
    for k, (x, y, z) in enumerate(points):
        dx, dy = x - 1012.3, y + 1998.4
        np.testing.assert_allclose(flow.position[k], [[c * dx - s * dy, s * dx + c * dy, z]] * 20, atol=1e-4)
    np.testing.assert_allclose(flow.yaw[:2], 2.5 - 1.9, atol=1e-5)
    assert flow.position.dtype == flow.yaw.dtype == np.float32


@pytest.mark.parametrize(("frame", "frames"), [(0, 0), (1, 1), (7, 7), (20, 20), (29, 20)])
def test_history_ends_before_the_key_frame_and_is_padded_at_the_front(frame, frames):
    # The x of a box tells its frame.
    position = np.zeros((30, 1, 3))
    position[:, 0, 0] = np.arange(30)
    recording = log(ROAD, tracks(position), [np.eye(4)] * 30, [(frame, np.eye(4))])
    flow, _ = traffic_flow(recording, 0, history=20, capacity=2)
    assert flow.valid[0].tolist() == [False] * (20 - frames) + [True] * frames
    np.testing.assert_array_equal(flow.position[0, 20 - frames :, 0], np.arange(frame - frames, frame))


@pytest.mark.parametrize("stride", [1, 2, 5])
@pytest.mark.parametrize("frame", [3, 25, 29])
def test_a_history_with_a_stride_is_every_kth_frame_of_the_dense_one(frame, stride):
    rng = np.random.default_rng([frame, stride])
    position, valid = rng.normal(size=(30, 6, 3)), rng.random((30, 6)) < 0.3
    recorded = tracks(position, rng.normal(size=(30, 6)), valid=valid, occluded=rng.random((30, 6)) < 0.5)
    recorded = dataclasses.replace(recorded, size=rng.uniform(1.0, 5.0, (6, 3)))
    recording = log(ROAD, recorded, POSES, [(frame, POSES[frame])])
    dense, _ = traffic_flow(recording, 0, history=5 * stride, capacity=6)
    flow, _ = traffic_flow(recording, 0, history=5, capacity=6, stride=stride)
    flow.validate()
    # Who is seen only in frames that are left out is no instance.
    kept = dense.valid[:, ::stride].any(-1)
    n = kept.sum()
    assert not flow.valid[n:].any()
    for name in ("position", "yaw", "occluded", "valid"):
        np.testing.assert_array_equal(getattr(flow, name)[:n], getattr(dense, name)[kept][:, ::stride], err_msg=name)
    np.testing.assert_array_equal(flow.size[:n], dense.size[kept])


@pytest.mark.parametrize(("rate", "stride"), [(None, 1), (10.0, 1), (5.0, 2), (2.0, 5), (2.04, 5)])
def test_the_rate_of_the_history_picks_its_stride(rate, stride):
    # The x of a box tells its frame; the log has 10 Hz.
    position = np.zeros((30, 1, 3))
    position[:, 0, 0] = np.arange(30)
    recording = log(ROAD, tracks(position), [np.eye(4)] * 30, [(29, np.eye(4))])
    flow = make_example(recording, 0, ExampleConfig(history=4, history_hz=rate)).traffic_flow
    assert flow.position[0, :, 0].tolist() == [29 - i * stride for i in (4, 3, 2, 1)]


@pytest.mark.parametrize("rate", [3.0, 20.0, 0.0, -2.0])
def test_a_rate_that_does_not_divide_that_of_the_log_is_refused(rate):
    recording = log(ROAD, tracks(np.zeros((30, 1, 3))), POSES, [(29, POSES[29])])
    with pytest.raises(UserError, match="does not divide the 10 Hz"):
        make_example(recording, 0, ExampleConfig(history_hz=rate))


def test_instances_without_a_frame_in_the_window_leave_no_gap():
    valid = np.zeros((30, 3), bool)
    valid[:3, 0] = valid[20:22, 1] = valid[25:, 2] = True
    occluded = np.zeros((30, 3), bool)
    occluded[20, 1] = True
    recorded = dataclasses.replace(tracks(np.zeros((30, 3, 3)), valid=valid, occluded=occluded), category=np.arange(3))
    flow, _ = traffic_flow(log(ROAD, recorded, POSES, [(25, POSES[25])]), 0, history=10, capacity=3)
    assert flow.valid.sum(-1).tolist() == [2, 0, 0]
    assert flow.category[0] == 1
    assert np.argwhere(flow.occluded).tolist() == [[0, 5]]


def test_beyond_capacity_the_nearest_stay_in_order():
    position = np.zeros((5, 4, 3))
    position[:, :, 0] = [30.0, 10.0, 40.0, 20.0]
    recording = log(ROAD, tracks(position), [np.eye(4)] * 5, [(4, np.eye(4))])
    flow, dropped = traffic_flow(recording, 0, history=4, capacity=2)
    assert (flow.position[:, -1, 0].tolist(), dropped) == ([10.0, 20.0], 2)
    with pytest.warns(TruncationWarning, match=r"ExampleConfig\.tracks = 2"):
        make_example(recording, 0, ExampleConfig(history=4, tracks=2))


def test_only_tracks_that_models_see_are_missed():
    """Of tracks at 10 m, 20 m ahead and 90 m, one or two have no room; the last was never near."""
    position = np.zeros((5, 3, 3))
    position[:, :, 0] = [10.0, 20.0, 90.0]
    recording = log(ROAD, tracks(position), [np.eye(4)] * 5, [(4, np.eye(4))])
    with warnings.catch_warnings():
        warnings.simplefilter("error", TruncationWarning)
        make_example(recording, 0, ExampleConfig(history=4, tracks=2))
    region = PerceptionRange()
    assert [traffic_flow(recording, 0, history=4, capacity=k, region=region)[1] for k in (1, 2, 3)] == [1, 0, 0]
    assert traffic_flow(recording, 0, history=4, capacity=1)[1] == 2


def test_occluders_are_the_actors_of_the_key_frame_in_the_pose_of_the_key_frame():
    points = np.array([[1005.0, -1990.0, 0.0], [1006.0, -1991.0, 0.0]])
    position, yaw = seen_from(POSES, points, 0.7)
    valid = np.ones((30, 2), bool)
    valid[10, 1] = False
    moment = yaw_pose(1001.0, -1999.0, -0.2)
    recording = log(ROAD, tracks(position, yaw, valid=valid), POSES, [(10, moment)])
    boxes = occluder_boxes(recording, 0)
    expected = transform_points(invert_pose(moment), points[:1])[0]
    np.testing.assert_allclose(boxes, [[expected[0], expected[1], 4.0, 2.0, 0.9, 1.5, 0.0]], atol=1e-9)


@pytest.mark.parametrize(("frames", "actors"), [(1, 0), (1, 2), (30, 0)])
def test_a_log_of_one_frame_or_without_road_users_gives_a_valid_empty_flow(frames, actors):
    recorded = tracks(np.full((frames, actors, 3), 20.0))
    config = ExampleConfig()
    example = make_example(log(ROAD, recorded, POSES[:frames], [(frames - 1, POSES[frames - 1])]), 0, config)
    example.validate()
    assert not example.traffic_flow.valid.any()
    assert example.lanes.valid.sum() == 1
    assert example.bev.shape == (100, 200, 4)
    assert example.bev.dtype == np.uint8
    assert not example.has_previous
    np.testing.assert_allclose(example.previous_from_ego, np.eye(4), atol=1e-12)


def test_examples_have_one_shape_and_the_motion_since_the_previous_frame():
    recording = log(ROAD, tracks(np.full((30, 3, 3), 9.0)), POSES, [(5, POSES[5]), (10, POSES[10])])
    first, second = (make_example(recording, k, ExampleConfig()) for k in range(2))
    assert stack_examples([first, second]).bev.shape == (2, 100, 200, 4)
    assert second.has_previous
    expected = np.linalg.inv(POSES[5]) @ POSES[10]
    np.testing.assert_allclose(second.previous_from_ego, expected, atol=1e-4)


def test_same_log_same_bits():
    position, yaw = seen_from(POSES, np.array([[1010.0, -1995.0, 0.5]]))
    recording = log(ROAD, tracks(position, yaw), POSES, [(12, POSES[12])], seed=3)
    first, second = (make_example(recording, 0, ExampleConfig()) for _ in range(2))
    for a, b in zip(first.bev, second.bev, strict=True):
        np.testing.assert_array_equal(a, b)


def test_invalid_slots_change_nothing():
    valid = np.random.default_rng(0).random((30, 5)) < 0.6
    position = np.random.default_rng(1).uniform(-20.0, 20.0, (30, 5, 3))
    clean = tracks(position, valid=valid)
    garbage = tracks(np.where(valid[..., None], position, np.nan), np.where(valid, 0.0, np.nan), valid=valid)
    first, second = (
        make_example(log(ROAD, recorded, POSES, [(22, POSES[22])]), 0, ExampleConfig()) for recorded in (clean, garbage)
    )
    np.testing.assert_array_equal(first.bev, second.bev)
    np.testing.assert_array_equal(first.hidden, second.hidden)
    seen = first.traffic_flow.valid
    np.testing.assert_array_equal(seen, second.traffic_flow.valid)
    np.testing.assert_array_equal(first.traffic_flow.position[seen], second.traffic_flow.position[seen])


def test_a_building_hides_ground_and_lanes():
    building = np.array([[1020.0, -2000.0, 4.0, 30.0, 0.0]])
    pose = yaw_pose(1000.0, -2000.0, 0.0)
    road = dataclasses.replace(ROAD, buildings=building)
    open_, walled = (
        make_example(log(m, tracks(np.zeros((1, 0, 3))), [pose], [(0, pose)]), 0, ExampleConfig()) for m in (ROAD, road)
    )
    assert open_.lanes.visibility[0] == 1.0
    # Seen from -50 m to the face at 18 m.
    assert walled.lanes.visibility[0] == pytest.approx(0.68, abs=0.01)
    assert not open_.hidden.any()
    assert walled.hidden[50, 180]


def test_a_light_has_its_state_of_the_key_frame():
    light = MapElement(np.array([1010.0, -2000.0, 4.0]), 0.0, 1, 1, (0,))
    sign = MapElement(np.array([1012.0, -2000.0, 2.0]), 0.0, 2, 4, (0,))
    pose = yaw_pose(1000.0, -2000.0, 0.0)
    road = dataclasses.replace(ROAD, elements=(light, sign))
    states = np.array([[1, 4], [2, 4]])
    plain = log(road, tracks(np.zeros((2, 0, 3))), [pose] * 2, [(1, pose)])
    for recording, expected in ((plain, [1, 4]), (dataclasses.replace(plain, element_attribute=states), [2, 4])):
        elements = make_example(recording, 0, ExampleConfig()).traffic_elements
        assert elements.attribute[:2].tolist() == expected
        assert elements.lane[0].tolist() == [True, True] + [False] * 22


def test_cameras_bring_their_images_and_the_elements_seen_in_them():
    """A light ahead and one behind: without cameras both are the truth, with cameras the one in the image."""
    pytest.importorskip("cv2")
    ahead, behind = (
        MapElement(np.array([1000.0 + x, -2000.0, 5.0]), np.pi if x > 0 else 0.0, 1, 1, (0,)) for x in (22.0, -22.0)
    )
    pose = yaw_pose(1000.0, -2000.0, 0.0)
    recording = log(
        dataclasses.replace(ROAD, elements=(behind, ahead)), tracks(np.zeros((1, 0, 3))), [pose], [(0, pose)]
    )
    plain = make_example(recording, 0, ExampleConfig())
    rig = CameraRigConfig(severity=0.0)
    seen = make_example(recording, 0, ExampleConfig(cameras=rig))
    alone = make_example(recording, 0, ExampleConfig(sensor=None, cameras=rig))
    for example in (plain, seen, alone):
        example.validate()
    assert plain.cameras is None
    assert plain.traffic_elements.valid.sum() == 2
    assert not plain.traffic_elements.box.any()
    assert seen.cameras.image.shape == (6, 90, 160, 3)
    assert seen.traffic_elements.valid.sum() == 1
    np.testing.assert_allclose(seen.traffic_elements.position[0], [22.0, 0.0, 5.0], atol=1e-5)
    (pixel,), _, _ = project(
        seen.traffic_elements.position[:1], seen.cameras.intrinsics[0], seen.cameras.camera_from_ego[0]
    )
    low, high = seen.traffic_elements.box[0]
    assert (low < pixel).all()
    assert (pixel < high).all()
    np.testing.assert_array_equal(plain.bev, seen.bev)
    assert alone.bev is alone.hidden is None
    np.testing.assert_array_equal(alone.cameras.image, seen.cameras.image)
    restored = example_from_leaves(example_leaves(alone))
    np.testing.assert_array_equal(restored.cameras.image, alone.cameras.image)

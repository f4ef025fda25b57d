"""Virtual markers of OpenLane-V2 segments: where they stand, what a frame's cameras see of them."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tests.datasets.test_openlane_lanes import seen, straight
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_markers import BoardsConfig, SegmentBoards, SegmentFrame
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset, nominal_example
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, relative_pose, transform_points
from tflane_jax.markers.pixels import PixelConfig
from tflane_jax.markers.simulation import PERFECT, MarkerConfig
from tflane_jax.world.render.camera import PinholeCamera
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.roads.sd_map import SdMapConfig

SIZES = ExampleConfig(lanes=5, segments=4, areas=2, elements=3)
RANGE = PerceptionRange((-50.0, 50.0), (-25.0, 25.0))
PRIOR = MarkerConfig(lanes=4, points=5, simulation=PERFECT)
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def camera(focal=800.0, width=1000, height=1000):
    """Return a camera 1.5 m above the ground that looks straight ahead."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = AXES, -AXES @ [0.0, 0.0, 1.5]
    return PinholeCamera(width, height, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), pose)


def drive(cameras=None, places=(0.0, 5.0, 10.0, 15.0, 20.0)):
    """Return frames along the x axis towards a fork at x = 60: lane "a", then "b" and "c"."""
    lanes = [("a", straight(-20, 60)), ("b", straight(60, 100)), ("c", straight(60, 100, y=0.5))]
    cameras = (camera(),) if cameras is None else cameras
    return [
        SegmentFrame(10**18 + 500_000_000 * i, seen(x, lanes, edges=[(0, 1), (0, 2)]), cameras)
        for i, x in enumerate(places)
    ]


STANDARD = BoardsConfig()


def boards(frames, prior=PRIOR, config=STANDARD):
    return SegmentBoards(config, prior, RANGE, lambda name: frames)


def test_a_board_stands_right_of_the_approach_and_names_its_lanes():
    """The board: half a lane, the road's edge and the setback to the right of the lane's end, 3 m up."""
    found = boards(drive())
    last = found.observations("train/00001", 4)
    placed = found.markers("train/00001")
    assert len(placed.marker_id) == 1
    np.testing.assert_allclose(placed.pose[0, :3, 3], [60.0, -(1.75 + 0.5 + 0.8), 3.0], atol=1e-6)
    assert placed.pose[0, 0, 2] < -0.95  # faces the traffic
    assert last.valid.tolist() == [True, False]
    np.testing.assert_allclose(last.pose[0, :3, 3], [40.0, -3.05, 3.0], atol=1e-4)
    np.testing.assert_allclose(last.residual, 0.0, atol=1e-4)
    lines = last.lanes[0][last.lane_valid[0]]
    # Lane a from 50 m before the board, as far as the range goes; b and c to the range's end.
    ends = sorted((round(float(line[0, 0])), round(float(line[-1, 0]))) for line in lines)
    assert ends == [(-10, 40), (40, 50), (40, 50)]
    assert last.successor[0].sum() == 2


def test_each_frame_sees_through_its_own_cameras():
    """Too near, the board is beside the image; too far, out of range; a camera that looks back sees none."""
    places = (-10.0, 20.0, 57.0)
    near = boards(drive(places=places), config=BoardsConfig(placement=PlacementConfig(site="junction")))
    assert [near.observations("s", i).valid.any() for i in range(3)] == [False, True, False]
    back = replace(camera(), camera_from_ego=camera().camera_from_ego @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert not any(boards(drive((back,))).observations("s", i).valid.any() for i in range(5))
    assert not any(boards(drive(())).observations("s", i).valid.any() for i in range(5))


def test_a_surveyor_moves_a_board_into_the_images():
    """A camera that sees only what is to the right of the road sees no board 40, 30 and 20 m ahead, but at 15 m."""
    shifted = replace(camera(), intrinsics=np.array([[800.0, 0, -150], [0, 800, 500], [0, 0, 1]]))
    frames = drive((shifted,), places=(20.0, 30.0, 40.0))

    def found(site):
        made = boards(frames, config=BoardsConfig(placement=PlacementConfig(site=site)))
        return [made.observations("s", i).valid.any() for i in range(3)], made.markers("s").pose[0, :2, 3]

    (at_end, end), (clear, moved) = found("junction"), found("clear")
    assert (at_end, clear) == ([False, False, False], [False, True, True])
    np.testing.assert_allclose(end, [60.0, -3.05])
    np.testing.assert_allclose(moved, [45.0, -3.85])


def test_seed_and_segment_decide_alone():
    prior = replace(PRIOR, simulation=replace(PERFECT, forward_sigma=3.0, yaw_sigma=2.0))

    def pose(name, seed=0, first=None):
        found = boards(drive(), prior, BoardsConfig(seed=seed))
        if first is not None:
            found.observations(name, first)
        seen_now = found.observations(name, 4)
        return seen_now.marker_id[0], seen_now.pose[0]

    number, here = pose("train/00001")
    for other_number, other in (pose("train/00001"), pose("train/00001", first=3)):
        assert number == other_number
        np.testing.assert_array_equal(here, other)
    for name, seed in (("train/00001", 1), ("train/00002", 0)):
        assert (pose(name, seed)[1] != here).any()


def test_residuals_compare_with_the_frame_before():
    prior = replace(PRIOR, simulation=replace(PERFECT, forward_sigma=3.0))
    found = boards(drive(), prior)
    now, before = (found.observations("s", i) for i in (4, 3))
    moved = relative_pose(np.asarray(drive()[4].lanes.global_from_ego), np.asarray(drive()[3].lanes.global_from_ego))
    apart = np.asarray(now.pose[0, :3, 3]) - transform_points(moved, np.asarray(before.pose[0, :3, 3], float))
    np.testing.assert_allclose(now.residual[0], np.hypot(*apart.ravel()[:2]), atol=1e-3)
    assert found.observations("s", 0).residual[0] == 0.0


def test_a_segment_without_lanes_has_no_boards():
    frames = [replace(frame, lanes=seen(0.0, [])) for frame in drive()]
    assert not boards(frames).observations("s", 2).valid.any()


def test_photographs_have_no_boards_to_read():
    with pytest.raises(UserError, match=r"photographs show no boards .*markers.pixels to None"):
        boards(drive(), replace(PRIOR, pixels=PixelConfig()))


def test_examples_have_boards_and_the_sd_map(tmp_path):
    """The lane of 20 m that ends at an intersection has a board; images need not be at hand."""
    folder = export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=1))}, tmp_path / "made", progress=False)

    def opened(**other):
        settings = {"subset": "B", "image": None, "example": priors} | other
        return OpenLaneV2Dataset(OpenLaneV2Config(folder, **settings))

    priors = replace(SIZES, markers=MarkerConfig(lanes=4, points=5, simulation=PERFECT), sd_map=SdMapConfig(points=3))
    (folder / "train/01000/sdmap.json").write_text('[{"category": "road", "points": [[0, 0], [20, 0]]}]')
    shutil.rmtree(folder / "train/01000/image")
    dataset = opened()
    boards = replace(dataset.config.boards, placement=PlacementConfig(height=2.0))
    for made, height in ((dataset, 3.3), (opened(boards=boards), 2.3)):
        first, last = made.example(0), made.example(FRAMES - 1)
        first.validate()
        (place,) = made._boards.markers("train/01000").pose[:, :3, 3]
        np.testing.assert_allclose(place, [20.0, -3.05, height], atol=1e-3)
        np.testing.assert_allclose(last.sd_map.points[0, 0], [-5.0 * np.cos(0.04), 5.0 * np.sin(0.04)], atol=1e-4)
    nominal = nominal_example(replace(dataset.config, image=TOPONET_SUBSET_B))
    assert nominal.markers.lanes.shape == first.markers.lanes.shape
    assert nominal.sd_map.points.shape == first.sd_map.points.shape
    for path in (folder / "train").rglob("info/*[0-9].json"):
        record = json.loads(path.read_text())
        record["annotation"]["lane_centerline"][1].pop("id")
        path.write_text(json.dumps(record))
    with pytest.raises(UserError, match=r"lane_centerline\[1\] lacks the entry 'id'"):
        opened().example(0)

"""Hosts in the axes of nuScenes' lidar: inputs turned into them, predictions turned back."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import CAMERA, LINES, SMALL_LINES, make_camera_example, make_line_example
from tests.parameters import random_params
from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange, invert_pose, project, transform_points, yaw_pose
from tflane_jax.layers.bev_alignment import ego_shift
from tflane_jax.losses.map_masks import bev_line_mask, view_line_masks
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.bev_encoder import BevFormerConfig
from tflane_jax.models.bevformer import can_bus_vector
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lidar_axes import (
    in_lidar_axes,
    level_pose,
    lines_in_ego_axes,
    range_in_ego_axes,
    range_in_lidar_axes,
    raster_in_ego_axes,
)
from tflane_jax.models.lift import LiftConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.maptrv2 import MapTrV2Config
from tflane_jax.scene import MapLines, SdMap, VehicleState
from tflane_jax.tasks.lane_graph import LaneGraphTask

RANGE = PerceptionRange((-30.0, 26.0), (-14.0, 16.0), (-2.0, 2.0))
# The vehicle's own frame from the lidar's: ahead of the axle, above the ground, a quarter turn, tilted by 3 degrees.
TILT = np.eye(4)
TILT[1:3, 1:3] = [[np.cos(0.05), -np.sin(0.05)], [np.sin(0.05), np.cos(0.05)]]
VEHICLE_FROM_LIDAR = yaw_pose(0.9, 0.1, -np.pi / 2) @ TILT
VEHICLE_FROM_LIDAR[2, 3] = 1.8


def make_example(seed=0, vehicle=True):
    """Return an example of two cameras with lines, traffic and an SD map, in the vehicle's own frame."""
    example = make_camera_example(seed).replace(map_lines=make_line_example(seed).map_lines)
    state = VehicleState(*(np.float32(m) for m in (np.linalg.inv(VEHICLE_FROM_LIDAR), np.eye(4))), np.arange(18.0))
    roads = SdMap(np.arange(8.0, dtype=np.float32).reshape(1, 4, 2), np.zeros(1, np.int32), np.ones(1, bool))
    cameras = example.cameras.replace(vehicle=state if vehicle else None)
    return example.replace(sd_map=roads, cameras=cameras)


def test_a_point_of_the_lidars_frame_is_seen_where_it_was():
    """The cameras know the tilt and the height of the lidar; the depth network, the vehicle's own frame."""
    example = make_example()
    turned = in_lidar_axes(example).cameras
    points = np.random.default_rng(0).normal(0.0, 8.0, (20, 3)).astype(np.float32)
    there = transform_points(np.linalg.inv(VEHICLE_FROM_LIDAR), points).astype(np.float32)
    for v in (0, 1):
        calibration = example.cameras.intrinsics[v]
        for ours, theirs in zip(
            project(points, calibration, example.cameras.camera_from_ego[v]),
            project(there, calibration, np.asarray(turned.camera_from_ego[v])),
            strict=True,
        ):
            np.testing.assert_allclose(theirs, ours, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(turned.vehicle.vehicle_from_ego, VEHICLE_FROM_LIDAR, atol=1e-6)
    np.testing.assert_allclose(turned.vehicle.lidar_from_ego, np.eye(4), atol=1e-6)


def test_what_lies_on_the_ground_takes_the_level_pose():
    """MapTR's patch has the lidar's place and heading, not its tilt. A road user 20 m ahead of the lidar."""
    example = make_example()
    flow = example.traffic_flow
    flow.position[0, 0], flow.yaw[0, 0] = [20.9, 0.1, 0.8], 0.5
    turned = in_lidar_axes(example)
    np.testing.assert_allclose(turned.traffic_flow.position[0, 0], [0.0, 20.0, -1.0], atol=1e-5)
    np.testing.assert_allclose(turned.traffic_flow.yaw[0, 0], 0.5 + np.pi / 2, atol=1e-6)
    np.testing.assert_allclose(turned.sd_map.points[0, 0], [-0.9, -0.9], atol=1e-5)
    level = level_pose(example)
    np.testing.assert_allclose(lines_in_ego_axes(turned.sd_map.points, level), example.sd_map.points, atol=1e-5)
    np.testing.assert_allclose(
        lines_in_ego_axes(turned.traffic_flow.position, level), example.traffic_flow.position, atol=1e-4
    )
    moved = example.replace(previous_from_ego=yaw_pose(*np.float32([3.0, 0.5, 0.1])))
    ahead = np.asarray(in_lidar_axes(moved).previous_from_ego)
    np.testing.assert_allclose(ahead[:2, 3], [-0.5, 3.0], atol=0.15)  # the lidar is not the center of the turn
    np.testing.assert_array_equal(turned.map_lines.points, example.map_lines.points)


def test_without_a_known_lidar_the_axes_turn_by_a_quarter():
    turned = in_lidar_axes(make_example(vehicle=False))
    np.testing.assert_allclose(turned.sd_map.points[0, 1], [-3.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(turned.cameras.vehicle.vehicle_from_ego[:2, :2], [[0, 1], [-1, 0]], atol=1e-6)
    assert turned.cameras.vehicle.can_bus is None


def test_ranges_and_rasters_turn_as_points_do():
    lidar = range_in_lidar_axes(RANGE)
    assert (lidar.x, lidar.y, lidar.z) == ((-16.0, 14.0), (-30.0, 26.0), RANGE.z)
    assert range_in_ego_axes(lidar) == RANGE
    # A mark in the cell of one point, in either raster.
    point = np.array([11.0, -5.0])
    here, there = BevGrid(RANGE, 6, 8), BevGrid(lidar, 8, 6)
    ours, theirs = np.zeros((2, 6, 8)), np.zeros((2, 8, 6))
    for grid, raster, place in ((here, ours, point), (there, theirs, np.array([-point[1], point[0]]))):
        column, row = np.round(grid.pixel(place)).astype(int)
        raster[:, row, column] = 1.0
    np.testing.assert_array_equal(raster_in_ego_axes(jnp.asarray(theirs)), ours)


@pytest.mark.slow
def test_the_road_users_ahead_come_first_in_either_axes():
    """More road users than slots: those in the front sector stay, whichever way the axes point."""
    lidar = range_in_lidar_axes(RANGE)
    example = make_example(vehicle=False)  # a quarter turn about the origin
    example.traffic_flow.position[..., :2] *= 0.4  # so that many lie in range
    ego, turned = with_cameras(RANGE, range=RANGE), with_cameras(lidar, range=RANGE, axes="lidar")
    here, there = (host.build_priors()["traffic_flow"].observe(example, None)[0] for host in (ego, turned))
    assert (example.traffic_flow.valid.sum(1) >= 5).sum() > here.valid.sum() == len(here.valid)
    np.testing.assert_array_equal(there.index, here.index)
    np.testing.assert_allclose(there.weight, here.weight, atol=1e-6)
    # A prior that takes x for forward prefers those to the right.
    blind = turned.priors.build(replace(turned.spec, forward="x"))["traffic_flow"]
    assert blind.observe(in_lidar_axes(example), None)[0].index.tolist() != here.index.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", [True, False])
def test_the_truth_of_the_bev_mask_lies_where_the_mask_does(vehicle):
    """The mask of lines in the lidar's frame, its cells turned into the ego axes, as the mask head's are."""
    example = make_example(vehicle=vehicle)
    points = np.random.default_rng(1).uniform([-20, -10, -1], [20, 10, 1], (3, 4, 3)).astype(np.float32)
    lines = MapLines.empty(4, 4)
    lines.points[:3], lines.valid[:3], lines.points[3] = points, True, np.nan
    lines = jax.tree.map(jnp.asarray, lines)
    ego, lidar = BevGrid(RANGE, 60, 112), range_in_lidar_axes(RANGE)
    there = lines.replace(points=transform_points(invert_pose(level_pose(example)), lines.points.reshape(-1, 3)))
    there = there.replace(points=there.points.reshape(lines.points.shape))
    expected = raster_in_ego_axes(bev_line_mask(there, (ego.columns, ego.rows), lidar))
    host = with_cameras(lidar, MapTrV2Config, range=RANGE, axes="lidar")
    found = bev_line_mask(host.lines_over_bev(lines, example), (ego.rows, ego.columns), host.bev_range)
    assert np.asarray(found != expected).mean() < 0.002  # cells whose edge a line touches
    assert 0.02 < np.asarray(found).mean() < 0.3
    assert np.asarray(found != bev_line_mask(lines, (ego.rows, ego.columns), RANGE)).mean() > (0.02 if vehicle else -1)


def some_lines():
    """Return three lines and padding; the dense points lie elsewhere, so that it shows which are meant."""
    lines, rng = MapLines.empty(4, 4, 6), np.random.default_rng(3)
    for points in (lines.points, lines.dense):
        points[:3], points[3] = rng.uniform([-20, -10, -1], [20, 10, 1], (3, points.shape[1], 3)), np.nan
    lines.valid[:3] = True
    return jax.tree.map(jnp.asarray, lines)


def test_the_dense_points_move_with_the_lines():
    lines, example, host = some_lines(), make_example(), with_cameras(range_in_lidar_axes(RANGE), axes="lidar")
    for move in (host.lines_over_bev, host.lines_in_views):
        expected = move(lines.replace(points=lines.dense, dense=None), example).points
        moved = move(lines, example)
        np.testing.assert_array_equal(moved.dense, expected)
        assert moved.points.shape == lines.points.shape
        assert np.isfinite(moved.dense[:3]).all()


def test_the_truth_of_the_image_masks_lies_in_the_lidars_plane():
    """MapTRv2 projects (x, y) of the level frame and -1.6 m by the cameras' poses in the tilted lidar."""
    lines, example, lidar = some_lines(), make_example(), range_in_lidar_axes(RANGE)
    host = with_cameras(lidar, MapTrV2Config, range=RANGE, axes="lidar")
    level = yaw_pose(0.9, 0.1, -np.pi / 2)
    flat = transform_points(np.linalg.inv(level), np.asarray(lines.dense)[:3].reshape(-1, 3))
    published = np.column_stack([flat[:, :2], np.full(len(flat), -1.6)])
    turned, found = in_lidar_axes(example).cameras, host.lines_in_views(lines, example)
    for v in (0, 1):
        calibration = example.cameras.intrinsics[v]
        expected, depth, _ = project(published, calibration, np.asarray(turned.camera_from_ego[v]))
        ours = project(np.asarray(found.dense)[:3].reshape(-1, 3), calibration, example.cameras.camera_from_ego[v])
        np.testing.assert_allclose(ours[1], depth, atol=1e-4)
        assert (depth > 0.5).any()
        np.testing.assert_allclose(ours[0][depth > 0.5], expected[depth > 0.5], rtol=1e-3, atol=1e-2)
    # In the ego axes, and where no lidar is known, lines lie where the map has them.
    unknown = make_example(vehicle=False)
    for kept in (with_cameras(RANGE).lines_in_views(lines, example), host.lines_in_views(lines, unknown)):
        jax.tree.map(np.testing.assert_array_equal, kept, lines)


@pytest.mark.slow
def test_the_loss_draws_image_masks_in_the_lidars_plane():
    """A head that knows the masks in that plane has less loss than one that knows those on level ground."""
    lines, example = some_lines(), make_example()
    host = with_cameras(range_in_lidar_axes(RANGE), MapTrV2Config, range=RANGE, axes="lidar")
    batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], example.replace(map_lines=lines))
    views = jax.tree.map(lambda leaf: leaf[0], batch.cameras)

    def loss(known):
        mask = view_line_masks(known, views, (12, 16))
        logits = jnp.where(mask, 30.0, -30.0)[None]
        terms = MapTrV2LossConfig().auxiliary_terms("view_line_masks", logits, None, batch, host)
        return float(terms["view_mask"].sum())

    assert loss(host.lines_in_views(lines, example)) < 1e-6 < 0.1 < loss(lines)


def with_cameras(range_, kind=MapTrConfig, **settings):
    """Return a host with cameras on a grid over the range, in the grid's own axes."""
    images = replace(CAMERA.images, stages=(3,), pyramid=replace(CAMERA.images.pyramid, levels=1))
    grid = BevGrid(replace(range_, z=(-10.0, 10.0)), 6, 4)
    lift = LiftConfig(grid, dim=16, cameras=2, depth=(1.0, 9.0, 2.0), pyramid=4, dropout=0.0)
    encoder = replace(CAMERA, images=images, bev=lift, cells=False)
    return kind(encoder=encoder, decoder=LINES.decoder, priors=SMALL_LINES.priors, **settings)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder": LINES.encoder}, "BEV evidence is a raster in the ego axes"),
        (
            {"denoising": DenoisingConfig(), "decoder": SMALL_LINES.decoder},
            "noised lines are in the ego axes",
        ),
        ({"decoder": replace(LINES.decoder, anchors="spread")}, r"decoder\.anchors.*anchors lie along x"),
    ],
)
def test_parts_without_turned_axes_are_named(changes, message):
    with pytest.raises(UserError, match=message):
        replace(with_cameras(range_in_lidar_axes(RANGE), range=RANGE, axes="lidar"), **changes).build()


@pytest.mark.parametrize("memory", ["off", "previous"])
def test_a_memory_is_not_turned_twice(memory):
    """The published shift of a vehicle that drives ahead: along y of the lidar."""
    lidar = range_in_lidar_axes(RANGE)
    host = with_cameras(lidar, range=RANGE, axes="lidar")
    images, levels = replace(host.encoder.images, stages=(3,)), host.encoder.images.pyramid.levels
    bev = BevFormerConfig(host.encoder.bev.grid, dim=16, cameras=2, levels=levels, memory=memory, align="bevformer")
    host = replace(host, encoder=replace(host.encoder, images=images, bev=bev))
    if memory == "off":
        host.build()
        return
    with pytest.raises(UserError, match=r"encoder\.bev\.align.*bevformer turns it once more"):
        host.build()
    ahead = np.eye(4, dtype=np.float32)
    ahead[0, 3] = 2.0
    turned = host.in_host_frame(make_example().replace(previous_from_ego=ahead)).previous_from_ego
    shift = ego_shift(bev.grid, turned) * np.asarray(bev.grid.range.size(2))
    np.testing.assert_allclose(shift, [0.0, 2.0], atol=1e-6)


def test_the_can_bus_of_published_weights():
    """Without a previous frame: no position, no turn in degrees."""
    expected = np.arange(18.0)
    expected[[0, 1, 2, 17]] = 0.0
    np.testing.assert_array_equal(can_bus_vector(make_example().cameras), expected)
    with pytest.raises(UserError, match=r"these data have none: set data\.can_bus"):
        can_bus_vector(make_example(vehicle=False).cameras)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [MapTrConfig, partial(MapTrV2Config, many=2, line_mask=True)])
def test_a_model_in_the_lidars_axes_gives_the_turned_lines(kind):
    """The same parameters in a host that knows no axes, on cameras and tracks turned by hand."""
    lidar = range_in_lidar_axes(RANGE)
    host, plain = with_cameras(lidar, kind, range=RANGE, axes="lidar"), with_cameras(lidar, kind, range=lidar)
    example = make_example()
    params = random_params(LaneGraphTask(host).init, example)
    found = jax.jit(LaneGraphTask(host).predict)(params, example).lines

    level = yaw_pose(0.9, 0.1, -np.pi / 2)
    level[2, 3] = 1.8
    flow, cameras = example.traffic_flow, example.cameras
    state = cameras.vehicle.replace(vehicle_from_ego=np.float32(VEHICLE_FROM_LIDAR))
    by_hand = example.replace(
        cameras=cameras.replace(
            camera_from_ego=(cameras.camera_from_ego @ VEHICLE_FROM_LIDAR).astype(np.float32), vehicle=state
        ),
        traffic_flow=flow.replace(
            position=transform_points(invert_pose(level), flow.position).astype(np.float32),
            yaw=(flow.yaw + np.pi / 2).astype(np.float32),
        ),
    )
    there = jax.jit(LaneGraphTask(plain).predict)(params, by_hand).lines
    x, y = np.moveaxis(np.asarray(there.points), -1, 0)
    np.testing.assert_allclose(found.points, np.stack([y + 0.9, -x + 0.1], -1), atol=1e-2)
    np.testing.assert_allclose(found.logits, there.logits, atol=1e-3)
    assert np.ptp(found.points) > 1.0
    # What the model sees depends on the turn.
    assert np.abs(jax.jit(LaneGraphTask(plain).predict)(params, example).lines.logits - there.logits).max() > 1e-3

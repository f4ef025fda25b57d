"""The bird's-eye-view evidence: geometry, occlusion and degradation."""

import dataclasses

import numpy as np
import pytest

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.geometry import BevGrid, PerceptionRange, yaw_pose
from tflane_jax.scene import BevChannel, LineType
from tflane_jax.world.bev.map_samples import sample_map
from tflane_jax.world.bev.sensor import BevSensorConfig, hidden_cells, render_bev

GRID = BevGrid()
PERFECT = BevSensorConfig(severity=0.0)
NO_BOXES, NO_BUILDINGS = np.zeros((0, 7)), np.zeros((0, 5))
TRUCK = np.array([[10.0, 0.0, 8.0, 2.5, 0.0, 3.5, 0.0]])
# A painted line along y = 6 m.
LINE = lane_map(segment(0, [(-60.0, 4.25), (60.0, 4.25)], left=LineType.SOLID, right=LineType.NONE))
PAINT, OBSTACLE = BevChannel.LANE_PAINT, BevChannel.OBSTACLE


def render(vector_map=None, boxes=NO_BOXES, *, config=PERFECT, buildings=NO_BUILDINGS, **other):
    arguments = {"weather": 0.0, "paint_wear": 0.0, "log_seed": 5, "frame": 0, "pose": np.eye(4)} | other
    pose = arguments.pop("pose")
    hidden = hidden_cells(config.grid, boxes, buildings)
    samples = sample_map(vector_map or lane_map())
    return render_bev(samples, pose, boxes, buildings, hidden, config=config, **arguments)


def cell(x, y):
    """Return the row and column of the cell that holds a point."""
    return int((y + 25.6) / 0.512), int((x + 51.2) / 0.512)


def test_an_empty_scene_gives_empty_evidence():
    image = render()
    assert image.shape == (100, 200, 4)
    assert image.dtype == np.uint8
    assert not image.any()


def test_rows_run_along_y_and_columns_along_x():
    short = lane_map(segment(0, [(20.0, 4.25), (30.0, 4.25)], left=LineType.SOLID, right=LineType.NONE))
    rows, columns = np.nonzero(render(short)[..., PAINT])
    assert {cell(20, 6)[0]} <= set(rows) <= {cell(20, 6)[0] - 1, cell(20, 6)[0], cell(20, 6)[0] + 1}
    assert columns.min() == pytest.approx(cell(20, 6)[1], abs=1)
    assert columns.max() == pytest.approx(cell(30, 6)[1], abs=1)


def test_the_map_is_seen_from_the_vehicle():
    pose = np.linalg.inv(yaw_pose(np.float64(0.0), np.float64(6.0), np.float64(np.pi / 2)))
    # The line runs across the vehicle, straight through it.
    rows, columns = np.nonzero(render(LINE, pose=pose)[..., PAINT] > 100)
    assert np.abs(columns - 99.5).max() <= 1.0
    assert len(set(rows)) == 100


def test_each_thing_is_in_its_channel():
    ring = np.array([[5.0, 5, 0], [9, 5, 0], [9, 9, 0], [5, 9, 0], [5, 5, 0]])
    edge = np.array([[-20.0, -9.0, 0.0], [20.0, -9.0, 0.0]])
    image = render(lane_map(crossings=(ring,), road_boundaries=(edge,)), TRUCK)
    assert not image[..., PAINT].any()
    assert image[..., BevChannel.CROSSING][cell(7, 7)] == 255
    # The truck occludes no part of the edge at x = 0.
    assert image[..., BevChannel.ROAD_EDGE][cell(0, -9)] > 200
    assert image[..., OBSTACLE].any()


def test_occluders_leave_no_evidence_behind_them():
    behind = lane_map(segment(0, [(16.0, -1.75), (50.0, -1.75)], left=LineType.SOLID, right=LineType.NONE))
    assert render(behind)[..., PAINT].any()
    assert not render(behind, TRUCK)[..., PAINT].any()
    noisy = render(behind, TRUCK, config=dataclasses.replace(BevSensorConfig(), noise=0.0, far_error=0.0))
    deep = (slice(cell(0, -0.5)[0], cell(0, 0.5)[0]), slice(cell(20, 0)[1], None))
    assert not noisy[deep][..., PAINT].any()
    # A building hides as well, and a car does not hide what lies beyond its shadow.
    wall = np.array([[12.0, 0.0, 1.0, 20.0, 0.0]])
    assert not render(behind, buildings=wall)[..., PAINT].any()
    low = TRUCK.copy()
    low[0, 5] = 1.0
    assert render(behind, low)[..., PAINT][:, cell(40, 0)[1] :].any()


def test_only_the_faces_towards_the_sensor_are_seen():
    image = render(boxes=TRUCK)[..., OBSTACLE]
    assert image[cell(6.2, 0)] > 100
    assert image[cell(13.8, 0)] == 0
    # A car wholly behind the truck is not seen at all.
    car = np.array([[22.0, 0.0, 4.0, 1.8, 0.0, 1.5, 0.0]])
    np.testing.assert_array_equal(render(boxes=np.concatenate([TRUCK, car]))[..., OBSTACLE], image)


def test_same_seed_same_bits_and_another_frame_other_noise():
    first, again, other = (render(LINE, TRUCK, config=BevSensorConfig(), frame=f) for f in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (first != render(LINE, TRUCK, config=BevSensorConfig(), frame=3, log_seed=6)).any()


def test_wear_stays_on_the_ground_from_frame_to_frame_and_varies_along_the_line():
    config = BevSensorConfig(far_blur=0.0, far_error=0.0, lost=0.0, invented=0.0, noise=0.0)
    row = cell(0, 6)[0]
    first, later = (render(LINE, config=config, paint_wear=0.5, frame=f)[row, :, PAINT].astype(int) for f in (0, 9))
    np.testing.assert_array_equal(first, later)
    fresh = render(LINE, config=config)[row, :, PAINT].astype(int)
    assert first.sum() < 0.9 * fresh.sum()
    fraction = first[20:180] / fresh[20:180]
    assert np.ptp(fraction) > 0.3
    assert np.abs(np.diff(fraction)).max() < 0.2
    assert not render(LINE, config=config, paint_wear=1.0)[..., PAINT].any()


def test_evidence_fades_with_range_and_weather():
    config = BevSensorConfig(lost=0.0, invented=0.0, noise=0.0, far_error=0.0)
    clear, foul = (render(LINE, config=config, weather=w)[..., PAINT].astype(float) for w in (0.0, 1.0))
    near, far = slice(90, 110), slice(0, 20)
    assert clear[:, near].sum() > 1.2 * clear[:, far].sum() > 0.0
    assert foul[:, far].sum() < 0.5 * clear[:, far].sum()
    # Softer far away: the same line is wider and lower.
    assert (clear[:, near].mean(1) > 10).sum() < (clear[:, far].mean(1) > 10).sum()


def test_severity_scales_every_degradation():
    def distance(severity):
        config = BevSensorConfig(severity=severity)
        frames = [render(LINE, TRUCK, config=config, paint_wear=0.3, weather=0.3, frame=f) for f in range(6)]
        return np.abs(np.stack(frames).astype(float) - render(LINE, TRUCK)).mean()

    assert distance(0.0) == 0.0
    assert 0.0 < distance(0.3) < distance(1.0) < distance(2.0)


def test_lost_and_invented_patches_cover_about_their_fraction():
    clean = BevSensorConfig(lost=0.0, invented=0.0, noise=0.0, far_error=0.0)
    lossy = dataclasses.replace(clean, lost=0.25)
    inventive = dataclasses.replace(clean, invented=0.05)
    kept, whole = (
        np.mean([render(LINE, config=c, frame=f)[..., PAINT].astype(float).sum() for f in range(25)])
        for c in (lossy, clean)
    )
    assert kept / whole == pytest.approx(0.75, abs=0.08)
    invented = np.mean([render(config=inventive, frame=f) > 0 for f in range(12)])
    assert invented == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (10, 20)])
def test_any_grid(rows, columns):
    grid = BevGrid(PerceptionRange((-10.0, 10.0), (-5.0, 5.0)), rows, columns)
    image = render(LINE, TRUCK, config=BevSensorConfig(grid=grid))
    assert image.shape == (rows, columns, 4)

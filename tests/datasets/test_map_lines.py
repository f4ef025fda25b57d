"""The lines of an example."""

import dataclasses
import itertools

import numpy as np
import pytest

from tests.datasets.small_logs import drive, lane_map, log, segment, tracks
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.leaves import example_from_leaves, example_leaves
from tflane_jax.datasets.map_lines import DENSE_POINTS, MapLinesConfig, crop_map_lines
from tflane_jax.datasets.prepared_map import prepare_map
from tflane_jax.datasets.procedural import STREET_EXAMPLE, ProceduralConfig, ProceduralDataset, WorldData
from tflane_jax.geometry import PerceptionRange, relative_pose, resample, transform_points
from tflane_jax.scene import LineClass
from tflane_jax.world.presets import STREET

CROSSING = np.array([[5, -2, 0], [8, -2, 0], [8, 6, 0], [5, 6, 0], [5, -2, 0]], float)
ROAD = lane_map(
    segment(0, [(-60.0, 0.0), (60.0, 0.0)]),
    segment(1, [(60.0, 3.5), (-60.0, 3.5)]),
    crossings=(CROSSING,),
    road_boundaries=(np.array([[-60.0, -2, 0], [60, -2, 0]]), np.array([[60.0, 6, 0], [-60, 6, 0]])),
)
RANGE = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))


def crop(config, buildings=(), vector_map=ROAD, pose=None):
    return crop_map_lines(
        prepare_map(vector_map, bike_lanes=True).geometry,
        np.eye(4) if pose is None else pose,
        RANGE,
        config,
        boxes=np.zeros((0, 7)),
        buildings=np.asarray(buildings, float).reshape(-1, 5),
    )


def test_lines_of_every_class_are_cut_and_resampled():
    lines, dropped = crop(MapLinesConfig(lines=8, points=7, centerlines="include"))
    lines.validate()
    assert dropped == 0
    classes = [LineClass.DIVIDER, LineClass.CROSSING, *[LineClass.BOUNDARY] * 2, *[LineClass.CENTERLINE] * 2]
    assert lines.category[lines.valid].tolist() == classes
    assert lines.closed.tolist() == [False, True] + [False] * 6
    np.testing.assert_allclose(lines.points[0], [(x, 1.75, 0) for x in np.linspace(-30, 30, 7)], atol=1e-5)
    np.testing.assert_array_equal(lines.points[1, 0], lines.points[1, -1])
    # Centerlines keep their driving direction.
    assert lines.points[4, 0, 0] < 0 < lines.points[5, 0, 0]
    assert len(set(lines.identity[:4].tolist())) == 4
    three, _ = crop(MapLinesConfig(lines=8, points=7))
    assert three.category[three.valid].tolist() == classes[:4]


def test_the_dense_form_has_every_corner_of_the_lines():
    step = np.array([[-20.0, -9, 0], [0, -9, 1], [0, 9, 2], [20, 9, 3]])
    lines, _ = crop(
        MapLinesConfig(lines=4, points=3), vector_map=lane_map(road_boundaries=(step,), crossings=(CROSSING,))
    )
    lines.validate()
    assert lines.dense.shape == (4, DENSE_POINTS, 3)
    (boundary,) = np.flatnonzero(lines.valid & (lines.category == LineClass.BOUNDARY))
    np.testing.assert_allclose(lines.dense[boundary], resample(step, DENSE_POINTS), atol=1e-5)
    assert np.linalg.norm(lines.dense[boundary, :, :2] - [0, -9], axis=-1).min() < 0.3
    np.testing.assert_array_equal(lines.dense[:, 0][lines.closed], lines.dense[:, -1][lines.closed])
    assert not lines.dense[~lines.valid].any()
    nothing, _ = crop(MapLinesConfig(lines=4), vector_map=lane_map())
    assert nothing.dense.shape == lines.dense.shape  # so that examples of one data set stack
    assert not nothing.dense.any()


def test_visibility_is_the_fraction_in_line_of_sight():
    wall = [10.0, 0.0, 2.0, 100.0, 0.0]  # hides everything beyond x = 9
    lines, _ = crop(MapLinesConfig(), buildings=[wall])
    assert lines.visibility[0] == pytest.approx(39 / 60, abs=0.02)
    assert lines.visibility[1] == 1.0  # the crossing ends before the wall


def test_overflow_drops_the_farthest_and_says_so():
    example = ExampleConfig(range=RANGE, map_lines=MapLinesConfig(lines=2), sensor=None)
    recording = log(ROAD, tracks(np.zeros((30, 1, 3))), [np.eye(4)] * 30, [(25, np.eye(4))])
    with pytest.warns(TruncationWarning, match=r"map_lines\.lines = 2"):
        lines = make_example(recording, 0, example).map_lines
    assert lines is not None
    assert lines.category[lines.valid].tolist() == [LineClass.DIVIDER, LineClass.BOUNDARY]


def test_lines_are_left_out_by_default_and_change_nothing_else():
    recording = log(ROAD, tracks(np.zeros((30, 1, 3))), drive(30), [(25, np.eye(4))])
    without = example_leaves(make_example(recording, 0, ExampleConfig(range=RANGE)))
    made = make_example(recording, 0, ExampleConfig(range=RANGE, map_lines=MapLinesConfig()))
    leaves = example_leaves(made)
    assert not any(name.startswith("map_lines") for name in without)
    for name, values in without.items():
        np.testing.assert_array_equal(leaves[name], values)
    back = example_from_leaves(leaves).map_lines
    assert back is not None
    np.testing.assert_array_equal(back.identity, made.map_lines.identity)
    np.testing.assert_array_equal(back.dense, made.map_lines.dense)


def test_identities_of_the_world_stay_with_their_lines():
    config = dataclasses.replace(
        WorldData.street().source("train"),
        scenes=2,
        example=dataclasses.replace(STREET_EXAMPLE, map_lines=MapLinesConfig()),
    )
    assert isinstance(config, ProceduralConfig)
    dataset, frames = ProceduralDataset(config), STREET.keyframes
    for scene in range(2):
        first, last = (scene * frames + i for i in (0, 1))
        before, after = (dataset.example(i).map_lines for i in (first, last))
        moved = relative_pose(dataset.info(first).global_from_ego, dataset.info(last).global_from_ego)
        common = set(before.identity[before.valid].tolist()) & set(after.identity[after.valid].tolist())
        assert common
        for name in common:
            here = transform_points(moved, after.points[after.valid & (after.identity == name)].reshape(-1, 3))
            there = before.points[before.valid & (before.identity == name)]
            dense = np.concatenate([np.linspace(a, b, 50) for l in there for a, b in itertools.pairwise(l)])
            distance = np.linalg.norm(here[:, None, :2] - dense[None, :, :2], axis=-1).min(1)
            assert np.median(distance) < 0.3

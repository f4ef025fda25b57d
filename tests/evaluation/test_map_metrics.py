"""Lines of a vector map: detections, groups, consistency; on examples by hand and on the built-in world."""

import dataclasses
import functools
import itertools

import jax
import numpy as np
import pytest

from tests.fakes import fake_example
from tflane_jax.datasets.map_geometry import MapGeometry
from tflane_jax.datasets.map_lines import MapLinesConfig, crop_map_lines
from tflane_jax.datasets.procedural import STREET_EXAMPLE, ProceduralDataset, WorldData
from tflane_jax.evaluation.found_lanes import detection_scores
from tflane_jax.evaluation.lane_groups import LANE_GROUPS, line_groups
from tflane_jax.evaluation.map_metrics import MapLineMetrics
from tflane_jax.evaluation.vector_maps import detections_of_lines
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.metrics.map_matching import LINE_CLASSES
from tflane_jax.scene import BevChannel, LineClass, LinePrediction, MapLines

LABELS = ("visibility", "identity")


@functools.cache
def world():
    """Return two scenes of the street preset, frame by frame, with lines of all four classes."""
    lines = MapLinesConfig(lines=32, centerlines="include")
    example = dataclasses.replace(STREET_EXAMPLE, map_lines=lines, sensor=None)
    config = dataclasses.replace(WorldData.street().source("val"), scenes=2, example=example)
    dataset = ProceduralDataset(config)
    return [dataset.example(i) for i in range(len(dataset))]


def perfect(lines, *, classes=4, score=4.0):
    """Return the valid lines as predictions."""
    kind = np.eye(4, dtype=bool)[lines.category] & lines.valid[:, None]
    return LinePrediction(
        np.where(lines.valid[:, None, None], lines.dense, 0.0), np.where(kind, score, -9.0)[:, :classes]
    )


def winding(points=2000):
    """Return a line with twelve bends, whose chords between 20 points miss most of it."""
    x = np.linspace(-28.0, 28.0, points)
    return np.column_stack([x, 4.0 * np.sin(x * 12.0 * np.pi / 56.0), 0.1 * x])


@pytest.mark.parametrize("dims", [2, 3])
def test_the_original_line_is_the_truth_and_not_its_few_points(dims):
    geometry = MapGeometry.of(dividers=[winding()])
    nothing = {"boxes": np.zeros((0, 7)), "buildings": np.zeros((0, 5))}
    range_ = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))
    lines, _ = crop_map_lines(geometry, np.eye(4), range_, MapLinesConfig(lines=3), **nothing)
    logits, found = np.array([[4.0, -9.0, -9.0]]), []
    for drawn in (winding(), lines.points[0]):
        for truth in (lines, lines.replace(dense=None)):
            metrics = MapLineMetrics(labels=LABELS, dims=dims)
            example = fake_example().replace(map_lines=truth)
            metrics.update(LinePrediction(drawn[None, :, :dims], logits), example)
            found.append(metrics.compute()["lines"]["AP_divider@0.5"])
    # The original line, then its 20 points, each against the original line and against the 20 points.
    assert found == [1.0, 0.0, 0.0, 1.0]


def score(predict, **options):
    metrics = MapLineMetrics(labels=LABELS, **options)
    for number, example in enumerate(world()):
        metrics.update(predict(number, example.map_lines), example)
    return metrics.compute()


def test_the_world_gives_its_own_lines_the_full_score():
    found = score(lambda _, lines: perfect(lines), measures=("chamfer", "iou"))
    whole = found["lines"]
    present = [name for name in LINE_CLASSES if whole[f"AP_{name}"] > 0.0]
    assert {"divider", "boundary", "centerline"} <= set(present)
    assert all(whole[f"AP_{name}"] == 1.0 for name in present)
    assert whole["recall"] == 1.0
    assert whole["lines"] == sum(example.map_lines.valid.sum() for example in world())
    assert all(found["lines IoU"][f"AP_{name}"] == 1.0 for name in present)
    # The same lines are found as the same ones in every frame: the identities agree with those of the map.
    for name in present[:-1]:
        assert whole[f"C-AP_{name}"] == 1.0, name
    assert found["lines occluded"]["lines"] + found["lines clear"]["lines"] == whole["lines"]


def test_detections_of_low_confidence_have_an_ap_but_no_consistency():
    found = score(lambda _, lines: perfect(lines, score=-1.0))["lines"]
    assert found["AP_divider"] == 1.0
    assert found["C-mAP"] == 0.0


def test_lines_that_come_and_go_are_consistent_and_lines_that_jump_are_not():
    def jumping(number, lines):
        # In every second frame, all lines but one lie 8 m aside, where in the next frame none is.
        moved = perfect(lines)
        return moved.replace(points=moved.points + np.array([0.0, 1.2 * (-1) ** number, 0.0]))

    still, jumps = score(lambda _, lines: perfect(lines))["lines"], score(jumping)["lines"]
    # Found within 1.5 m in all frames, but 2.4 m away from where the line was before.
    assert jumps["AP_divider@1.5"] == 1.0
    assert jumps["C-AP_divider"] < 0.7 * still["C-AP_divider"]


@pytest.mark.parametrize("classes", [3, 4])
def test_a_model_is_measured_on_its_classes(classes):
    """Regression: the protocol was that of no frame, and never told of centerlines."""
    metrics = MapLineMetrics(labels=LABELS)
    for example in world()[:2]:
        metrics.update(perfect(example.map_lines, classes=classes), example)
    found = metrics.compute()["lines"]
    assert ("AP_centerline" in found) == (classes == 4)
    assert ("with centerlines" in metrics.protocol) == (classes == 4)
    assert found["recall"] == 1.0


def test_a_frame_counts_in_its_group_given_as_to_all_accumulators():
    """Regression: the third argument was `members`, so that a group of frames in its place was lost without a word."""
    metrics = MapLineMetrics(labels=LABELS, frame_groups=("near", "far"))
    for example, group in zip(world()[:2], ("near", "far"), strict=True):
        metrics.update(perfect(example.map_lines), example, group)
    lanes = {name: int(counts[:, 0].sum()) for name, counts in metrics.recalled().items()}
    assert lanes["lines near"] > 0
    assert lanes["lines far"] > 0
    assert lanes["lines near"] + lanes["lines far"] == lanes["lines"]


@pytest.mark.parametrize("labels", [(), ("visibility",)])
def test_the_protocol_names_the_limit_of_groups_that_are_measured(labels):
    assert ("occluded" in MapLineMetrics(labels=labels).protocol) == ("visibility" in labels)


def test_a_model_with_heights_is_measured_with_them():
    for dims, expected in ((2, 1.0), (3, 0.0)):
        metrics = MapLineMetrics(labels=LABELS, dims=dims)
        for example in world()[:2]:
            lines = perfect(example.map_lines)
            metrics.update(lines.replace(points=lines.points + np.array([0.0, 0.0, 5.0])), example)
        assert metrics.compute()["lines"]["recall"] == expected


def test_the_best_pairs_of_query_and_class_are_detections():
    logits = np.array([[2.0, 1.0, -5.0], [-3.0, -4.0, -6.0], [-9.0, 0.0, -9.0]])
    points = np.arange(3.0)[:, None, None] + np.zeros((3, 4, 2))
    found = detections_of_lines(LinePrediction(points, logits))
    assert np.asarray(found.points)[:, 0, 0].tolist() == [0.0, 0.0, 2.0]
    assert found.classes.tolist() == [0, 1, 1]
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp(-np.array([2.0, 1.0, 0.0]))))


def test_at_most_fifty_pairs_are_detections():
    """As in MapTRv2's variant with 70 lines and four classes; a host of 50 lines or fewer has one for each."""
    logits = np.random.default_rng(0).normal(size=(70, 4))
    found = LinePrediction(np.zeros((70, 4, 2)), logits)
    best = np.sort(1 / (1 + np.exp(-logits.ravel())))[::-1][:50]
    np.testing.assert_allclose(detections_of_lines(found).scores, best)
    np.testing.assert_allclose(detection_scores(found), best)
    assert len(detections_of_lines(LinePrediction(np.zeros((49, 4, 2)), logits[:49])).scores) == 49


def straight(y, start=-15.0, stop=15.0):
    return np.linspace((start, y, 0.0), (stop, y, 0.0), 5)


def test_groups_of_lines_by_evidence_and_traffic():
    grid, example = BevGrid(), fake_example()
    bev = np.zeros((grid.rows, grid.columns, 4), np.uint8)
    ring = np.array([[8, -5, 0], [11, -5, 0], [11, 15, 0], [8, 15, 0], [8, -5, 0]], float)
    for channel, line in ((BevChannel.LANE_PAINT, straight(0)), (BevChannel.CROSSING, ring)):
        dense = np.concatenate([np.linspace(a, b, 60) for a, b in itertools.pairwise(line)])
        column, row = np.round(grid.pixel(dense)).astype(int).T
        bev[row, column, channel] = 255
    flow = example.traffic_flow
    flow.category[0], flow.valid[:], flow.occluded[:] = 0, False, False
    flow.valid[0], flow.yaw[0] = True, np.pi  # against the direction of the lines
    flow.position[0, :, 0], flow.position[0, :, 1] = np.linspace(15, -15, flow.valid.shape[1]), 1.8
    rows = [straight(0), straight(3.5), straight(7), straight(20), ring, straight(1.75)]
    kinds = [LineClass.DIVIDER] * 4 + [LineClass.CROSSING, LineClass.CENTERLINE]
    lines = MapLines.empty(8, 5)
    lines.points[:6], lines.category[:6], lines.valid[:6] = rows, kinds, True
    lines.points[6:] = np.nan
    groups = line_groups(lines, bev, flow, grid.range)
    names = [[name for name in LANE_GROUPS if groups[name][i]] for i in range(6)]
    # Paint on the line; beside the vehicle; one lane farther; far away; a striped crossing; a lane beside the paint.
    assert names == [
        ["visible+traffic"],
        ["hidden+traffic"],
        ["hidden-traffic"],
        ["hidden-traffic", "hidden-neighbours"],
        [],
        ["visible+traffic"],
    ]


def test_a_group_has_its_lines_and_the_detections_nearest_to_them():
    example = jax.tree.map(np.asarray, fake_example())
    lines = MapLines.empty(3, 5)
    lines.points[:2], lines.valid[:2] = [straight(0), straight(10)], True
    lines.visibility[:] = 0.0, 1.0, 1.0
    example = example.replace(map_lines=lines)
    # The first line is found; a false detection lies 4 m from it, another one 3 m from the second line.
    points = np.stack([straight(0), straight(-4), straight(13)])
    logits = np.full((3, 3), -9.0)
    logits[:, 0] = 1.0, 2.0, 3.0
    metrics = MapLineMetrics(labels=LABELS)
    metrics.update(LinePrediction(points, logits), example)
    found = metrics.compute()
    assert found["lines occluded"]["AP_divider"] == 0.5
    assert found["lines clear"]["AP_divider"] == 0.0
    assert (found["lines occluded"]["lines"], found["lines clear"]["lines"]) == (1, 1)
    assert found["lines"]["AP_divider"] == pytest.approx(1 / 6)

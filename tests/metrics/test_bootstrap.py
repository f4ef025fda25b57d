"""Metrics of bootstrap samples against the same metrics of data sets in which scenes are really repeated."""

import dataclasses
from functools import partial
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.cases import random_frame
from tests.metrics.segments import random_segments
from tflane_jax.errors import UserError
from tflane_jax.metrics import (
    CenterlineMetrics,
    ElementDetections,
    ElementTruth,
    GroupedMetrics,
    LaneSegmentMetrics,
    MapConsistency,
    MapDetections,
    MapTruth,
    VectorMapMetrics,
)
from tflane_jax.metrics import bootstrap as module
from tflane_jax.metrics.bootstrap import bootstrap_mean, bootstrap_precisions, frame_numbers
from tflane_jax.metrics.map_matching import match_map
from tflane_jax.metrics.matching import average_precision_11, average_precision_area
from tflane_jax.metrics.segment_matching import CROSSING, AreaDetections, AreaTruth

# Two frames a scene; the last sample lacks a scene that has a frame of its own kind.
SCENE = np.array([0, 0, 1, 1, 2, 2])
WEIGHTS = np.array([[1, 1, 1], [2, 0, 1], [0, 3, 0], [1, 2, 0]])
NAMES = ("near", "far", "near")


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6), count=st.integers(0, 40), frames=st.integers(1, 5), levels=st.sampled_from([3, 1000])
)
def test_precisions_of_samples_are_those_of_repeated_detections(seed, count, frames, levels):
    """Copies of a detection follow each other, so that equal scores are in the same order."""
    rng = np.random.default_rng(seed)
    frame, scores = np.sort(rng.integers(0, frames, count)), rng.integers(0, levels, count) / levels
    hits = rng.random((2, count)) < rng.choice([0.0, 0.3, 0.8])
    truths = np.bincount(frame, hits.any(0), minlength=frames).astype(int) + rng.integers(0, 3, frames)
    weights = np.vstack([np.ones(frames, int), np.zeros(frames, int), rng.integers(0, 4, (5, frames))])
    with mock.patch.object(module, "_BLOCK", 1 if seed % 2 else 2**22):
        found = bootstrap_precisions(scores, hits, frame, truths, weights)
    for b, weight in enumerate(weights):
        times = weight[frame]
        for k, row in enumerate(hits):
            drawn = np.repeat(scores, times), np.repeat(row, times), int(weight @ truths)
            assert found[0][b, k] == average_precision_11(*drawn)
            assert found[1][b, k] == pytest.approx(average_precision_area(*drawn), abs=1e-12)


def test_a_mean_without_anything_to_count_is_zero():
    parts = np.array([[0.5, 2.0], [0.0, 0.0]])
    np.testing.assert_allclose(bootstrap_mean(parts, np.array([[2, 1], [0, 2]])), [0.25, 0.0])


def test_frames_of_pooled_detections():
    detections = [(np.zeros(n), np.zeros((3, n))) for n in (2, 0, 1)]
    assert frame_numbers(detections).tolist() == [0, 0, 2]
    assert frame_numbers([]).tolist() == []


def distinct(detections, number):
    """Return detections whose scores no other frame has: the order of equal ones is left open."""
    return dataclasses.replace(detections, scores=np.asarray(detections.scores) * 0.9 + 1e-4 * (number + 1))


def with_elements(frame, number):
    """Return a frame with traffic elements of two attributes, some of which lie on true ones."""
    detections, truth = frame
    rng = np.random.default_rng([3, number])
    boxes = np.cumsum(rng.uniform(5.0, 20.0, (3, 2, 2)), 1)
    found, p = np.concatenate([boxes + rng.normal(0, 2, boxes.shape), boxes[:1] + 300.0]), len(detections.scores)
    elements = ElementDetections(
        boxes=found,
        attributes=np.array([0, 4, 4, 0]),
        scores=rng.permutation(4) / 5 + 1e-4 * number,
        lane=rng.random((p, 4)),
    )
    true = ElementTruth(boxes=boxes, attributes=np.array([0, 4, 4]), lane=rng.random((len(truth.points), 3)) < 0.4)
    return dataclasses.replace(detections, elements=elements), dataclasses.replace(truth, elements=true)


def centerlines(number):
    detections, truth = random_frame(number, lanes=3 + number % 3 if number != 4 else 0, detections=8)
    return with_elements((distinct(detections, number), truth), number)


def segments(number):
    detections, truth = random_segments(np.random.default_rng([5, number]))
    areas = distinct(detections.areas, number)
    return dataclasses.replace(detections, lanes=distinct(detections.lanes, number), areas=areas), truth


def lines(number, centerlines=True):
    """Return lines of all classes; only the last scene has centerlines."""
    rng = np.random.default_rng([7, number])
    classes = np.array([0, 0, 1, 2, *([3, 3] if centerlines and number > 3 else [])])
    true = rng.uniform(-10, 10, (len(classes), 1, 2)) + np.cumsum(rng.uniform(0, 3, (len(classes), 4, 2)), 1)
    found = [*(true + rng.normal(0, 0.6, (len(true), 1, 2))), *(true[:2] + 3.0)]
    detections = MapDetections(found, np.concatenate([classes, classes[:2]]), rng.permutation(len(found)) / len(found))
    return distinct(detections, number), MapTruth(list(true), classes)


def update(metrics, number, make):
    metrics.update(*make(number))


def update_groups(metrics, number, make):
    detections, truth = make(number)
    lanes = getattr(truth, "lanes", truth)
    metrics.update(detections, truth, NAMES[SCENE[number]], {"odd": np.arange(len(lanes.points)) % 2 == 1})


GROUPS = {"frame_groups": ("near", "far"), "lane_groups": ("odd",)}
CASES = {
    "centerlines": (lambda: CenterlineMetrics(("v2.1", "v1.0")), update, centerlines),
    "centerlines, groups": (lambda: GroupedMetrics(CenterlineMetrics, **GROUPS), update_groups, centerlines),
    "segments": (lambda: LaneSegmentMetrics("LaneSegNet"), update, segments),
    "segments, devkit": (LaneSegmentMetrics, update, segments),
    "segments, groups": (
        lambda: GroupedMetrics(partial(LaneSegmentMetrics, "LaneSegNet"), **GROUPS),
        update_groups,
        segments,
    ),
    "lines": (VectorMapMetrics, update, lines),
    "lines, groups": (lambda: GroupedMetrics(VectorMapMetrics, ("all",), **GROUPS), update_groups, lines),
    "lines without centerlines": (VectorMapMetrics, update, lambda number: lines(number, centerlines=False)),
}
NAMES_OF = {
    "centerlines": {"DET_l", "AP_l", "TOP_ll", "TOP_ll_v1.0", "DET_t", "TOP_lt", "TOP_lt_v1.0", "OLS", "OLS_v1.0"},
    "centerlines, groups": {"all/OLS", "occluded/DET_l", "near/DET_t", "far/OLS", "odd/AP_l", "odd/TOP_ll"},
    "segments": {"AP_ls", "AP_l", "AP_ped", "AP_boundary", "mAP", "TOP_lsls"},
    "segments, devkit": {"DET_l", "DET_a", "AP_l", "TOP_ll"},
    "segments, groups": {"all/mAP", "clear/AP_ls", "near/AP_ped", "odd/TOP_lsls"},
    "lines": {"mAP", "AP_divider", "AP_ped_crossing", "AP_boundary", "AP_centerline"},
    "lines, groups": {"all/AP_centerline", "near/AP_centerline", "far/mAP", "odd/AP_divider"},
    "lines without centerlines": {"mAP", "AP_divider", "AP_ped_crossing", "AP_boundary"},
}


def flat(values):
    """Return numbers by name, those of groups by "group/name"."""
    if not any(isinstance(value, dict) for value in values.values()):
        return values
    return {f"{group}/{name}": value for group, inner in values.items() for name, value in inner.items()}


@pytest.mark.parametrize("case", CASES)
def test_a_sample_has_the_numbers_of_scenes_that_are_really_repeated(case):
    make, add, frame = CASES[case]
    metrics = make()
    for number in range(len(SCENE)):
        add(metrics, number, frame)
    samples = flat(metrics.bootstrap(WEIGHTS[:, SCENE]))
    expected_names = NAMES_OF[case]
    assert expected_names <= set(samples) if "groups" in case else expected_names == set(samples)
    for b, times in enumerate(WEIGHTS):
        again = make()
        for scene in np.repeat(np.arange(3), times):
            for number in np.flatnonzero(scene == SCENE):
                add(again, number, frame)
        sampled = hasattr(again, "compute_sample")  # groups have none
        expected = again.compute_sample(metrics) if sampled else flat(again.compute())
        # Without centerlines there is no class of them, and without frames of a group fewer of its numbers.
        assert times.min() == 0 or samples.keys() <= expected.keys()
        for name in samples.keys() & expected.keys():
            assert samples[name][b] == pytest.approx(expected[name], abs=1e-12), (name, times)
        spread = {name for name in samples if np.ptp(samples[name]) > 1e-3}
        assert len(spread) > len(samples) / 2
    parts = make(), make()
    for number, scene in enumerate(SCENE):
        add(parts[int(scene > 0)], number, frame)
    merged = parts[0].merge(parts[1])
    of_merged = flat(merged.bootstrap(WEIGHTS[:, SCENE]))
    assert of_merged.keys() == samples.keys()
    for name, values in samples.items():
        np.testing.assert_array_equal(of_merged[name], values, err_msg=name)


def test_what_a_sample_lacks_does_not_count_in_its_means():
    """Regression: detections of an attribute or a category that a sample has none of made it 0."""
    centerline, segment = CenterlineMetrics(), LaneSegmentMetrics("LaneSegNet")
    devkit = LaneSegmentMetrics()
    for number in range(2):
        lanes, truth = random_frame(number, lanes=3, detections=4)
        box = np.array([[[0.0, 0.0], [9.0, 9.0]]])
        elements = ElementDetections(
            boxes=np.concatenate([box, box + 50.0]),
            attributes=np.array([number, 1 - number]),
            scores=np.array([0.9, 0.1]),
            lane=np.zeros((4, 2)),
        )
        true = ElementTruth(boxes=box, attributes=np.array([number]), lane=np.zeros((3, 1), bool))
        centerline.update(dataclasses.replace(lanes, elements=elements), dataclasses.replace(truth, elements=true))
        found, there = random_segments(np.random.default_rng(number))
        ring = np.array([[0.0, 0.0], [0.0, 4.0], [9.0, 4.0], [9.0, 0.0], [0.0, 0.0]])
        ring = np.pad(np.repeat(ring, 4, 0), ((0, 0), (0, 1)))
        areas = AreaDetections([ring], np.array([CROSSING]), np.array([0.9 - 0.5 * number]))
        real = AreaTruth([ring] * (1 - number), np.array([CROSSING] * (1 - number), int))
        for metrics in (segment, devkit):
            metrics.update(dataclasses.replace(found, areas=areas), dataclasses.replace(there, areas=real))
    weights = np.array([[1, 1], [2, 0], [0, 2]])
    # Eleven attributes have neither truths nor detections, which is 1 officially; of two each frame has one.
    assert centerline.compute()["DET_t"] == 1.0
    np.testing.assert_allclose(centerline.bootstrap(weights)["DET_t"], 1.0)
    single = CenterlineMetrics()
    single.update(*with_elements((random_frame(0, lanes=3, detections=4)), 0))
    lanes, truth = random_frame(1, lanes=3, detections=4)
    nothing = CenterlineMetrics()
    none = ElementTruth(np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros((3, 0), bool))
    found = ElementDetections(np.zeros((0, 2, 2)), np.zeros(0, int), np.zeros(0), np.zeros((4, 0)))
    nothing.update(dataclasses.replace(lanes, elements=found), dataclasses.replace(truth, elements=none))
    whole = single.merge(nothing)
    assert nothing.compute_sample(whole)["DET_t"] == 1.0  # eleven attributes that no frame has
    assert "DET_t@0" not in nothing.compute_sample(whole)
    samples = segment.bootstrap(weights)
    assert samples["AP_ped"].tolist() == [1.0, 1.0, 0.0]
    np.testing.assert_allclose(samples["mAP"][2], samples["AP_ls"][2])
    np.testing.assert_allclose(samples["mAP"][:2], (samples["AP_ls"][:2] + 1.0) / 2)
    # No true boundary and no detection of one: 1 officially, in every sample.
    np.testing.assert_allclose(devkit.bootstrap(weights)["DET_a"], 1.0)


def test_some_frames_have_no_number_of_areas_that_they_lack():
    metrics = LaneSegmentMetrics("LaneSegNet")
    found, there = random_segments(np.random.default_rng(0))
    none = AreaTruth([], np.zeros(0, int))
    metrics.update(found, dataclasses.replace(there, areas=none))
    part, whole = metrics.compute("frames"), metrics.compute()
    assert part.keys() & {"AP_ped", "AP_boundary"} == set()
    assert part["mAP"] == part["AP_ls"] == whole["AP_ls"]
    assert whole["mAP"] < whole["AP_ls"]
    devkit = LaneSegmentMetrics()
    devkit.update(found, dataclasses.replace(there, areas=none))
    assert "DET_a" not in devkit.compute("frames")


def test_consistency_of_samples():
    def run(scenes):
        metrics = MapConsistency()
        for scene in scenes:
            metrics.start()
            for number in np.flatnonzero(scene == SCENE):
                matched = match_map(*lines(number))
                count = len(matched.scores), matched.lanes
                identities = np.random.default_rng([9, number]).integers(0, 3, count[0])
                metrics.add(matched, identities, np.arange(count[1]))
        return metrics

    samples = run(range(3)).bootstrap(WEIGHTS[:, SCENE])
    assert np.ptp(samples["C-mAP"]) > 0.01
    for b, times in enumerate(WEIGHTS):
        expected = run(np.repeat(np.arange(3), times)).compute()
        assert {name: values[b] for name, values in samples.items()} == pytest.approx(expected, abs=1e-12)


def test_elements_that_some_frames_lack_have_no_samples():
    """Of their detections, the frames would be wrong."""
    metrics = CenterlineMetrics()
    detections, truth = centerlines(0)
    metrics.update(dataclasses.replace(detections, elements=None), truth)
    metrics.update(*centerlines(1))
    with pytest.raises(UserError, match="traffic elements are missing in 1 of 2 frames"):
        metrics.bootstrap(np.ones((1, 2), int))


def test_means_are_the_scores():
    metrics = CenterlineMetrics(("v2.1", "v1.0"))
    for number in range(len(SCENE)):
        metrics.update(*centerlines(number))
    expected, found = metrics.compute(), metrics.means()
    assert set(found) == {"TOP_ll", "TOP_ll_v1.0", "TOP_lt", "TOP_lt_v1.0"}
    for name, parts in found.items():
        assert parts.shape == (6, 2)
        assert parts[:, 0].sum() / parts[:, 1].sum() == pytest.approx(expected[name])


@pytest.mark.parametrize(
    ("weights", "wrong"),
    [
        (np.ones(6, int), r"shape \(6,\), expected \(samples, 6\)"),
        (np.ones((2, 5), int), r"shape \(2, 5\), expected \(samples, 6\)"),
        (np.ones((2, 6)), "give integers of 0 and more"),
        (np.full((2, 6), -1), "give integers of 0 and more"),
        (np.full((2, 6), np.nan), "give integers of 0 and more"),
    ],
)
def test_weights_that_count_no_frames_are_refused(weights, wrong):
    metrics = GroupedMetrics(CenterlineMetrics, **GROUPS)
    for number in range(6):
        update_groups(metrics, number, centerlines)
    for function in (metrics.bootstrap, lambda weights: bootstrap_mean(np.ones((6, 2)), weights)):
        with pytest.raises(UserError, match=wrong):
            function(weights)

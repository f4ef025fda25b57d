"""MapTR's metric against the official evaluator, and against numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.fixtures import expected_cases, load_maps
from tflane_jax.errors import UserError
from tflane_jax.metrics import GroupedMetrics, MapDetections, MapTruth, VectorMapMetrics
from tflane_jax.metrics.map_matching import CLASSES, MAP_THRESHOLDS, Sampling, match_map

# What the official program calls the three ways of sampling detections.
KEYS: dict[Sampling, str] = {
    "maptr": "chamfer",
    "maptrv2": "chamfer_maptrv2",
    "as_given": "chamfer_no_pred_resampling",
}
CASES = list(expected_cases("maptr"))
# Without resampling the official program needs one number of points for all detections, and it gives no numbers for a
# stable order of equal scores.
TOTALS = [
    (case, sampling)
    for case, expected in expected_cases("maptr").items()
    for sampling in KEYS
    if expected[KEYS[sampling]] is not None and not (expected["tie_sensitive"] and sampling == "as_given")
]

OVERLAP_CASES = [
    case for case, expected in expected_cases("maptr").items() if expected["iou"] and not expected["tie_sensitive"]
]


def evaluate(frames, sampling: Sampling = "maptr"):
    metrics = VectorMapMetrics(sampling)
    for detections, truth in frames:
        metrics.update(detections, truth)
    return metrics.compute()


@pytest.mark.golden
@pytest.mark.parametrize(("case", "sampling"), TOTALS)
def test_golden_totals(case, sampling):
    expected = expected_cases("maptr")[case]
    official = expected[KEYS[sampling]]
    official = expected["chamfer"] if official == "same" else official
    stable = expected["stable_sort_differs"] if official is expected["chamfer"] else {}
    result = evaluate([frame[:2] for frame in load_maps(case)], sampling)

    def check(ours, *path):
        value, name = official, path[0] + "".join(f"[{i}]" for i in path[1:])
        for step in path:
            value = value[step]
        assert result[ours] == pytest.approx(stable.get(name, value), abs=1e-6), name

    check("mAP", "mAP")
    assert result["lines"] == sum(official["num_gts"])
    for c, name in enumerate(CLASSES):
        check(f"AP_{name}", "AP_per_class", c)
        for t, threshold in enumerate(MAP_THRESHOLDS):
            check(f"AP_{name}@{threshold}", "AP_per_threshold_class", t, c)
    for t, threshold in enumerate(MAP_THRESHOLDS):
        check(f"mAP@{threshold}", "eval_map_mean_over_classes_with_gt", t)


@pytest.mark.golden
@pytest.mark.parametrize("case", OVERLAP_CASES)
def test_golden_overlap(case):
    expected = expected_cases("maptr")[case]
    official, metrics = expected["iou"], VectorMapMetrics(measure="iou")
    for detections, truth, _ in load_maps(case):
        metrics.update(detections, truth)
    result = metrics.compute()
    assert result["mAP"] == pytest.approx(official["mAP"], abs=1e-6)
    for c, name in enumerate(CLASSES):
        ours = [result[f"AP_{name}@{t}"] for t in metrics.thresholds]
        assert ours == pytest.approx([row[c] for row in official["AP_per_threshold_class"]], abs=1e-6)


@pytest.mark.golden
@pytest.mark.parametrize("case", CASES)
def test_golden_distances_and_matches(case):
    expected = expected_cases("maptr")[case]
    for detections, truth, official in load_maps(case):
        frame = match_map(detections, truth)
        for c, by_class in enumerate(official):
            members = frame.classes == c
            score = by_class["score"]
            assert len(score) == members.sum()
            if score.shape[1]:
                distance = -score.max(1)
                distance[distance > MAP_THRESHOLDS[-1]] = np.inf
                np.testing.assert_allclose(frame.distance[members], distance, atol=1e-6)
                lines = np.flatnonzero(np.asarray(truth.classes) == c)
                near = np.isfinite(distance)
                np.testing.assert_array_equal(frame.nearest[members][near], lines[score.argmax(1)][near])
            if not expected["tie_sensitive"]:
                np.testing.assert_array_equal(frame.hits[:, members], by_class["hits"])


def line(x, y=(0.0, 10.0)):
    """Return a line along y at the given x."""
    return np.array([(x, value) for value in y])


def frame(true, found, scores, classes=None):
    """Return a frame of dividers (or other classes) with the given lines."""
    true_classes, found_classes = classes or (np.zeros(len(true), int), np.zeros(len(found), int))
    detections = MapDetections(found, np.array(found_classes), np.array(scores, float))
    return detections, MapTruth(true, np.array(true_classes))


def test_by_hand():
    # 0.5 m aside counts at the threshold 0.5 (not so in OpenLane-V2). At 0.5 and 1 m the better detection is false, and
    # the second finds the line at precision 1/2; at 1.5 m the better one takes it and the second is false.
    result = evaluate([frame([line(0)], [line(1.25), line(0.5)], [0.9, 0.8])])
    assert [result[f"AP_divider@{t}"] for t in MAP_THRESHOLDS] == [0.5, 0.5, 1.0]
    assert result["AP_divider"] == pytest.approx(2 / 3)
    # Classes without truth pull the mean down, but not that of one threshold.
    assert result["mAP"] == pytest.approx(2 / 9)
    assert [result[f"mAP@{t}"] for t in MAP_THRESHOLDS] == [0.5, 0.5, 1.0]
    assert (result["frames"], result["lines"]) == (1, 1)


@pytest.mark.parametrize(("measure", "expected"), [("chamfer", 5 / 6), ("iou", 11 / 20)])
def test_recall_is_the_mean_over_the_thresholds_of_the_measure(measure, expected):
    """One of two lines is 0.6 m off: found at 1 and 1.5 m; its 2 m wide buffer has an IoU of 1.4 / 2.6, above 0.5."""
    metrics = VectorMapMetrics(measure=measure)
    metrics.update(*frame([line(0), line(9)], [line(0), line(9.6)], [0.9, 0.8]))
    assert metrics.compute()["recall"] == pytest.approx(expected)


def test_a_class_that_a_part_lacks_does_not_count_there():
    """All lines are found and none is a crossing, which counts 0 in the whole, as officially, and in no part of it."""
    metrics = GroupedMetrics(
        VectorMapMetrics, frame_groups=("both", "boundary", "nowhere"), lane_groups=("dividers", "none")
    )
    for group, numbers in (("both", [0, 2]), ("boundary", [2])):
        lines, classes = [line(9.0 * number) for number in numbers], np.array(numbers)
        truth = MapTruth(lines, classes, visibility=np.where(classes == 0, 0.1, 0.9))
        members = {"dividers": classes == 0, "none": classes == 1}
        metrics.update(MapDetections(lines, classes, np.full(len(lines), 0.9)), truth, group, members)
    result, samples = metrics.compute(), metrics.bootstrap(np.array([[1, 1], [0, 1], [0, 0]]))
    whole = {name: value for name, value in result["all"].items() if "@" not in name}
    assert whole == {
        "frames": 2,
        "lines": 3,
        "mAP": pytest.approx(2 / 3),
        "AP_divider": 1.0,
        "AP_ped_crossing": 0.0,
        "AP_boundary": 1.0,
        "recall": 1.0,
    }
    # The sample of the second frame lacks dividers, which the whole has: that is the luck of the draw, not a 0.
    assert samples["all"]["mAP"] == pytest.approx([2 / 3, 1 / 2, 0.0])
    assert samples["clear"]["mAP"].tolist() == [1.0, 1.0, 0.0]
    parts = {"occluded": {0}, "clear": {2}, "both": {0, 2}, "boundary": {2}, "dividers": {0}, "none": (), "nowhere": ()}
    for part, present in parts.items():
        names = {f"AP_{CLASSES[c]}" for c in present} | ({"mAP"} if present else set())
        assert {name for name in result[part] if "AP" in name and "@" not in name} == samples[part].keys() == names
        assert {name.split("@")[0] for name in result[part] if "AP" in name} == names
        assert all(result[part][name] == 1.0 for name in names)


def test_a_detection_of_a_class_that_its_frame_lacks_counts_in_the_whole_alone():
    """The first frame has no boundary: what is found there belongs to no line, so to no part."""
    metrics = GroupedMetrics(VectorMapMetrics)
    for true, found, scores in (([0], [0, 2], [0.9, 0.9]), ([2], [2], [0.8])):
        detections, truth = frame([line(0)], [line(0)] * len(found), scores, (true, found))
        metrics.update(detections, dataclasses.replace(truth, visibility=np.ones(1)))
    result = metrics.compute()
    assert (result["all"]["AP_boundary"], result["clear"]["AP_boundary"]) == (0.5, 1.0)
    matched = match_map(*frame([line(0)], [line(0), line(1)], [0.9, 0.8], ([0], [0, 2])), nearest="all")
    assert matched.select(np.ones(1, bool)).classes.tolist() == [0]


@pytest.mark.parametrize("measure", ["chamfer", "iou"])
def test_a_detection_far_from_all_lines_has_a_nearest_one(measure):
    """Without overlap, the IoU of all lines is equal."""
    far = frame([line(0), line(40)], [line(50)], [0.9])
    assert match_map(*far, measure=measure, nearest="all").nearest.tolist() == [1]


def test_the_group_of_a_detection_depends_on_no_other_line():
    """Regression: with `as_given`, a longer line of another class changed which line is the nearest."""
    true = [line(0.0), line(0, (30.0, 40.0))]
    long = line(50.0, np.linspace(0.0, 10.0, 150))
    for found, classes in (([line(9.0, (3.0, 24.0))], [0]), ([line(9.0, (3.0, 24.0)), long], [0, 2])):
        detections, truth = frame(true, found, [0.9] * len(found), ([0, 0], classes))
        for sampling in KEYS:
            assert match_map(detections, truth, sampling, nearest="all").nearest[0] == 0


def test_classes_do_not_mix():
    result = evaluate([frame([line(0), line(0)], [line(0), line(0)], [0.9, 0.8], ([0, 2], [2, 1]))])
    assert (result["AP_divider"], result["AP_ped_crossing"], result["AP_boundary"]) == (0.0, 0.0, 1.0)
    assert (result["mAP"], result["mAP@0.5"]) == pytest.approx((1 / 3, 1 / 2))


def test_a_detection_is_matched_with_its_nearest_truth_only():
    # Both detections are nearest to the first line (0.1 and 0.2 m); the other line is 0.3 m from the second.
    result = evaluate([frame([line(0), line(0.5)], [line(-0.1), line(0.2)], [0.9, 0.8])])
    assert result["AP_divider@0.5"] == 0.5


def test_pieces_end_to_end_are_not_compared():
    # Resampled they are 0.9 m apart in the mean, but 4 m wide with flat ends they leave a gap.
    pieces = frame([line(0, (0.0, 0.5))], [line(0, (0.9, 1.4))], [0.9])
    assert evaluate([pieces])["AP_divider@1.5"] == 0.0
    beside = frame([line(0, (0.0, 0.5))], [line(0.9, (0.0, 0.5))], [0.9])
    assert evaluate([beside])["AP_divider@1.5"] == 1.0


def test_single_points_are_dropped_and_lines_without_length_stay():
    point, still = line(0, (5.0,)), line(0, (5.0, 5.0))
    assert evaluate([frame([line(0)], [point, line(0)], [0.9, 0.8])])["AP_divider"] == 1.0
    assert evaluate([frame([line(0)], [still, line(0)], [0.9, 0.8])])["AP_divider"] == 0.5


def test_sampling_of_detections():
    # 100 points bunched at both ends: resampled they equal the truth, as given they leave its middle alone.
    bunched = line(0, np.concatenate([np.linspace(0, 0.1, 50), np.linspace(9.9, 10, 50)]))
    for points, hits in (
        (bunched, {"maptr": 1, "maptrv2": 0, "as_given": 0}),
        (bunched[:-1], {"maptr": 1, "maptrv2": 1, "as_given": 0}),
    ):
        one = frame([line(0)], [points], [0.9])
        assert {sampling: evaluate([one], sampling)["AP_divider@0.5"] for sampling in KEYS} == hits


def test_truth_that_is_sampled_stays_as_it_is():
    # 100 points bunched at both ends: as they are, they leave the middle of the detection alone.
    bunched = line(0, np.concatenate([np.linspace(0, 0.1, 50), np.linspace(9.9, 10, 50)]))
    for sampled, found in ((False, 1.0), (True, 0.0)):
        detections, truth = frame([bunched], [line(0)], [0.9])
        assert evaluate([(detections, dataclasses.replace(truth, sampled=sampled))])["AP_divider@0.5"] == found
    detections, truth = frame([line(0)], [line(0)], [0.9])
    with pytest.raises(UserError, match="sampled lines have 100 points, not 2"):
        evaluate([(detections, dataclasses.replace(truth, sampled=True))])
    nothing, truth = frame([], [], [])
    assert evaluate([(nothing, dataclasses.replace(truth, sampled=True))])["lines"] == 0


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), sampling=st.sampled_from(list(KEYS)))
def test_order_is_free_and_parts_merge(seed, sampling):
    rng = np.random.default_rng(seed)

    def random_frame():
        g, p = rng.integers(0, 5), rng.integers(0, 9)
        true = [rng.uniform(-4, 4, 2) + np.cumsum(rng.uniform(0, 1, (rng.integers(2, 9), 2)), 0) for _ in range(g)]
        found = [rng.uniform(-4, 4, 2) + np.cumsum(rng.uniform(0, 1, (rng.integers(1, 9), 2)), 0) for _ in range(p)]
        return frame(true, found, rng.permutation(p) / 10, (rng.integers(0, 3, g), rng.integers(0, 3, p)))

    frames = [random_frame() for _ in range(4)]
    whole = evaluate(frames, sampling)
    first, second = VectorMapMetrics(sampling), VectorMapMetrics(sampling)
    for i, one in enumerate(frames):
        (first if i < 2 else second).update(*one)
    assert first.merge(second).compute() == whole
    mixed = []
    for detections, truth in frames:
        order = rng.permutation(len(detections.scores)).astype(int)
        points = [detections.points[i] for i in order]
        mixed.append((MapDetections(points, detections.classes[order], detections.scores[order]), truth))
    # Scores of different frames tie, so frames are compared one by one.
    for one, other in zip(frames, mixed, strict=True):
        assert evaluate([one], sampling) == evaluate([other], sampling)


def test_heights_count_in_the_distance_alone():
    flat = np.column_stack([line(0), np.zeros(2)])
    # 0.8 m higher; and a slope of 100 percent, whose points are as far apart in the plane as those of the flat line.
    higher, steep = flat + np.array([0, 0, 0.8]), flat + np.array([[0, 0, 0], [0, 0, 10]])
    for raised, thresholds in ((higher, [1.0, 1.5]), (steep, [])):
        detections, truth = frame([flat], [raised], [0.9])
        metrics = VectorMapMetrics(dims=3)
        metrics.update(detections, truth)
        found = metrics.compute()
        assert [t for t in MAP_THRESHOLDS if found[f"AP_divider@{t}"] == 1.0] == thresholds
        assert "with heights" in metrics.protocol
        overlap = match_map(detections, truth, measure="iou", dims=3)
        assert overlap.hits.all()
    with pytest.raises(UserError, match="cannot merge"):
        VectorMapMetrics(dims=3).merge(VectorMapMetrics())
    with pytest.raises(UserError, match="expected lines of 3-D points"):
        match_map(*frame([line(0)], [line(0)], [0.9]), dims=3)


def test_empty_input():
    none = frame([], [], [])
    for result in (evaluate([]), evaluate([none])):
        assert result["mAP"] == 0.0
        assert result["mAP@0.5"] == 0.0
    assert evaluate([frame([line(0)], [], [])])["mAP"] == 0.0
    assert evaluate([frame([], [line(0)], [0.9]), none])["frames"] == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": [np.zeros((2, 3))]}, r"detections: points have shape .* expected lines of 2-D points"),
        ({"points": [np.array([[0, np.inf], [0, 1]])]}, "detections: line 0 has a coordinate that is not finite"),
        ({"scores": np.array([0.1, 0.2])}, r"detections: scores has shape \(2,\), expected \(1,\)"),
        ({"scores": np.array([np.nan])}, "detections: scores holds a number that is not finite"),
        ({"classes": np.array([4])}, "detections: classes must be whole numbers from 0 to 3"),
        ({"classes": np.array([0.9])}, "detections: classes must be whole numbers from 0 to 3"),
    ],
)
def test_arrays_that_do_not_fit(changes, message):
    detections, truth = frame([line(0)], [line(0)], [0.9])
    with pytest.raises(UserError, match=message):
        evaluate([(dataclasses.replace(detections, **changes), truth)])


def test_misuse_is_named():
    detections, _ = frame([], [line(0)], [0.9])
    with pytest.raises(UserError, match="truth: line 0 has a single point"):
        evaluate([(detections, MapTruth([line(0, (1.0,))], np.array([0])))])
    with pytest.raises(UserError, match="one sampling"):
        VectorMapMetrics("maptr").merge(VectorMapMetrics("maptrv2"))
    assert len({VectorMapMetrics(sampling).protocol for sampling in KEYS}) == 3

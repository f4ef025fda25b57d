"""OpenLane-V2 centerline metrics against the official evaluator, and against numbers worked out by hand."""

import dataclasses
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.metrics.cases import hand_frame, random_frame, reordered
from tests.metrics.fixtures import expected_cases, load_frames
from tflane_jax.errors import UserError
from tflane_jax.metrics import CenterlineMetrics, GroupedMetrics, LaneDetections, LaneTruth
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS, iou_distance, match_frame, nearest_lanes
from tflane_jax.metrics.partitions import ByOcclusion

VERSIONS = {"v2.1": "", "v1.0": "v1_0_"}
CASES = list(expected_cases())


def grouped_metrics(*groups, versions=("v2.1",), **options):
    return GroupedMetrics(partial(CenterlineMetrics, versions), *groups, **options)


def evaluate(frames, metrics: Any = None) -> Any:
    metrics = CenterlineMetrics() if metrics is None else metrics
    for detections, truth in frames:
        metrics.update(detections, truth)
    return metrics.compute()


@pytest.mark.golden
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("case", CASES)
def test_golden_totals(case, version):
    expected = expected_cases()[case]
    official = expected[version.replace(".", "_")]
    result = evaluate([frame[:2] for frame in load_frames(case)], CenterlineMetrics((version,)))
    if "error" in official:
        assert not {"TOP_ll", "TOP_lt", "OLS"} & result.keys()
        return
    stable = official | expected[f"{VERSIONS[version]}stable_sort_differs"]
    for name in ("DET_l", "DET_t", "TOP_ll", "TOP_lt", "OLS"):
        assert result[name] == pytest.approx(stable[name], abs=1e-6), name
    tied = {name.split("@")[0] for name in expected[f"{VERSIONS[version]}tie_sensitive"]}
    if version == "v2.1" and not {name for name in tied if name.startswith("DET")}:
        per_threshold = [result[f"DET_l@{t}"] for t in LANE_THRESHOLDS]
        np.testing.assert_allclose(per_threshold, official["DET_l_per_threshold"], atol=1e-6)
        per_attribute = [result[f"DET_t@{i}"] for i in range(13)]
        np.testing.assert_allclose(per_attribute, official["DET_t_per_attribute"], atol=1e-6)


@pytest.mark.golden
@pytest.mark.parametrize("versions", [("v2.1", "v1.0"), ("v1.0", "v2.1")])
@pytest.mark.parametrize("case", CASES)
def test_golden_versions_side_by_side(case, versions):
    """One pass gives the official numbers of both versions, bit-identical to one pass for each."""
    frames = [frame[:2] for frame in load_frames(case)]
    both = evaluate(frames, CenterlineMetrics(versions))
    first, second = (evaluate(frames, CenterlineMetrics((version,))) for version in versions)
    changed = ("TOP_ll", "TOP_lt", "OLS")
    renamed = {f"{name}_{versions[1]}": second[name] for name in changed if name in second}
    assert both == first | renamed
    expected = expected_cases()[case]
    official = expected[versions[1].replace(".", "_")]
    if "error" in official:
        assert renamed == {}
        return
    stable = official | expected[f"{VERSIONS[versions[1]]}stable_sort_differs"]
    for name in changed:
        assert both[f"{name}_{versions[1]}"] == pytest.approx(stable[name], abs=1e-6), name


@pytest.mark.golden
@pytest.mark.parametrize("case", CASES)
def test_golden_frames(case):
    expected = expected_cases()[case]
    topology = {key: np.array(expected["v2_1"][f"{key}_per_threshold_frame"], float) for key in ("TOP_ll", "TOP_lt")}
    for f, (detections, truth, official) in enumerate(load_frames(case)):
        frame = match_frame(detections, truth)
        distance = official["out_lane_dist"]
        if frame.lanes:
            # Beyond the largest threshold the official program masks pairs, so its nearest lane means nothing there.
            measured = distance.min(0) < LANE_THRESHOLDS[-1]
            np.testing.assert_array_equal(frame.nearest[measured], distance.argmin(0)[measured])
        if len(set(detections.scores.tolist())) < len(detections.scores):
            continue  # the official order of ties is not defined
        matches = [official[f"out_lane_match_{t}"] for t in LANE_THRESHOLDS]
        np.testing.assert_array_equal(frame.hits, np.stack(matches) >= 0)
        np.testing.assert_array_equal(np.where(frame.hits, frame.nearest, -1), matches)
        assert np.isnan(topology["TOP_ll"][:, f]).all() == (frame.lanes == 0)
        if frame.lanes and not expected["tie_sensitive"]:
            mean = frame.topology["v2.1"].sum(-1) / (2 * frame.lanes)
            np.testing.assert_allclose(mean, topology["TOP_ll"][:, f], atol=1e-6)
        elements = frame.elements
        assert elements is not None
        assert truth.elements is not None
        assert detections.elements is not None
        boxes = truth.elements.boxes, detections.elements.boxes
        np.testing.assert_allclose(iou_distance(*boxes), official["out_te_dist"], atol=1e-6)
        if elements.vertices and not expected["tie_sensitive"]:
            np.testing.assert_allclose(
                elements.topology["v2.1"] / elements.vertices, topology["TOP_lt"][:, f], atol=1e-6
            )


def test_by_hand():
    result = evaluate([hand_frame()])
    # True positives in descending score: 1000 at 1 m, 1100 at 2 and 3 m; three lanes to find.
    assert [result[f"DET_l@{t}"] for t in LANE_THRESHOLDS] == pytest.approx([4 / 11, 7 / 11, 7 / 11])
    assert result["DET_l"] == pytest.approx(18 / 33)
    # At 2 and 3 m the edge A -> B is the best candidate of A (outgoing) and of B (incoming); every other vertex has
    # no neighbour and a false candidate.
    assert result["TOP_ll"] == pytest.approx((0 + 2 + 2) / 18)
    # Attribute 2 found, attribute 5 invented, eleven absent.
    assert result["DET_t"] == pytest.approx(12 / 13)
    # The element of attribute 5 has the higher score and takes the box: A and the element 1, B once it is matched 1.
    assert result["TOP_lt"] == pytest.approx((2 + 3 + 3) / 12)
    parts = [18 / 33, 12 / 13, (4 / 18) ** 0.5, (8 / 12) ** 0.5]
    assert result["OLS"] == pytest.approx(np.mean(parts))
    # One of three lanes is found at 1 m (A), two at 2 and 3 m.
    assert [result[f"recall@{t}"] for t in LANE_THRESHOLDS] == pytest.approx([1 / 3, 2 / 3, 2 / 3])
    assert result["recall"] == pytest.approx(5 / 9)
    # Area: at 1 m the first detection takes one of three lanes, at 2 and 3 m the first two take two.
    assert result["AP_l"] == pytest.approx((1 / 3 + 2 / 3 + 2 / 3) / 3)
    assert (result["frames"], result["lanes"]) == (1, 3)


def test_version_1_0_by_hand():
    metrics = CenterlineMetrics(("v1.0",))
    result = evaluate([hand_frame()], metrics)
    # At 2 and 3 m the three lowest of ten levels keep the first detection alone and find no edge; on the others the
    # false edges of lane C rank first, so A and B have precision 1/2.
    assert result["TOP_ll"] == pytest.approx(2 * 0.7 * 1.0 / 18)
    assert result["DET_l"] == pytest.approx(18 / 33)
    assert metrics.protocol == "OpenLane-V2 centerline v1.0"


def test_both_versions_take_one_matching(monkeypatch):
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return nearest_lanes(*arguments)

    monkeypatch.setattr("tflane_jax.metrics.centerline_matching.nearest_lanes", counted)
    metrics = grouped_metrics(versions=("v2.1", "v1.0"))
    result = evaluate([hand_frame()], metrics)
    assert len(calls) == 1
    assert result["all"]["TOP_ll"] == pytest.approx((0 + 2 + 2) / 18)
    assert result["all"]["TOP_ll_v1.0"] == pytest.approx(2 * 0.7 * 1.0 / 18)
    assert result["all"]["OLS_v1.0"] < result["all"]["OLS"]
    assert "TOP_ll_v1.0" in result["occluded"]
    assert metrics.protocol.startswith("OpenLane-V2 centerline v2.1, v1.0 where the name says so, occluded")
    part = grouped_metrics(versions=("v2.1", "v1.0"))
    assert metrics.merge(part).compute() == result
    with pytest.raises(UserError, match="cannot merge"):
        metrics.merge(grouped_metrics())


@pytest.mark.parametrize("versions", [(), ("v2.0",), ("v2.1", "v2.1"), "v2.1"])
def test_versions_that_do_not_exist_are_named(versions):
    with pytest.raises(UserError, match=r"versions of the topology score are .*, expected a tuple .* \('v2\.1',\)$"):
        CenterlineMetrics(versions)


def test_groups_by_hand():
    metrics = grouped_metrics()
    result = evaluate([hand_frame()], metrics)
    assert result["all"] == evaluate([hand_frame()])
    # B and C are occluded; the detections nearest to them are B (hit from 2 m on) and C reversed.
    assert result["occluded"]["DET_l"] == pytest.approx((0 + 6 / 11 + 6 / 11) / 3)
    assert result["occluded"]["TOP_ll"] == pytest.approx((0 + 1 + 1) / 12)
    # A alone, found first; its duplicate comes after recall 1.
    assert result["clear"]["DET_l"] == pytest.approx(1.0)
    assert result["clear"]["TOP_ll"] == pytest.approx((0 + 1 + 1) / 6)
    assert "DET_t" not in result["clear"]
    assert "occluded: visibility < 0.5" in metrics.protocol


def test_groups_of_lanes_that_the_caller_names():
    detections, truth = hand_frame()
    metrics = grouped_metrics(lane_groups=("like clear", "none", "both"))
    clear, none, both = np.array([1, 0, 0], bool), np.zeros(3, bool), np.array([1, 1, 0], bool)
    metrics.update(detections, truth, members={"like clear": clear, "none": none, "both": both})
    result = metrics.compute()
    assert result["like clear"] == result["clear"]
    assert (result["none"]["lanes"], result["both"]["lanes"]) == (0, 2)
    assert result["both"]["recall"] == pytest.approx(5 / 6)
    # One row for each frame: lanes, and hits at 1, 2 and 3 m.
    counts = {name: rows.tolist() for name, rows in metrics.merge(metrics).recalled().items()}
    assert counts == {
        "all": [[3, 5]] * 2,
        "occluded": [[2, 2]] * 2,
        "clear": [[1, 3]] * 2,
        "like clear": [[1, 3]] * 2,
        "none": [[0, 0]] * 2,
        "both": [[2, 5]] * 2,
    }


def test_frames_outside_a_group_of_frames_count_nothing_in_it():
    metrics = grouped_metrics(frame_groups=("gap",))
    metrics.update(*hand_frame())
    metrics.update(*hand_frame(), "gap")
    assert metrics.recalled()["gap"].tolist() == [[0, 0], [3, 5]]
    assert metrics.compute()["gap"]["frames"] == 1


def test_a_frame_may_belong_to_several_groups_of_frames():
    metrics = grouped_metrics(frame_groups=("gap", "far", "near"))
    metrics.update(*hand_frame(), ("gap", "far"))
    metrics.update(*hand_frame(), ["near"])
    found = metrics.compute()
    assert [found[group]["frames"] for group in ("all", "gap", "far", "near")] == [2, 1, 1, 1]
    assert found["gap"]["recall"] == found["near"]["recall"] == found["all"]["recall"]


def test_threshold_of_occlusion_is_strict_and_configurable():
    lanes = {
        limit: evaluate([hand_frame()], grouped_metrics(partition=ByOcclusion(limit)))["occluded"]["lanes"]
        for limit in (0.2, 0.3, 0.4, 0.41)
    }
    assert lanes == {0.2: 0, 0.3: 1, 0.4: 1, 0.41: 2}


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), version=st.sampled_from(list(VERSIONS)))
def test_merge_equals_one_pass_and_order_of_detections_is_free(seed, version):
    frames = [random_frame(seed + i, lanes=5 * (i != 1), detections=9 * (i != 2)) for i in range(4)]
    whole, first, second = (grouped_metrics(versions=(version,)) for _ in range(3))
    expected = evaluate(frames, whole)
    evaluate(frames[:2], first)
    evaluate(frames[2:], second)
    assert first.merge(second).compute() == expected
    assert expected["all"] == evaluate(frames, CenterlineMetrics((version,)))
    order = np.random.default_rng(seed).permutation(9)
    mixed = [(reordered(d, order[: len(d.scores)] if len(d.scores) else []), t) for d, t in frames if len(d.scores)]
    kept = [(d, t) for d, t in frames if len(d.scores)]
    assert evaluate(mixed, CenterlineMetrics((version,))) == evaluate(kept, CenterlineMetrics((version,)))


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_groups_partition_lanes_vertices_and_detections(seed):
    frames = [match_frame(*random_frame(seed + i)) for i in range(3)]
    for i, frame in enumerate(frames):
        occluded = np.asarray(random_frame(seed + i)[1].visibility) < 0.5
        parts = frame.select(occluded), frame.select(~occluded)
        assert sum(part.lanes for part in parts) == frame.lanes
        assert sum(len(part.scores) for part in parts) == len(frame.scores)
        np.testing.assert_array_equal(sum(part.hits.sum(-1) for part in parts), frame.hits.sum(-1))
        np.testing.assert_allclose(sum(part.topology["v2.1"].sum(-1) for part in parts), frame.topology["v2.1"].sum(-1))


def test_perfect_detections():
    _, truth = hand_frame()
    perfect = LaneDetections(truth.points, np.ones(3), truth.successor.astype(float))
    result = evaluate([(perfect, truth)])
    assert result["DET_l"] == 1.0
    assert result["TOP_ll"] == 1.0
    assert "OLS" not in result  # no detections of traffic elements
    shuffled = [perfect.points[i] for i in (2, 0, 1)]
    assert evaluate([(dataclasses.replace(perfect, points=shuffled), truth)])["TOP_ll"] < 1.0


def test_empty_input():
    none = LaneDetections(np.zeros((0, 11, 3)), np.zeros(0), np.zeros((0, 0)))
    empty = LaneTruth(np.zeros((0, 11, 3)), np.zeros((0, 0), bool), np.zeros(0))
    for metrics in (CenterlineMetrics().compute(), evaluate([(none, empty)])):
        assert metrics["DET_l"] == 1.0
        assert metrics["TOP_ll"] == 0.0
        assert metrics["lanes"] == 0
    detections, truth = hand_frame()
    assert evaluate([(none, truth)])["DET_l"] == 0.0
    grouped = evaluate([(detections, empty)], grouped_metrics())
    assert grouped["all"]["DET_l"] == 0.0
    assert grouped["clear"]["DET_l"] == 1.0  # false positives of a frame without lanes count only in "all"
    assert "TOP_ll" not in evaluate([(detections, empty)], CenterlineMetrics(("v1.0",)))


def broken(**changes):
    detections, truth = hand_frame()
    return dataclasses.replace(detections, **changes), truth


def broken_truth(**changes):
    detections, truth = hand_frame()
    return detections, dataclasses.replace(truth, **changes)


def broken_elements(side, **changes):
    """Change arrays of the elements of detections (0) or truth (1), each by a function of the array."""
    frame = list(hand_frame())
    elements = frame[side].elements
    new = {name: change(np.asarray(getattr(elements, name), float)) for name, change in changes.items()}
    frame[side] = dataclasses.replace(frame[side], elements=dataclasses.replace(elements, **new))
    return frame


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (broken(points=np.full((4, 11, 3), np.nan)), "detections: line 0 has a coordinate that is not finite"),
        (broken(points=np.zeros((4, 11, 2))), "expected lines of 3-D points"),
        (broken(points=[np.zeros((2, 3)), np.zeros((0, 3))]), "polyline 1 has no points"),
        (broken(scores=np.zeros(3)), r"scores has shape \(3,\), expected \(4,\)"),
        (broken(scores=np.array([0.1, np.nan, 0.2, 0.3])), "scores holds a number that is not finite"),
        (broken(successor=np.zeros((4, 3))), "detections: successor has shape"),
        (broken(successor=np.full((4, 4), -0.1)), "detections: successor has negative confidences: apply the sigmoid"),
        (broken_truth(successor=np.full((3, 3), np.nan)), "truth: successor holds a number that is not finite"),
        (broken_truth(visibility=np.array([0.1, np.nan, 0.2])), "truth: visibility holds a number that is not finite"),
        (
            broken_elements(0, lane=lambda lane: lane - 5.0),
            "detections: lane to element has negative confidences",
        ),
        (broken_elements(1, lane=lambda lane: np.nan * lane), "truth: lane to element holds a number that is not fin"),
        (broken_elements(0, attributes=lambda a: a + 0.5), "detections: element attributes must be whole numbers from"),
    ],
)
def test_arrays_that_do_not_fit(frame, message):
    with pytest.raises(UserError, match=message):
        evaluate([frame], grouped_metrics())


def test_misuse_is_named():
    detections, truth = hand_frame()
    with pytest.raises(UserError, match="one version"):
        CenterlineMetrics(("v1.0",)).merge(CenterlineMetrics(("v2.1",)))
    with pytest.raises(UserError, match="cannot merge"):
        grouped_metrics(("all",)).merge(grouped_metrics())
    unknown = dataclasses.replace(truth, visibility=None)
    with pytest.raises(UserError, match="visibility"):
        evaluate([(detections, unknown)], grouped_metrics())
    assert evaluate([(detections, unknown)], grouped_metrics(("all",)))["all"]["lanes"] == 3
    lanes_only = dataclasses.replace(detections, elements=None)
    with pytest.raises(UserError, match="missing in 1 of 2 frames"):
        evaluate([(detections, truth), (lanes_only, truth)])

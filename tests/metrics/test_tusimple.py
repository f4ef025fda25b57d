"""TuSimple's metrics against the official program's numbers and against numbers worked out by hand."""

import gzip
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared import shared_root
from tflane_jax.errors import UserError
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.metrics.tusimple import (
    LSTR_TIME_LIMIT,
    TuSimpleMetrics,
    line_accuracy,
    pixel_thresholds,
    score_image,
)


def golden():
    path = shared_root() / "golden" / "metrics" / "tusimple" / "cases.json.gz"
    return json.loads(gzip.decompress(path.read_bytes()))["cases"] if path.exists() else {}


def images(case):
    """Return prediction, truth and official per-image numbers of a case, by image."""
    predictions = {record["raw_file"]: record for record in case["pred"]}
    expected = case["expected"]
    for i, record in enumerate(case["gt"]):
        guess = predictions[record["raw_file"]]
        yield (
            RowLanes(np.array(guess["lanes"], float), run_time=guess["run_time"]),
            RowLanes(np.array(record["lanes"], float), np.array(record["h_samples"], float)),
            {
                name: expected[name][i]
                for name in ("per_frame_acc_fp_fn", "pixel_threshold_per_gt_lane", "line_accuracy_gt_x_pred")
            },
        )


@pytest.mark.golden
@pytest.mark.parametrize("name", golden())
def test_official_numbers(name):
    case = golden()[name]
    order = [record["raw_file"] for record in case["gt"]]
    assert [record["raw_file"] for record in case["pred"]] == order  # per-image numbers follow the predictions
    metrics = TuSimpleMetrics()
    for detections, truth, official in images(case):
        metrics.update(detections, truth)
        np.testing.assert_allclose(score_image(detections, truth), official["per_frame_acc_fp_fn"], atol=1e-9)
        if official["pixel_threshold_per_gt_lane"]:
            assert truth.rows is not None
            thresholds = pixel_thresholds(truth.x, truth.rows)
            np.testing.assert_allclose(thresholds, official["pixel_threshold_per_gt_lane"], atol=1e-6)
            if official["line_accuracy_gt_x_pred"] and np.size(official["line_accuracy_gt_x_pred"]):
                accuracy = line_accuracy(truth.x, detections.x, thresholds)
                np.testing.assert_allclose(accuracy, official["line_accuracy_gt_x_pred"], atol=1e-9)
    computed = metrics.compute()
    for number in ("Accuracy", "FP", "FN"):
        assert computed[number] == pytest.approx(case["expected"][number], abs=1e-9), number


ROWS = np.arange(10.0) * 10


def upright(*xs):
    return np.repeat(np.array(xs, float)[:, None], 10, 1) if xs else np.zeros((0, 10))


@pytest.mark.parametrize(
    ("found", "true", "expected"),
    [
        # 19 pixels off is a hit, 20 is not (strictly nearer); one of the two predictions is false.
        ((119, 320), (100, 300), (0.5, 0.5, 0.5)),
        ((100, 300), (100, 300), (1.0, 0.0, 0.0)),
        # Nothing predicted: no false positive, all missed. Nothing there: only false positives.
        ((), (100,), (0.0, 0.0, 1.0)),
        ((100, 300), (), (0.0, 1.0, 0.0)),
        ((), (), (0.0, 0.0, 0.0)),
        # Three more predictions than lanes: all is lost.
        ((100, 200, 300, 400), (100,), (0.0, 0.0, 1.0)),
        # One prediction serves two lanes: minus one false positive.
        ((100,), (95, 105), (1.0, -1.0, 0.0)),
        # Five lanes, one missed: forgiven, and the worst line is left out.
        ((0, 100, 200, 300), (0, 100, 200, 300, 500), (1.0, 0.0, 0.0)),
        # Six lanes, all found: five of four.
        ((0, 100, 200, 300, 400, 500), (0, 100, 200, 300, 400, 500), (1.25, 0.0, 0.0)),
    ],
)
def test_by_hand(found, true, expected):
    assert score_image(RowLanes(upright(*found)), RowLanes(upright(*true), ROWS)) == pytest.approx(expected)


def test_a_slanted_lane_is_measured_across():
    # x = 100 + 3/4 y: 20 pixels across are 25 along the row.
    slanted = 100 + 0.75 * ROWS[None]
    assert pixel_thresholds(slanted, ROWS) == pytest.approx([25.0])
    truth = RowLanes(slanted, ROWS)
    assert score_image(RowLanes(slanted + 24.9), truth)[0] == 1.0
    assert score_image(RowLanes(slanted + 25.1), truth)[0] == 0.0


def test_rows_without_a_point_count_as_hits():
    true, found = upright(100), upright(100)
    true[0, :5] = -2
    found[0, :4] = -2
    assert score_image(RowLanes(found), RowLanes(true, ROWS)) == pytest.approx((0.9, 0.0, 0.0))


def test_slow_predictions_are_lost():
    truth = RowLanes(upright(100), ROWS)
    slow = RowLanes(upright(100), run_time=200.1)
    assert score_image(RowLanes(upright(100), run_time=200.0), truth) == (1.0, 0.0, 0.0)
    assert score_image(slow, truth) == (0.0, 0.0, 1.0)
    assert score_image(slow, truth, LSTR_TIME_LIMIT) == (1.0, 0.0, 0.0)


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(0, 6), st.integers(0, 6))
def test_the_order_of_lanes_does_not_matter(seed, g, p):
    rng = np.random.default_rng(seed)
    true, found = rng.uniform(-200, 1280, (g, 10)), rng.uniform(-200, 1280, (p, 10))
    expected = score_image(RowLanes(found), RowLanes(true, ROWS))
    shuffled = score_image(RowLanes(rng.permutation(found)), RowLanes(rng.permutation(true), ROWS))
    assert shuffled == pytest.approx(expected, abs=1e-12)


def test_merged_accumulators_equal_one_pass():
    rng = np.random.default_rng(0)
    frames = [(RowLanes(rng.uniform(0, 99, (3, 10))), RowLanes(rng.uniform(0, 99, (4, 10)), ROWS)) for _ in range(5)]
    whole, a, b = TuSimpleMetrics(), TuSimpleMetrics(), TuSimpleMetrics()
    for i, frame in enumerate(frames):
        whole.update(*frame)
        (a if i < 2 else b).update(*frame)
    assert a.merge(b).compute() == pytest.approx(whole.compute(), abs=1e-12)
    parts = a.merge(b).means()
    assert {name: part.sum(0)[0] / part.sum(0)[1] for name, part in parts.items()} == pytest.approx(
        {name: value for name, value in whole.compute().items() if name != "frames"}, abs=1e-12
    )
    assert all(len(part) == whole.compute()["frames"] for part in parts.values())
    assert a.compute()["frames"] == 2
    assert TuSimpleMetrics().compute() == {"frames": 0, "Accuracy": 0.0, "FP": 0.0, "FN": 0.0}


@pytest.mark.parametrize(
    ("found", "true", "rows", "message"),
    [
        (np.zeros((2, 9)), upright(1), ROWS, r"detections: lanes have shape \(2, 9\), expected \(lanes, 10\)"),
        (upright(1), np.zeros(10), ROWS, r"truth: lanes have shape \(10,\)"),
        ([[1.0] * 10, [1.0] * 9], upright(1), ROWS, "detections: lanes have different numbers of rows, expected 10"),
        (np.array([[np.nan] * 10]), upright(1), ROWS, "detections: lane 0 has a number that is not finite"),
        (upright(1), upright(1), None, "h_samples"),
    ],
)
def test_mismatched_shapes_are_named(found, true, rows, message):
    with pytest.raises(UserError, match=message):
        score_image(RowLanes(found), RowLanes(true, rows))


def test_different_limits_do_not_merge():
    with pytest.raises(UserError, match="time limit"):
        TuSimpleMetrics().merge(TuSimpleMetrics(LSTR_TIME_LIMIT))


def test_the_protocol_says_whether_times_were_given():
    truth, metrics = RowLanes(upright(100), ROWS), TuSimpleMetrics()
    metrics.update(RowLanes(upright(100)), truth)
    assert metrics.protocol == "TuSimple, time not measured"
    timed = TuSimpleMetrics()
    timed.update(RowLanes(upright(100), run_time=10.0), truth)
    assert timed.protocol == metrics.merge(timed).protocol == "TuSimple, 200 ms an image"

"""C-mAP on sequences worked out by hand."""

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.metrics import MapDetections, MapTruth, VectorMapMetrics
from tflane_jax.metrics.consistency import MapConsistency
from tflane_jax.metrics.map_matching import MAP_THRESHOLDS, match_map


def line(x):
    return np.array([(x, 0.0), (x, 10.0)])


def run(frames, classes=0):
    """Return C-mAP numbers of frames: true lines (x, number), and detections (x, score, identity)."""
    metrics = MapConsistency()
    for frame in frames:
        if frame is None:
            metrics.start()
            continue
        true, found = frame
        matched = match_map(
            MapDetections(
                [line(x) for x, *_ in found], np.full(len(found), classes), np.array([s for _, s, _ in found])
            ),
            MapTruth([line(x) for x, _ in true], np.full(len(true), classes)),
        )
        metrics.add(matched, np.array([i for *_, i in found], int), np.array([n for _, n in true], int))
    return metrics.compute()


ROAD = [(0, 7), (5, 8)]


def test_lines_found_again_as_themselves_count():
    found = [(0, 0.9, 1), (5, 0.8, 2)]
    assert run([(ROAD, found), (ROAD[::-1], found[::-1])])["C-AP_divider"] == 1.0
    assert run([(ROAD, found)])["C-mAP"] == pytest.approx(1 / 3)


def test_another_identity_is_false_until_the_first_one_is_back():
    first, other = (ROAD[:1], [(0, 0.9, 1)]), (ROAD[:1], [(0, 0.9, 5)])
    # Sorted by score, which ties: frame by frame. Hits are true, false, true of three lines.
    assert run([first, other, first])["C-AP_divider"] == pytest.approx((1 + 2 / 3) / 3)
    assert run([first, other, other])["C-AP_divider"] == pytest.approx(1 / 3)
    # In another scene the line is another one.
    assert run([first, None, other])["C-AP_divider"] == 1.0


def test_swapped_identities_are_both_false():
    swapped = (ROAD, [(0, 0.9, 2), (5, 0.8, 1)])
    assert run([(ROAD, [(0, 0.9, 1), (5, 0.8, 2)]), swapped])["C-AP_divider"] == pytest.approx((1 + 2 / 3) / 4)


def test_each_threshold_remembers_its_own_first_match():
    # 1.2 m aside under identity 1, then exact under identity 2: wrong only at 1.5 m, where the first match was.
    result = run([(ROAD[:1], [(1.2, 0.9, 1)]), (ROAD[:1], [(0, 0.8, 2)])])
    assert MAP_THRESHOLDS == (0.5, 1.0, 1.5)
    assert result["C-AP_divider"] == pytest.approx(np.mean([0.25, 0.25, 0.5]))


def test_pieces_of_one_line_may_be_found_under_several_identities():
    pieces = [(0, 7), (5, 7)]
    found = [(0, 0.9, 1), (5, 0.8, 2)]
    assert run([(pieces, found), (pieces, found)])["C-AP_divider"] == 1.0


def test_a_class_that_a_sample_lacks_does_not_count():
    """Regression: it counted as AP 0 in C-mAP, though not in MapTR's mAP."""
    metrics, same = MapConsistency(), VectorMapMetrics("maptr")
    for classes in (0, 1):  # a scene of one frame with dividers, and one with crossings
        found = MapDetections([line(0)], np.array([classes]), np.array([0.9]))
        true = MapTruth([line(0)], np.array([classes]))
        metrics.start()
        metrics.add(match_map(found, true), np.array([1]), np.array([7]))
        same.update(found, true)
    weights = np.array([[1, 1], [2, 0], [0, 2]])
    samples = metrics.bootstrap(weights)["C-mAP"]
    # No frame has a boundary: that class counts as 0 everywhere, as in the whole.
    np.testing.assert_allclose(samples, [metrics.compute()["C-mAP"], 1 / 2, 1 / 2])
    np.testing.assert_array_equal(samples, same.bootstrap(weights)["mAP"])


def test_one_identity_for_two_lines_is_no_error():
    assert run([(ROAD, [(0, 0.9, 1), (5, 0.8, 1)])])["C-AP_divider"] == 1.0


def test_centerlines_take_no_part():
    assert run([(ROAD, [(0, 0.9, 1)])], classes=3) == {
        "C-mAP": 0.0,
        "C-AP_divider": 0.0,
        "C-AP_ped_crossing": 0.0,
        "C-AP_boundary": 0.0,
    }
    assert run([])["C-mAP"] == 0.0
    # A centerline found first does not take the number of a divider.
    metrics = MapConsistency()
    for kind, identity in ((3, 5), (0, 1), (0, 1)):
        found = MapDetections([line(0)], np.array([kind]), np.array([0.9]))
        matched = match_map(found, MapTruth([line(0)], np.array([kind])))
        metrics.add(matched, np.array([identity]), np.array([0]))
    assert metrics.compute()["C-AP_divider"] == 1.0


def test_numbers_of_lines_may_be_lists_and_must_be_complete():
    found, truth = MapDetections([line(0)], np.array([0]), np.array([0.9])), MapTruth([line(0)], np.array([0]))
    metrics = MapConsistency()
    metrics.add(match_map(found, truth), [3], [0])
    assert metrics.compute()["C-AP_divider"] == 1.0
    with pytest.raises(UserError, match=r"identities of detections has shape \(0,\), expected \(1,\)"):
        metrics.add(match_map(found, truth), [], [0])
    with pytest.raises(UserError, match=r"numbers of true lines has shape \(2,\), expected \(1,\)"):
        metrics.add(match_map(found, truth), [3], [0, 1])

"""The F-score of 3-D lanes against the official evaluator, a plain loop, and numbers worked out by hand."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from tests.metrics.cases import random_frame, reordered
from tests.metrics.fixtures import expected_cases, load_frames
from tflane_jax.errors import UserError
from tflane_jax.metrics import CenterlineFScore, LaneDetections, LaneTruth

QUICK = settings(max_examples=20)


def evaluate(frames):
    metrics = CenterlineFScore()
    for detections, truth in frames:
        metrics.update(detections, truth)
    return metrics.compute()


@pytest.mark.golden
@pytest.mark.parametrize("case", list(expected_cases()))
def test_golden(case):
    expected = expected_cases()[case]
    result = evaluate([frame[:2] for frame in load_frames(case)])["F_score"]
    low, high = expected["F_score_range_over_equal_cost_matchings"]
    assert low - 1e-9 <= result <= high + 1e-9
    if high - low < 1e-9:  # other cases have pairings of equal cost, of which the official solver picks another
        assert result == pytest.approx(expected["v2_1"]["F_score"], abs=1e-9)


def by_loop(detections, truth):
    """The rules of docs/reference/metrics.md, section 2.7, as plain loops."""
    samples = np.arange(-50, 50)

    def sampled(lines):
        lanes = []
        for line in lines:
            if len(line) < 2 or not (line[0, 0] < 49 and line[-1, 0] > -50):
                continue
            line = line[np.argsort(line[:, 0], kind="stable")]
            visible = (line[0, 0] <= samples) & (line[-1, 0] >= samples)
            if visible.sum() > 1:
                lanes.append((visible, *(np.interp(samples, line[:, 0], line[:, axis]) for axis in (1, 2))))
        return lanes

    true, found = sampled(truth.points), sampled(detections.points)
    cost, near = (np.zeros((len(true), len(found)), int) for _ in range(2))
    for (g, a), (p, b) in itertools.product(enumerate(true), enumerate(found)):
        error = np.hypot(a[1] - b[1], a[2] - b[2])
        error[a[0] != b[0]] = 1.5
        error[~a[0] & ~b[0]] = 0.0
        near[g, p] = (error < 1.5).sum() - (~a[0] & ~b[0]).sum()
        cost[g, p] = 1 if 0 < error.sum() < 1 else int(error.sum())
    recalled = precise = 0
    for g, p in zip(*linear_sum_assignment(cost), strict=True):
        if cost[g, p] < 150:
            recalled += near[g, p] / true[g][0].sum() >= 0.75
            precise += near[g, p] / found[p][0].sum() >= 0.75
    return recalled / max(len(true), 1), precise / max(len(found), 1)


@QUICK
@given(seed=st.integers(0, 10**6), lanes=st.integers(0, 8), detections=st.integers(0, 12))
def test_equals_the_loop(seed, lanes, detections):
    frame = random_frame(seed, lanes, detections)
    result = evaluate([frame])
    assert (result["F_recall"], result["F_precision"]) == pytest.approx(by_loop(*frame))


def along(x, y=0.0, z=0.0):
    """Return a lane from x[0] to x[1] at the given y and z."""
    return np.array([(x[0], y, z), (x[1], y, z)], float)


def score(true, found):
    detections = LaneDetections(found, np.ones(len(found)), np.zeros((len(found), len(found))))
    result = evaluate([(detections, LaneTruth(true, np.zeros((len(true), len(true)), bool)))])
    return result["F_recall"], result["F_precision"], result["F_score"]


@pytest.mark.parametrize(
    ("true", "found", "expected"),
    [
        ([along((0, 19))], [along((0, 19), 1.0, 1.0)], (1, 1, 1)),  # sqrt(2) m away: near
        ([along((0, 19))], [along((0, 19), 1.5)], (0, 0, 0)),  # strictly nearer than 1.5 m
        ([along((0, 19))], [along((19, 0))], (1, 1, 1)),  # direction does not matter
        ([along((0, 19))], [along((0, 14))], (1, 1, 1)),  # 15 of 20 planes are enough
        ([along((0, 19))], [along((0, 13))], (0, 1, 0)),  # 14 are not, but all of the detection's
        ([along((0, 19)), along((0, 19), 9)], [along((0, 19))], (0.5, 1, 2 / 3)),
        ([along((0, 19))], [along((0, 19)), along((0, 19))], (1, 0.5, 2 / 3)),  # one to one
        ([along((0, 19))], [along((3.1, 3.9)), along((0, 19))], (1, 1, 1)),  # passes no plane: not counted
        ([along((-60, 0))], [along((0, -60))], (0, 0, 0)),  # ends behind -50 m: not counted
        ([along((40, 60))], [along((60, 40))], (0, 0, 0)),  # starts ahead of 49 m
        ([along((40, 60))], [along((40, 60))], (1, 1, 1)),
        ([along((49, 40))], [along((49, 40))], (0, 0, 0)),  # the borders themselves are left out
        ([along((-40, -50))], [along((-40, -50))], (0, 0, 0)),
        # The nearest pair is 0.3 m apart, yet the pairing of least cost leaves it: 0.7 + 1.2 against 0.3 + 2.2.
        ([along((0, 19)), along((0, 19), 1.0)], [along((0, 19), 0.7), along((0, 19), 2.2)], (1, 1, 1)),
        ([], [along((0, 19))], (0, 0, 0)),
        ([along((0, 19))], [], (0, 0, 0)),
        ([], [], (0, 0, 0)),
    ],
)
def test_by_hand(true, found, expected):
    assert score(true, found) == pytest.approx(expected)


def test_only_an_exact_pair_costs_nothing():
    """Lanes a and b on two planes, detections a and c: (a-a, b-c) costs 0 + 1, and (a-c, b-a) 1 + 1, not 0 + 0."""
    a, b, c = (np.array([(0, y, 0), (1, 0, 0)], float) for y in (0.0, -0.8, 0.8))
    # b and c are 1.6 m apart on one plane of two, which is not near.
    assert score([a, b], [a, c]) == (0.5, 0.5, 0.5)


def test_vertices_of_one_x():
    # A step to the side at x = 5, and padding where the lane ends on a plane.
    step = np.array([(0, 0, 0), (5, 0, 0), (5, 4, 0), (9, 4, 0)], float)
    assert score([step], [np.concatenate([step, step[-1:]])]) == (1, 1, 1)
    ends = np.array([(9, 0, 0), (0, 0, 0), (0, 0, 0)], float)
    assert score([ends], [ends[:2]]) == (1, 1, 1)


def test_whole_numbers_keep_their_slopes():
    assert score([np.array([(0, 0, 0), (20, 10, 0)])], [np.array([(0, 0, 0), (10, 5, 0), (20, 10, 0)])]) == (1, 1, 1)


@QUICK
@given(seed=st.integers(0, 10**6))
def test_order_is_free_and_parts_merge(seed):
    frames = [random_frame(seed + i, lanes=5 * (i != 1), detections=9 * (i != 2)) for i in range(4)]
    whole = evaluate(frames)
    first, second = CenterlineFScore(), CenterlineFScore()
    for i, frame in enumerate(frames):
        (first if i < 2 else second).update(*frame)
    assert first.merge(second).compute() == whole
    detections, truth = frames[0]
    mixed = reordered(detections, np.random.default_rng(seed).permutation(9))
    assert evaluate([(mixed, truth)]) == evaluate(frames[:1])


def test_no_frames():
    assert evaluate([]) == {"frames": 0, "F_score": 0.0, "F_recall": 0.0, "F_precision": 0.0}


def test_lines_that_cannot_be_measured_are_errors():
    with pytest.raises(UserError, match="detections: line 0 has a coordinate that is not finite"):
        score([along((0, 9))], [along((0, np.inf))])
    with pytest.raises(UserError, match="truth: polyline 0 has no points"):
        score([np.zeros((0, 3))], [])

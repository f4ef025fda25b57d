"""Accumulators of many scenes joined at once, against one after the other; what they keep, bit for bit."""

import functools
from functools import partial

import numpy as np
import pytest

from tests.metrics.test_bootstrap import centerlines, lines, segments
from tflane_jax.files.tusimple import RowLanes
from tflane_jax.metrics import (
    CenterlineFScore,
    CenterlineMetrics,
    GroupedMetrics,
    LaneSegmentMetrics,
    TuSimpleMetrics,
    VectorMapMetrics,
)
from tflane_jax.metrics.matching import average_precision_11, average_precision_area, ranked
from tflane_jax.metrics.merging import by_frame, joined


def rows(number):
    """Return detections and truth of an image."""
    rng = np.random.default_rng(number)
    return tuple(RowLanes(rng.uniform(0, 60, (count, 5)), np.arange(5)) for count in (3, 4))


def test_joined():
    assert joined([[1], [], [2, 3]]) == [1, 2, 3]
    assert joined([2]) == 2
    parts = [np.array([0.1, 1e16]), np.array([0.2, 1.0]), np.array([0.3, -1e16])]
    assert joined(parts).tolist() == ((parts[0] + parts[1]) + parts[2]).tolist()  # in this order
    assert parts[0].tolist() == [0.1, 1e16]


@pytest.mark.parametrize("shape", [(3,), (2, 3)])
def test_arrays_of_frames(shape):
    frames = [np.full(shape, number) for number in range(4)]
    np.testing.assert_array_equal(by_frame(frames, shape, int), np.stack(frames))
    none = by_frame([], shape, int)
    assert (none.shape, none.dtype.kind) == ((0, *shape), "i")


@pytest.mark.parametrize(
    ("make", "frame"),
    [
        (CenterlineMetrics, centerlines),
        (CenterlineFScore, centerlines),
        (LaneSegmentMetrics, segments),
        (VectorMapMetrics, lines),
        (TuSimpleMetrics, rows),
        (partial(GroupedMetrics, LaneSegmentMetrics, ("all",)), segments),
    ],
    ids=["centerlines", "f_score", "segments", "lines", "tusimple", "groups"],
)
def test_many_at_once_are_as_one_after_the_other(make, frame):
    parts = [make() for _ in range(6)]
    for number, part in enumerate(parts):
        part.update(*frame(number))
    first, *others = (parts[i] for i in (4, 0, 0, 5, 2, 1))
    before = first.compute()
    assert first.merge(*others).compute() == functools.reduce(lambda a, b: a.merge(b), others, first).compute()
    alone = first.merge()
    assert alone.compute() == first.compute() == before
    alone.update(*frame(3))
    assert alone.compute() != before
    assert first.compute() == before


def test_ranked_detections_keep_the_order_of_equal_scores():
    rng = np.random.default_rng(0)
    scores, hits = rng.integers(0, 5, 60) / 5, rng.random((2, 60)) < 0.4
    order, rows = ranked(scores, hits)
    assert (np.diff(order) <= 0).all()
    for precision in (average_precision_11, average_precision_area):
        assert [precision(order, row, 30) for row in rows] == [precision(scores, row, 30) for row in hits]

"""Markers that are wrong, on purpose: displaced lanes, with a residual that shows it or not; nothing else changes."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fakes import fake_example
from tflane_jax.errors import UserError
from tflane_jax.evaluation.marker_interventions import displaced_markers
from tflane_jax.priors.markers import MarkerPriorConfig, marker_confidence, select_marker_lanes
from tflane_jax.scene import MarkerObservations, stack_examples


def with_markers(seed, capacity=3, lanes=4, points=5):
    """A frame with one padded marker and one padded lane, whose padding is NaN."""
    rng, markers = np.random.default_rng(seed), MarkerObservations.empty(capacity, lanes, points)
    markers.valid[:-1], markers.lane_valid[:-1, :-1] = True, True
    markers.lanes[:] = rng.uniform(-30, 30, markers.lanes.shape)
    markers.pose[:, :3, 3] = rng.uniform(-30, 30, (capacity, 3))
    markers.residual[:] = rng.uniform(0, 5, capacity)
    markers.lanes[~markers.lane_valid], markers.pose[-1], markers.residual[-1] = np.nan, np.nan, np.nan
    return replace(fake_example(seed), markers=markers)


@settings(max_examples=20)
@given(seed=st.integers(0, 99), x=st.floats(-40, 40, width=32), y=st.floats(-40, 40, width=32))
@pytest.mark.parametrize("wrong", ["detection", "store"])
def test_lanes_move_by_the_offset_and_only_markers_change(wrong, seed, x, y):
    example = with_markers(seed)
    moved = displaced_markers(example, np.array([x, y]), wrong)
    before, after = (
        select_marker_lanes(each.markers, MarkerPriorConfig(5, 9, trust="all")) for each in (example, moved)
    )
    order = [np.lexsort(lanes.points[:6, 0].T) for lanes in (before, after)]
    np.testing.assert_allclose(after.points[:6][order[1]], before.points[:6][order[0]] + np.float32([x, y]), atol=1e-4)
    assert before.valid.sum() == after.valid.sum() == 6
    jax.tree.map(np.testing.assert_array_equal, replace(moved, markers=None), replace(example, markers=None))


def test_confidence_falls_with_a_wrong_detection_and_not_with_a_wrong_store():
    examples = stack_examples([with_markers(i) for i in range(4)])
    config, offset = MarkerPriorConfig(), np.array([3.0, 4.0])
    trust = jax.vmap(lambda each: marker_confidence(each, config))
    own = trust(examples.markers)
    detection, store = (trust(displaced_markers(examples, offset, wrong).markers) for wrong in ("detection", "store"))
    np.testing.assert_array_equal(store, own)
    place, moved = (
        np.hypot(*np.moveaxis(p[..., :2, 3], -1, 0))
        for p in (examples.markers.pose, displaced_markers(examples, offset, "detection").markers.pose)
    )
    expected = own * np.exp(-5.0 / config.residual_scale - (moved - place) / config.distance_scale)
    np.testing.assert_allclose(detection[:, :-1], expected[:, :-1], rtol=1e-5)
    np.testing.assert_array_equal(detection[:, -1], 0.0)


def test_examples_without_markers_are_refused():
    with pytest.raises(UserError, match=r"no markers.*data\.example\.markers"):
        displaced_markers(replace(fake_example(0), markers=None), np.zeros(2), "store")

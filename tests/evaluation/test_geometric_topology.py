"""TopoLogic's geometric topology: edges where a lane ends at the start of another one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from tflane_jax.evaluation.geometric_topology import SCALE, geometric_edges, with_geometric_topology
from tflane_jax.metrics.matching import vertex_average_precision
from tflane_jax.scene import CenterlinePrediction, Prediction


def lanes(*ends):
    return np.array([np.linspace(start, end, 4) for start, end in ends], float)


CHAIN = lanes(((0, 0, 0), (10, 0, 0)), ((10, 1, 0), (20, 1, 0)), ((30, 0, 0), (40, 0, 0)))


def test_edges_are_those_of_the_formula():
    edges = geometric_edges(CHAIN)
    assert edges[0, 1] == pytest.approx(math.exp(-1.0 / SCALE))
    assert edges[1, 2] == pytest.approx(math.exp(-(11.0**2) / SCALE))
    assert edges.diagonal().tolist() == [0, 0, 0]
    assert edges[1, 0] < 1e-10


@pytest.mark.parametrize("count", [0, 1])
def test_few_lanes(count):
    assert geometric_edges(np.zeros((count, 3, 3))).shape == (count, count)
    assert (geometric_edges(np.zeros((count, 3, 3))) == 0).all()


@given(st.lists(st.floats(-50, 50), min_size=3, max_size=3), st.permutations(range(3)))
def test_translation_and_order_do_not_matter(shift, order):
    moved = geometric_edges(CHAIN + np.array(shift))
    np.testing.assert_allclose(moved, geometric_edges(CHAIN), atol=1e-9)
    np.testing.assert_array_equal(geometric_edges(CHAIN[order]), geometric_edges(CHAIN)[np.ix_(order, order)])


def confidences(lines, learned):
    """Return the confidences of edges with geometry, and the plain sums that TopoLogic evaluates."""
    prediction = Prediction(centerlines=CenterlinePrediction(lines, np.zeros((len(lines), 1)), logit(learned)))
    changed = with_geometric_topology(prediction).centerlines
    np.testing.assert_array_equal(changed.points, lines)
    assert np.isfinite(changed.successor_logits).all()
    return expit(changed.successor_logits), learned + geometric_edges(lines)


def test_sums_keep_their_order_and_the_threshold():
    learned = expit(np.array([[-3.0, 2.0, -9.0], [-9.0, -3.0, 0.5], [-9.0, -9.0, -3.0]]))
    found, both = confidences(CHAIN, learned)
    expected = np.where(both <= 0.5, both, 0.5 + (both - 0.5) / 3)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert both.max() > 1.0
    assert found.max() < 1.0
    np.testing.assert_array_equal(found > 0.5, both > 0.5)
    np.testing.assert_array_equal(np.argsort(found, None, "stable"), np.argsort(both, None, "stable"))


def test_of_two_near_lanes_the_learned_score_decides():
    """Regression: both sums were cut at 1, so that the true successor and a false one had equal scores."""
    fork = lanes(((0, 0, 0), (10, 0, 0)), ((10.2, 0, 0), (20, 5, 0)), ((10.2, 0.1, 0), (20, 0, 0)))
    learned = np.full((3, 3), 0.05)
    learned[0, 1:] = 0.2, 0.9
    found, both = confidences(fork, learned)
    assert both[0, 1] > 1.0
    true = np.zeros((3, 3), bool)
    true[0, 2] = True
    assert vertex_average_precision(true, found)[0] == vertex_average_precision(true, both)[0] == 1.0
    assert found[0, 1] > 0.5


def test_without_topology_nothing_changes():
    prediction = Prediction(centerlines=CenterlinePrediction(CHAIN, np.zeros((3, 1)), None))
    assert with_geometric_topology(prediction).centerlines is prediction.centerlines

"""TopoLogic's geometric topology: edges where a lane ends at the start of another one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from tflane_jax.evaluation.centerlines import detections_of_centerlines
from tflane_jax.evaluation.geometric_topology import SCALE, edge_confidences, geometric_edges
from tflane_jax.metrics import CenterlineMetrics
from tflane_jax.metrics.frames import LaneTruth
from tflane_jax.metrics.matching import vertex_average_precision
from tflane_jax.scene import CenterlinePrediction


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


def prediction(lines, learned):
    return CenterlinePrediction(lines, np.zeros((len(lines), 1)), None if learned is None else logit(learned))


def test_confidences_are_the_sums_that_topologic_evaluates():
    learned = expit(np.array([[-3.0, 2.0, -9.0], [-9.0, -3.0, 0.5], [-9.0, -9.0, -3.0]]))
    found = edge_confidences(CHAIN, logit(learned), "geometric")
    np.testing.assert_allclose(found, learned + geometric_edges(CHAIN), atol=1e-9)
    assert found.max() > 1.0
    np.testing.assert_allclose(edge_confidences(CHAIN, logit(learned)), learned, atol=1e-9)


def test_of_two_near_lanes_the_learned_score_decides():
    """Regression: both sums were cut at 1, so that the true successor and a false one had equal scores."""
    fork = lanes(((0, 0, 0), (10, 0, 0)), ((10.2, 0, 0), (20, 5, 0)), ((10.2, 0.1, 0), (20, 0, 0)))
    learned = np.full((3, 3), 0.05)
    learned[0, 1:] = 0.2, 0.9
    found = edge_confidences(fork, logit(learned), "geometric")
    true = np.zeros((3, 3), bool)
    true[0, 2] = True
    assert vertex_average_precision(true, found)[0] == 1.0


@pytest.mark.parametrize(("version", "without"), [("v2.1", 1 / 4), ("v1.0", 1 / 12)])
def test_an_edge_above_one_ranks_before_those_that_the_program_assumes(version, without):
    """Regression: sums were brought below 1, where v1.0 ranks them behind the false edges of unmatched lanes.

    Of four true lanes in a row, the first two are found, and their edge: two of eight vertices. In v1.0 the false edges
    from and to the other lanes have confidence 1, two at each of these vertices.
    """
    row = lanes(*(((10 * i, 0, 0), (10 * i + 10, 0, 0)) for i in range(4)))
    truth = LaneTruth(row, np.eye(4, k=1, dtype=bool))
    found = prediction(row[:2], np.array([[1e-3, 0.6], [1e-3, 1e-3]]))
    for topology, expected in (("learned", without), ("geometric", 1 / 4)):
        metrics = CenterlineMetrics((version,))
        metrics.update(detections_of_centerlines(found, topology=topology), truth)
        assert metrics.compute()["TOP_ll"] == pytest.approx(expected)


def test_without_predicted_topology_geometry_adds_none():
    for topology in ("learned", "geometric"):
        found = detections_of_centerlines(prediction(CHAIN, None), topology=topology)
        np.testing.assert_array_equal(found.successor, np.zeros((3, 3)))

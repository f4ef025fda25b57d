"""Merging lane segments over one-to-one joints."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.datasets.small_logs import lane_map, segment
from tflane_jax.datasets.chains import merge_chains
from tflane_jax.scene import LineType


def straight(number, successors=(), **other):
    return segment(number, [(10.0 * number, 0.0), (10.0 * number + 10.0, 0.0)], successors, **other)


def merged(*segments):
    return merge_chains(lane_map(*segments).segments)


def test_a_row_of_segments_becomes_one_line_without_repeated_points():
    result = merged(straight(0, [1]), straight(1, [2]), straight(2))
    assert list(result.chains) == [0]
    assert result.chain_of == {0: 0, 1: 0, 2: 0}
    np.testing.assert_array_equal(result.chains[0].centerline[:, 0], [0, 10, 20, 30])
    assert len(result.chains[0].left) == len(result.chains[0].right) == 4
    assert result.chains[0].successors == ()


def test_forks_and_merges_stay():
    fork = merged(straight(0, [1, 2]), straight(1), straight(2))
    assert fork.chains[0].successors == (1, 2)
    merge = merged(straight(0, [2]), straight(1, [2]), straight(2, [3]), straight(3))
    assert {i: c.successors for i, c in merge.chains.items()} == {0: (2,), 1: (2,), 2: ()}
    assert merge.chain_of[3] == 2


def test_a_successor_outside_the_map_still_makes_a_fork_but_is_no_edge():
    result = merged(straight(0, [1, 99]), straight(1))
    assert {i: c.successors for i, c in result.chains.items()} == {0: (1,), 1: ()}


@pytest.mark.parametrize("count", [1, 3])
def test_a_closed_loop_is_cut_once_and_succeeds_itself(count):
    result = merged(*(straight(i, [(i + 1) % count]) for i in range(count)))
    assert list(result.chains) == [0]
    assert result.chains[0].successors == (0,)
    assert len(result.chains[0].centerline) == count + 1


def test_labels_are_those_of_most_length():
    short = segment(0, [(0, 0), (5, 0)], [1], left=LineType.NONE, right=LineType.SOLID, is_intersection=True)
    long = segment(1, [(5, 0), (30, 0)], left=LineType.DASHED, right=LineType.NONE, vehicle=False)
    chain = merged(short, long).chains[0]
    assert (chain.left_type, chain.right_type) == (LineType.DASHED, LineType.NONE)
    assert chain.is_intersection is False
    assert chain.vehicle is False


def test_no_segments():
    assert merge_chains({}).chains == {}


@settings(max_examples=40)
@given(
    st.integers(1, 8).flatmap(
        lambda n: st.lists(st.lists(st.integers(0, n - 1), max_size=2, unique=True), min_size=n, max_size=n)
    )
)
def test_every_segment_is_in_one_chain_and_every_edge_is_kept_or_merged(successors):
    result = merged(*(straight(i, s) for i, s in enumerate(successors)))
    incoming = [sum(j in s for s in successors) for j in range(len(successors))]
    joints = {(i, s[0]) for i, s in enumerate(successors) if len(s) == 1 and incoming[s[0]] == 1}
    edges = {(i, j) for i, s in enumerate(successors) for j in s}
    assert set(result.chain_of) == set(range(len(successors)))
    assert set(result.chain_of.values()) == set(result.chains)
    assert all(result.chain_of[i] == result.chain_of[j] for i, j in joints)
    kept = {(i, j) for i, chain in result.chains.items() for j in chain.successors}
    expected = {(result.chain_of[i], result.chain_of[j]) for i, j in edges - joints}
    # The one joint at which a closed loop was cut is the only one that stays an edge.
    assert {(i, j) for i, j in kept if i != j} == {(i, j) for i, j in expected if i != j}
    assert {i for i, j in kept - expected if i == j} <= {result.chain_of[i] for i, _ in joints}
    members = [sum(of == chain for of in result.chain_of.values()) for chain in result.chains]
    inner = [sum(result.chain_of[i] == chain for i, _ in joints) for chain in result.chains]
    for chain, count, joined in zip(result.chains, members, inner, strict=True):
        assert joined == count - 1 or (joined == count and chain in result.chains[chain].successors)

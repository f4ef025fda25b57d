"""Other traffic flow at inference: exchanged between scenes, or taken away; nothing else changes."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fakes import FakeConfig, FakeDataset, fake_example
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.errors import UserError
from tflane_jax.evaluation.interventions import (
    example_scenes,
    other_scene_rows,
    traffic_interventions,
    with_traffic,
)
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.scene import stack_examples

# Every second fake example continues the scene of the one before.
EXAMPLES = stack_examples([fake_example(i) for i in range(7)])


@settings(max_examples=40)
@given(sizes=st.lists(st.integers(1, 4), min_size=2, max_size=9))
def test_no_scene_gets_its_own_traffic_and_every_scene_gives_to_one(sizes):
    scene = np.repeat(np.arange(len(sizes)), sizes)
    rows = other_scene_rows(scene)
    givers = [scene[rows[scene == number]] for number in range(len(sizes))]
    assert all(len(np.unique(giver)) == 1 and giver[0] != number for number, giver in enumerate(givers))
    assert sorted(giver[0] for giver in givers) == list(range(len(sizes)))
    # In order, from the beginning again.
    first = np.cumsum([0, *sizes])
    for number, giver in enumerate(givers):
        places = rows[scene == number] - first[giver[0]]
        np.testing.assert_array_equal(places, np.arange(sizes[number]) % sizes[giver[0]])


@pytest.mark.parametrize("traffic", ["none", "other-scene"])
@pytest.mark.parametrize("streamed", [False, True])
def test_only_traffic_changes(traffic, streamed):
    arrays = Streamed(FakeDataset(FakeConfig(7)), select=lambda e: replace(e, cameras=None)) if streamed else EXAMPLES
    changed = with_traffic(arrays, traffic)
    if isinstance(changed, Streamed):
        assert len(changed) == 7
        assert changed.dataset.info(3).scene == "scene 1"
        changed = stack_examples([changed.example(i) for i in range(7)])
    for name in ("bev", "lanes", "has_previous"):
        jax.tree.map(np.testing.assert_array_equal, getattr(changed, name), getattr(EXAMPLES, name))
    if traffic == "none":
        assert not changed.traffic_flow.valid.any()
        return
    rows = other_scene_rows(np.array([0, 0, 1, 1, 2, 2, 3]))
    expected = jax.tree.map(lambda leaf: leaf[rows], EXAMPLES.traffic_flow)
    jax.tree.map(np.testing.assert_array_equal, changed.traffic_flow, expected)


def test_own_traffic_changes_nothing():
    assert with_traffic(EXAMPLES, "own") is EXAMPLES


def test_scenes_are_numbered_by_their_first_frames():
    np.testing.assert_array_equal(example_scenes(EXAMPLES), [0, 0, 1, 1, 2, 2, 3])
    np.testing.assert_array_equal(example_scenes(Streamed(FakeDataset(FakeConfig(5)))), [0, 0, 1, 1, 2])
    second = jax.tree.map(lambda leaf: leaf[1:4], EXAMPLES)  # starts in the middle of a scene
    np.testing.assert_array_equal(example_scenes(second), [0, 1, 1])


def test_examples_that_cannot_be_changed_are_named():
    with pytest.raises(UserError, match="no traffic flow"):
        with_traffic(EXAMPLES.replace(traffic_flow=None), "none")
    one_scene = jax.tree.map(lambda leaf: leaf[:2], EXAMPLES)
    with pytest.raises(UserError, match="at least two scenes"):
        with_traffic(one_scene, "other-scene")
    found = {name: config.traffic for name, config in traffic_interventions(one_scene, EvaluationConfig()).items()}
    assert found == {"no traffic flow at inference": "none"}
    both = traffic_interventions(EXAMPLES, EvaluationConfig(batch_size=3)).values()
    assert list(both) == [EvaluationConfig(3, traffic="none"), EvaluationConfig(3, traffic="other-scene")]

"""What a table shows of an evaluation."""

import math

import pytest

from tflane_jax.evaluation.results import Evaluation

EMPTY = {"frames": 3, "lanes": 0, "DET_l": 1.0, "recall": 0.0}


@pytest.mark.parametrize("group", ["occluded", "segments occluded", "gap", "hidden+traffic"])
def test_a_group_without_lanes_has_counts_alone(group):
    found = Evaluation("protocol", {group: EMPTY})
    assert found.shown(group) == {"frames": 3, "lanes": 0}
    assert found.recorded() == {}
    assert found.scores() == pytest.approx({f"{group}/{name}": math.nan for name in ("DET_l", "recall")}, nan_ok=True)


def test_lines_count_as_lanes_do():
    part = {"frames": 3, "lines": 0, "mAP": 0.0}
    assert Evaluation("protocol", {"lines occluded": part}).shown("lines occluded") == {"frames": 3, "lines": 0}


@pytest.mark.parametrize("group", ["all", "segments all"])
def test_the_whole_test_set_keeps_the_official_convention(group):
    found = Evaluation("protocol", {group: EMPTY})
    assert found.shown(group) == EMPTY
    assert found.recorded() == found.scores()


def test_scores_of_a_group_with_lanes_and_of_other_protocols_are_shown():
    groups = {"occluded": EMPTY | {"lanes": 1}, "photos": {"Accuracy": 0.9}}
    found = Evaluation("protocol", groups)
    assert {name: found.shown(name) for name in groups} == groups

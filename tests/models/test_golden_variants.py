"""Golden cases of heads with other options: public ones, changed in a way whose effect on every number is known."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.models import test_lanesegnet_golden, test_maptr_golden, test_maptrv2_golden
from tests.models.golden_maps import perception_range
from tests.test_golden_harness import public, with_options, without_gradients

pytestmark = [pytest.mark.golden, pytest.mark.slow]


def changed(case, pattern, change):
    """Return the parameters with `change` applied to weights and biases of the layers that match a pattern."""
    matches = [name for name in case.params if re.fullmatch(pattern + r"\.(weight|bias)", name)]
    assert matches
    return case.params | {name: change(case.params[name]) for name in matches}


def test_segments_of_one_class():
    """The map-element-bucket variant: without the second class, nothing else changes."""
    case = public("laneseg_head_eval")
    one = replace(with_options(without_gradients(case), classes=1), params=changed(case, CLASSES, lambda x: x[:1]))
    scores = case.outputs["all_cls_scores"][..., :1]
    test_lanesegnet_golden.check_head(replace(one, outputs=case.outputs | {"all_cls_scores": scores}))


CLASSES = r"cls_branches\.\d+\.6"
POINTS = r"(transformer\.reference_points|reg_branches\.\d+\.4)"
HEADS = {
    "maptr_head_gkt": test_maptr_golden,
    "maptrv2_head_eval": test_maptrv2_golden,
    "maptrv2_head_train": test_maptrv2_golden,
}


@pytest.mark.parametrize("name", HEADS)
def test_a_head_of_three_coordinates(name):
    """The third one is never moved, and true lines lie in the middle of its range: scores and losses stay the same."""
    case = without_gradients(public(name))
    middle = float(np.mean(perception_range(case).z))

    def raised(value, height):
        return np.concatenate([value, np.full_like(value[..., :1], height)], -1)

    def orders(value):
        return np.where(value[..., :1] > -9999, raised(value, middle), np.float32(-10000))

    heights = {"all_pts_preds": 0.5, "pts": middle}  # the predictions are fractions of the range
    outputs = {
        key: raised(value, heights[key.rpartition(".")[2]]) if key.rpartition(".")[2] in heights else value
        for key, value in case.outputs.items()
    }
    inputs = {key: orders(value) if key.startswith("gt_shift_pts") else value for key, value in case.inputs.items()}
    params = changed(case, POINTS, lambda value: np.concatenate([value, np.zeros_like(value[:1])]))
    HEADS[name].check_head(replace(case, params=params, inputs=inputs, outputs=outputs))

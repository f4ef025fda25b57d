"""Annotations of OpenLane-V2 that cannot be true are refused, and the check reports them."""

import re
import shutil

import pytest

from tests.datasets.openlane_scenes import DriveConfig, DriveDataset
from tests.datasets.test_openlane_v2 import change, info, opened
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.errors import UserError


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("openlane") / "made"
    return export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=1))}, out, images="png", progress=False)


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def _lanes(function):
    """Return the damage of the annotation's lanes by a function."""
    return lambda folder: change(
        info(folder, 0, "-ls"), lambda content: function(content["annotation"]["lane_segment"], content["annotation"])
    )


def swap(lanes, _):
    lanes[1]["left_laneline"], lanes[1]["right_laneline"] = lanes[1]["right_laneline"], lanes[1]["left_laneline"]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda lanes, _: lanes[0].update(is_intersection_or_connector="False"), r"lane_segment\[0\].is_.*'False'"),
        (lambda lanes, _: lanes[0].update(is_intersection_or_connector=2), "is 2, expected true or false"),
        (lambda lanes, _: [lane.update(id=7) for lane in lanes], "two of lane_segment have the id '7'"),
        (lambda _, whole: whole["topology_lsls"][2].__setitem__(2, 1), r"lane_segment\[2\] is its own successor"),
        (swap, r"lane_segment\[1\]: the left boundary is to the right"),
        (lambda lanes, _: [swap(lanes, _), swap(lanes, _)], None),
    ],
)
def test_lanes_that_cannot_be_true_are_refused_and_reported(folder, damage, said):
    _lanes(damage)(folder)
    data = opened(folder, None, flavour="lane_segment")
    if said is None:
        assert data.example(0).segments.valid.sum() == 3
        return
    with pytest.raises(UserError, match=said):
        data.example(0)
    (fault,) = check_openlane_v2(folder, progress=False).faults
    assert re.search(said, fault)

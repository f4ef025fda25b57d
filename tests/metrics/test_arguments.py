"""Arguments of metrics that are none of those allowed are named, instead of measuring by another protocol."""

import dataclasses

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.metrics.centerline_matching import match_frame
from tflane_jax.metrics.f_score import CenterlineFScore
from tflane_jax.metrics.frames import LaneDetections, LaneTruth
from tflane_jax.metrics.groups import GroupedMetrics
from tflane_jax.metrics.lane_segment import LaneSegmentMetrics
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.metrics.partitions import ByDistance
from tflane_jax.metrics.vector_map import VectorMapMetrics

LANES = np.stack([np.linspace([0, y, 0], [30, y, 0], 11) for y in (0.0, 5.0)])


def lanes(successor=None):
    truth = LaneTruth(LANES, np.zeros((2, 2)) if successor is None else successor, visibility=np.ones(2))
    return LaneDetections(LANES, np.ones(2), np.zeros((2, 2))), truth


def grouped(**further):
    return GroupedMetrics(CenterlineMetrics, **further)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: LaneSegmentMetrics("lanesegnet"), "flavour is 'lanesegnet': it must be 'OpenLane-V2' or 'LaneSegNet'"),
        (lambda: VectorMapMetrics("MapTRv2"), "sampling is 'MapTRv2': it must be 'maptr' or"),
        (lambda: VectorMapMetrics(measure="Chamfer"), "measure is 'Chamfer'"),
        (lambda: VectorMapMetrics(dims=4), "dims is 4"),
        (lambda: grouped(groups=("all", "visible")), "groups names 'visible': give a list of all, occluded, clear"),
        (lambda: grouped(groups="occluded"), "groups names 'occluded': give a list"),
        (lambda: ByDistance((20.0, 10.0)), r"are \(20.0, 10.0\): give metres above 0 in ascending order"),
        (lambda: grouped(frame_groups=("all",)), "two groups are called all"),
        (lambda: grouped(lane_groups=("own",), frame_groups=("own",)), "two groups are called own"),
    ],
)
def test_other_arguments_are_refused(make, said):
    with pytest.raises(UserError, match=said):
        make()


@pytest.mark.parametrize("metric", [CenterlineMetrics, CenterlineFScore, grouped])
def test_swapped_arguments_are_named(metric):
    found, truth = lanes()
    with pytest.raises(UserError, match=r"LaneTruth and LaneDetections are given: detections \(LaneDetections\) come"):
        metric().update(truth, found)


@pytest.mark.parametrize(
    ("members", "said"),
    [
        (None, "members lacks own"),
        ({"other": np.ones(2, bool)}, "members lacks own"),
        ({"own": np.array([0, 1])}, r"members of own are int64 of shape \(2,\), expected bool of shape \(2,\)"),
        ({"own": np.ones(3, bool)}, r"of shape \(3,\)"),
    ],
)
def test_members_are_a_flag_for_each_lane(members, said):
    """Regression: zeros and ones were taken as places, and recall was 200 %."""
    with pytest.raises(UserError, match=said):
        grouped(lane_groups=("own",)).update(*lanes(), members=members)
    metrics = grouped(lane_groups=("own",))
    metrics.update(*lanes(), members={"own": [False, True]})
    assert metrics.compute()["own"]["recall"] == 1.0


def test_an_unknown_group_of_frames_is_refused():
    metrics = grouped(frame_groups=("rain",))
    with pytest.raises(UserError, match="there is no group of frames 'rian', only rain"):
        metrics.update(*lanes(), frame_group="rian")


def test_a_refused_frame_changes_nothing():
    """Regression: `all` counted it, and the groups no longer had the same frames."""
    metrics, (detections, truth) = grouped(), lanes()
    metrics.update(detections, truth)
    before = metrics.compute()
    with pytest.raises(UserError, match="no visibility"):
        metrics.update(detections, dataclasses.replace(truth, visibility=None))
    assert metrics.compute() == before
    assert metrics.bootstrap(np.ones((3, 1), int))["clear"]["DET_l"].tolist() == [1.0] * 3


@pytest.mark.parametrize("value", [0.3, -1, 2])
def test_edges_are_zero_or_one(value):
    detections, truth = lanes(np.full((2, 2), value))
    with pytest.raises(UserError, match="truth: successor holds a number that is neither 0 nor 1"):
        match_frame(detections, truth)

"""Which road users a lane depends on: scores by hand, and a model that follows one road user."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import BASELINE, SEGMENTS, WITH_TRAFFIC, make_example, make_segment_example
from tests.parameters import random_params
from tflane_jax.errors import UserError
from tflane_jax.evaluation.attribution import (
    LaneGain,
    each_alone,
    fading_scores,
    lane_scores,
    lanes_by_gain,
    one_after_another,
    predict_without,
    road_user_effects,
    scores_without,
    traffic_attention,
    valid_lanes,
    without_tracks,
)
from tflane_jax.evaluation.lane_groups import LANE_GROUPS, lane_groups
from tflane_jax.evaluation.predict import predict_batch
from tflane_jax.geometry import BevGrid
from tflane_jax.models.host import HostConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.traffic_masks import TrafficMaskConfig
from tflane_jax.scene import CenterlinePrediction, Prediction, RoadUser, SegmentPrediction, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

TASK = LaneGraphTask(WITH_TRAFFIC)
GROUND = BevGrid().range
TRACKS = 16


@dataclass(frozen=True)
class Follower:
    """Predicts the first true lane with the score 0.5 + 0.05 for each road user, 1 m off without road user `leader`."""

    leader: int
    model: HostConfig = WITH_TRAFFIC
    streams: bool = False

    def predict(self, params, example):
        there = example.traffic_flow.valid.any(-1)
        moved = jnp.where(there[self.leader], 0.0, params)
        score = 0.5 + 0.05 * there.sum()
        logit = jnp.log(score / (1 - score))
        if self.model.predicts == ("segments",):  # a crossing has the higher score, and is no lane
            points = (example.segments.points[:1] + moved).astype(jnp.float32)
            return Prediction(segments=SegmentPrediction(points, points, points, jnp.stack([logit, 9.0])[None]))
        points = (example.lanes.points[:1] + moved).astype(jnp.float32)
        return Prediction(centerlines=CenterlinePrediction(points, logit[None, None]))


def line(y, reverse=False):
    x = np.linspace(-20.0, 20.0, 11)
    points = np.stack([x, np.full(11, y), np.zeros(11)], -1)
    return points[::-1] if reverse else points


def prediction(*lanes):
    """Return a prediction of (line, score)."""
    scores = np.array([score for _, score in lanes])
    return CenterlinePrediction(np.stack([points for points, _ in lanes]), np.log(scores / (1 - scores))[:, None])


@pytest.mark.parametrize(
    ("lanes", "score", "query"),
    [
        ([(line(0.5), 0.6)], 0.6, 0),
        ([(line(1.5), 0.6)], 0.4, 0),  # two of three thresholds
        ([(line(2.5), 0.6)], 0.2, 0),
        ([(line(2.5), 0.9), (line(0.1), 0.5)], 0.5, 1),
        ([(line(0.1), 0.3), (line(2.5), 0.99)], 0.33, 1),
        ([(line(9.0), 0.9), (line(-4.0), 0.1)], 0.0, 1),  # none is near: the nearest
        ([(line(0.0, reverse=True), 0.9)], 0.0, 0),
    ],
)
def test_the_score_of_a_lane_by_hand(lanes, score, query):
    scores, queries = lane_scores(prediction(*lanes), np.stack([line(0.0), line(100.0)]))
    np.testing.assert_allclose(scores, [score, 0.0], rtol=1e-5)
    assert queries[0] == query


def test_without_lanes_there_are_no_scores():
    scores, queries = lane_scores(prediction((line(0.0), 0.5)), np.zeros((0, 11, 3)))
    assert scores.shape == queries.shape == (0,)


def test_sets_of_absent_tracks():
    users = np.array([2, 0])
    np.testing.assert_array_equal(each_alone(users, 3), [[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(one_after_another(users, 3), [[0, 0, 0], [0, 0, 1], [1, 0, 1]])
    assert each_alone(users[:0], 3).shape == (0, 3)
    np.testing.assert_array_equal(one_after_another(users[:0], 3), [[0, 0, 0]])


def test_only_the_tracks_change():
    example, absent = make_example(), each_alone(np.array([4, 1]), TRACKS)
    copies = without_tracks(example, absent)
    for row, gone in enumerate((4, 1)):
        flow = jax.tree.map(lambda leaf, row=row: leaf[row], copies).traffic_flow
        assert not flow.valid[gone].any()
        np.testing.assert_array_equal(np.delete(flow.valid, gone, 0), np.delete(example.traffic_flow.valid, gone, 0))
        np.testing.assert_array_equal(copies.bev[row], example.bev)
    with pytest.raises(UserError, match="no traffic flow"):
        without_tracks(example.replace(traffic_flow=None), absent)


@pytest.mark.parametrize("model", [WITH_TRAFFIC, SEGMENTS], ids=["centerlines", "segments"])
def test_scores_without_road_users(model):
    example, follower = make_segment_example(instances=3), Follower(1, model)
    lanes, absent = valid_lanes(follower, example)[:1], each_alone(np.array([0, 1, 7]), TRACKS)
    scores = scores_without(follower, jnp.asarray(1.5), example, lanes, absent, batch_size=2)
    # 1.5 m along x, y and z is more than 2 m; track 7 is padding.
    np.testing.assert_allclose(scores[:, 0], [0.6, 0.6 / 3, 0.65], rtol=1e-5)
    answers = predict_without(follower, jnp.asarray(1.5), example, absent)
    np.testing.assert_allclose(answers[1].points, lanes + 1.5, rtol=1e-6)


@pytest.mark.parametrize(("order", "expected"), [([0, 1, 2], [0.65, 0.6, 0.0, 0.0, 0.0]), ([1], [0.65] + 4 * [0.0])])
def test_scores_fade_in_the_order_of_leaving(order, expected):
    examples = stack_examples([make_example(1), make_example(instances=3)])
    lane = LaneGain(1, 0, 0, 0.65, 0.0, 0.0)
    scores = fading_scores(Follower(1), jnp.asarray(9.0), examples, lane, np.array(order), length=4)
    np.testing.assert_allclose(scores, expected, rtol=1e-5, atol=1e-6)
    shorter = fading_scores(Follower(1), jnp.asarray(9.0), examples, lane, np.array(order), length=1)
    np.testing.assert_allclose(shorter, expected[:2], rtol=1e-5, atol=1e-6)


def grouped_example(evidence):
    """Return four lanes, 4 m apart, under the same evidence; a car drives along each of the first two."""
    example = make_segment_example(instances=0)
    flow = example.traffic_flow
    flow.valid[:2], flow.occluded[:2], flow.category[:2], flow.yaw[:2] = True, False, RoadUser.CAR, 0.0
    flow.position[:2, :, :2] = example.lanes.points[:2, np.linspace(0, 10, flow.valid.shape[1]).astype(int), :2]
    return example.replace(lanes=example.segments, bev=np.full_like(example.bev, evidence))


@pytest.mark.parametrize("group", LANE_GROUPS)
def test_lanes_are_sorted_by_what_both_others_lack(group):
    examples = stack_examples([grouped_example(evidence) for evidence in (0, 255, 0)])
    follower, still = (Follower(0), jnp.asarray(9.0)), (Follower(0), jnp.asarray(0.0))
    members = []
    for i in range(3):
        example = jax.tree.map(lambda leaf, i=i: leaf[i], examples)
        inside = lane_groups(example.lanes, example.bev, example.traffic_flow, GROUND)[group]
        members += [(i, lane) for lane in np.flatnonzero(inside)]
    alone = lanes_by_gain(*follower, examples, GROUND, group=group)
    assert len(alone) > 1
    assert sorted((gain.example, gain.lane) for gain in alone) == members
    assert [gain.gain for gain in alone] == sorted((gain.gain for gain in alone), reverse=True)
    assert all(np.isnan(gain.baseline) and gain.without == 0.0 for gain in alone)
    beside = lanes_by_gain(*follower, examples, GROUND, group=group, baseline=still)
    assert {(gain.baseline, gain.gain) for gain in beside} == {(gain.score, 0.0) for gain in beside}


@pytest.mark.slow
def test_attention_is_a_distribution_over_the_road_users():
    examples = stack_examples([make_example(0), make_example(1), make_example(2, instances=0)])
    params = random_params(TASK.init, make_example())
    answer, weights = traffic_attention(TASK.model, params, examples)
    assert weights.shape == (3, 6, 5)
    np.testing.assert_allclose(weights.sum(-1), np.repeat([[1.0], [1.0], [0.0]], 6, 1), rtol=1e-5)
    expected = predict_batch(TASK, params, examples).centerlines
    np.testing.assert_allclose(answer.centerlines.points, expected.points, rtol=1e-4, atol=1e-3)

    lanes = [LaneGain(0, 1, 2, 0.0, 0.0, 0.0), LaneGain(1, 0, 5, 0.0, 0.0, 0.0), LaneGain(2, 0, 0, 0.0, 0.0, 0.0)]
    effects = road_user_effects(TASK, params, examples, lanes, batch_size=3)
    for lane, effect, row in zip(lanes, effects, weights, strict=True):
        count = len(effect.road_user)
        np.testing.assert_allclose(effect.attention, row[lane.query, :count], rtol=1e-6)
        assert effect.driven.shape == effect.without.shape == (count,)
    assert [len(effect.road_user) for effect in effects][2] == 0
    example, absent = make_example(0), each_alone(effects[0].road_user, TRACKS)
    alone = scores_without(TASK, params, example, valid_lanes(TASK, example)[[1]], absent, batch_size=3)
    np.testing.assert_allclose(effects[0].without, alone[:, 0])


@pytest.mark.parametrize(
    "model",
    [
        BASELINE,
        replace(
            WITH_TRAFFIC,
            priors=replace(
                WITH_TRAFFIC.priors, traffic_flow=replace(WITH_TRAFFIC.priors.traffic_flow, insert="nowhere")
            ),
        ),
    ],
)
def test_a_model_whose_lanes_do_not_attend_is_named(model):
    with pytest.raises(UserError, match="do not attend to traffic"):
        traffic_attention(model, {}, stack_examples([make_example()]))


def test_one_softmax_over_lanes_and_traffic_has_no_weights_of_its_own():
    """Regression: KeyError 'L_to_T'."""
    traffic = WITH_TRAFFIC.priors.traffic_flow
    module = replace(traffic.module, masking=TrafficMaskConfig(softmax="joint"))
    model = replace(WITH_TRAFFIC, priors=PriorsConfig(traffic_flow=replace(traffic, module=module)))
    with pytest.raises(UserError, match=r"one softmax, .*masking\.softmax=quadrants"):
        traffic_attention(model, {}, stack_examples([make_example()]))

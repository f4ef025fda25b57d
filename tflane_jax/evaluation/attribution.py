"""How a predicted lane depends on single road users: the attention of its query, and its score without them.

Attention weights show what the traffic-flow module reads, but not what the prediction depends on: values are
transformed and mixed later, and BEV features may hold the same traffic. Removing road users measures the dependence.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import repeat
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.evaluation.interventions import with_traffic
from tflane_jax.evaluation.lane_groups import driven_fraction, lane_groups
from tflane_jax.evaluation.predict import Predictor, predictions
from tflane_jax.geometry import PerceptionRange
from tflane_jax.metrics.centerline_matching import LANE_THRESHOLDS
from tflane_jax.metrics.frechet import pair_frechet
from tflane_jax.models.host import HostConfig
from tflane_jax.models.parameters import Params, split_statistics
from tflane_jax.scene import CenterlinePrediction, Example, LaneGraph, Prediction, TrafficFlow, row_of


class HostPredictor(Predictor, Protocol):
    """A task with a host."""

    @property
    def model(self) -> HostConfig:
        """The host's configuration."""
        ...


class LaneGain(NamedTuple):
    """What traffic gives to one true lane of one example; scores as from `lane_scores`.

    Attributes:
        example: index of the example.
        lane: index among the example's `valid_lanes`.
        query: of the predicted lane that has the score.
        score: with the example's traffic flow.
        without: of the same model without any traffic flow.
        baseline: of a model that was trained without traffic flow; NaN if there is none.
    """

    example: int
    lane: int
    query: int
    score: float
    without: float
    baseline: float

    @property
    def gain(self) -> float:
        """The score minus the better of the others."""
        return self.score - max(self.without, np.nan_to_num(self.baseline))


class RoadUserEffects(NamedTuple):
    """Effect on one predicted lane of each of the T road users that the prior selects for its frame.

    Attributes:
        road_user: (T,) index of the track in the traffic flow.
        attention: (T,) of the lane's query to the road user, mean over heads; the sum is the part of the heads in
            which the lane may attend to a road user: 1 without masks by distance.
        driven: (T,) fraction of the lane's length that the road user drove along, see `driven_fraction`.
        without: (T,) score of the lane when only this road user is removed.
    """

    road_user: Int[np.ndarray, " t"]
    attention: Float[np.ndarray, " t"]
    driven: Float[np.ndarray, " t"]
    without: Float[np.ndarray, " t"]


def lanes_by_gain(
    task: HostPredictor,
    params: Params,
    examples: Example,
    ground: PerceptionRange,
    *,
    baseline: tuple[HostPredictor, Params] | None = None,
    group: str = "hidden+traffic",
    batch_size: int = 16,
) -> list[LaneGain]:
    """Return the true lanes of a group (`evaluation.lane_groups`), those that gain most from traffic first.

    A model that was trained with traffic relies on it: without any, it is behind a model that was trained without. With
    a baseline, the gain is therefore counted against the better of the two, see `LaneGain.gain`.

    Args:
        task, params: a model of centerlines or lane segments without memory.
        examples: stacked, with BEV evidence and traffic flow.
        ground: the range that the evidence covers.
        baseline: task and parameters of a model that was trained without traffic flow.
        group: one of `LANE_GROUPS`.
        batch_size: examples predicted at a time.
    """
    with_flow = _frames(task, params, examples, batch_size)
    without_flow = _frames(task, params, with_traffic(examples, "none"), batch_size)
    count = len(examples.has_previous)
    of_baseline = repeat(None, count) if baseline is None else _frames(*baseline, examples, batch_size)
    gains = []
    for i, (own, less, other) in enumerate(zip(with_flow, without_flow, of_baseline, strict=True)):
        example: Example = row_of(examples, i)
        truth, lanes = _truth(task, example), valid_lanes(task, example)
        score, query = lane_scores(own, lanes)
        without = lane_scores(less, lanes)[0]
        by_baseline = np.full(len(lanes), np.nan) if other is None else lane_scores(other, lanes)[0]
        members = lane_groups(truth, np.asarray(example.bev), _flow(example), ground)[group]
        gains += [
            LaneGain(
                example=i,
                lane=lane,
                query=int(query[lane]),
                score=float(score[lane]),
                without=float(without[lane]),
                baseline=float(by_baseline[lane]),
            )
            for lane in np.flatnonzero(members).tolist()
        ]
    return sorted(gains, key=lambda lane: -lane.gain)


def road_user_effects(
    task: HostPredictor, params: Params, examples: Example, lanes: Sequence[LaneGain], *, batch_size: int = 16
) -> list[RoadUserEffects]:
    """Return for each lane its road users: attention, whether they drove along it, and its score without each.

    Args:
        task, params: a model with the traffic-flow module, without memory.
        examples: stacked.
        lanes: as from `lanes_by_gain` of the same examples.
        batch_size: predicted at a time.
    """
    found, rows = [], np.array([lane.example for lane in lanes], int)
    _, weights = traffic_attention(task.model, params, jax.tree.map(lambda leaf: np.asarray(leaf)[rows], examples))
    prior: Any = task.model.build_priors()["traffic_flow"]
    for lane, attention in zip(lanes, weights, strict=True):
        example: Example = row_of(examples, lane.example)
        tokens, flow = prior.observe(example, None)[0], _flow(example)
        users, points = tokens.index[tokens.valid], valid_lanes(task, example)[[lane.lane]]
        absent = each_alone(users, len(flow.valid))
        without = scores_without(task, params, example, points, absent, batch_size=batch_size)[:, 0]
        driven = driven_by_each(points, flow, users)[:, 0]
        found.append(RoadUserEffects(users, attention[lane.query][tokens.valid], driven, without))
    return found


def traffic_attention(
    model: HostConfig, params: Params, examples: Example
) -> tuple[Prediction, Float[np.ndarray, "b q t"]]:
    """Return predictions and the attention of every lane query to every traffic-flow token, mean over heads.

    Args:
        model: a host with the traffic-flow module. The first L->T of the spatial encoder is read.
        params: its parameters.
        examples: single frames, stacked.

    Returns:
        The last decoder layer's predictions, stacked, and the weights. Each row sums to the part of the heads in which
        the lane may attend to a road user: 1 without masks by distance, 0 without traffic.

    Raises:
        UserError: lanes of this model do not attend to traffic, or share the softmax of lanes with it.
    """
    traffic = model.priors.traffic_flow
    if traffic is None or traffic.insert == "nowhere" or "L->T" not in traffic.module.fusions:
        raise UserError("lanes of this model do not attend to traffic: see task.model.priors.traffic_flow")
    if traffic.module.masking.softmax == "joint":
        raise UserError(
            "lanes of this model attend to lanes and traffic by one softmax, so that the weights of road users do not "
            "sum to 1: choose a model with task.model.priors.traffic_flow.module.masking.softmax=quadrants"
        )
    return jax.device_get(_attention(model, params, examples))


@functools.partial(jax.jit, static_argnums=0)
def _attention(model: HostConfig, params: Params, examples: Example) -> tuple[Prediction, Float[Array, "b q t"]]:
    learned, statistics = split_statistics(params)
    module, variables = model.build(), {"params": learned} | statistics

    def attention(example: Example) -> tuple[Prediction, Float[Array, "q t"]]:
        result: Any = module.apply(variables, example, mutable=["intermediates"])
        layers, state = result
        weights = state["intermediates"]["spatial_encoder_0"]["L_to_T"]["probabilities"][0]
        return jax.tree.map(lambda leaf: leaf[-1], layers), weights.mean(0)

    return jax.vmap(attention)(examples)


def lane_scores(
    prediction: CenterlinePrediction, lanes: Float[np.ndarray, "g n 3"]
) -> tuple[Float[np.ndarray, " g"], Int[np.ndarray, " g"]]:
    """Return for each lane the score of the predicted lane that finds it best, and its query.

    A predicted lane counts with its score times the fraction of OpenLane-V2's thresholds (1, 2, 3 m; discrete Frechet
    distance, not relaxed) that it meets. The number falls if the predicted lane loses confidence and if it moves away;
    0: no predicted lane is within 3 m.

    Args:
        prediction: of one frame, last layer.
        lanes: metres, ego frame, in driving direction.

    Returns:
        Scores, and queries: where the score is 0, the nearest one.
    """
    found, scores = np.asarray(prediction.points, np.float64), np.asarray(prediction.scores)
    lane, query = (index.ravel() for index in np.indices((len(lanes), len(found))))
    distance = pair_frechet(np.asarray(lanes, np.float64), found, lane, query).reshape(len(lanes), len(found))
    met = (distance[..., None] <= np.array(LANE_THRESHOLDS)).mean(-1)
    value = met * scores
    return value.max(1), np.where(value.max(1) > 0.0, value.argmax(1), distance.argmin(1))


def each_alone(road_users: Int[np.ndarray, " n"], tracks: int) -> Bool[np.ndarray, "n k"]:
    """Return the sets of absent tracks (of `tracks`) in which one road user is missing at a time."""
    return road_users[:, None] == np.arange(tracks)


def one_after_another(road_users: Int[np.ndarray, " n"], tracks: int) -> Bool[np.ndarray, "n+1 k"]:
    """Return the sets of absent tracks (of `tracks`) in which the first 0, 1, ..., n road users are missing."""
    alone = each_alone(road_users, tracks)
    return np.concatenate([np.zeros((1, tracks), bool), np.logical_or.accumulate(alone, 0)])


def scores_without(
    task: HostPredictor,
    params: Params,
    example: Example,
    lanes: Float[np.ndarray, "g n 3"],
    absent: Bool[np.ndarray, "n k"],
    *,
    batch_size: int = 16,
) -> Float[np.ndarray, "n g"]:
    """Return the score of each lane (see `lane_scores`) when some of the tracks are taken away.

    Args:
        task, params: a model of centerlines or lane segments without memory.
        example: one frame.
        lanes: metres, ego frame.
        absent: n sets of the K tracks of the example's traffic flow.
        batch_size: copies of the example predicted at a time.
    """
    frames = predict_without(task, params, example, absent, batch_size=batch_size)
    return np.array([lane_scores(frame, lanes)[0] for frame in frames]).reshape(len(absent), len(lanes))


def fading_scores(
    task: HostPredictor,
    params: Params,
    examples: Example,
    lane: LaneGain,
    road_users: Int[np.ndarray, " n"],
    *,
    length: int = 8,
    batch_size: int = 16,
) -> Float[np.ndarray, " length+1"]:
    """Return the score of a lane while road users are taken away one after another: after 0, 1, ..., `length` of them.

    Args:
        task, params: a model of centerlines or lane segments without memory.
        examples: stacked.
        lane: of one of the examples.
        road_users: tracks in the order in which they go. If they are fewer than `length`, the last score is repeated.
        length: number of road users taken away at most.
        batch_size: predicted at a time.
    """
    example: Example = row_of(examples, lane.example)
    absent = one_after_another(road_users[:length], len(_flow(example).valid))
    points = valid_lanes(task, example)[[lane.lane]]
    scores = scores_without(task, params, example, points, absent, batch_size=batch_size)[:, 0]
    return np.pad(scores, (0, length + 1 - len(scores)), mode="edge")


def predict_without(
    task: HostPredictor, params: Params, example: Example, absent: Bool[np.ndarray, "n k"], *, batch_size: int = 16
) -> list[CenterlinePrediction]:
    """Return the predictions for one example when each of n sets of tracks is taken away; see `scores_without`."""
    return list(_frames(task, params, without_tracks(example, absent), batch_size))


def without_tracks(example: Example, absent: Bool[np.ndarray, "n k"]) -> Example:
    """Return n copies of an example, stacked, without the `absent` tracks of its traffic flow.

    Raises UserError if the example has no traffic flow.
    """
    copies = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], len(absent), 0), example)
    flow = _flow(copies)
    return replace(copies, traffic_flow=replace(flow, valid=flow.valid & ~absent[..., None]))


def driven_by_each(
    lanes: Float[np.ndarray, "g n 3"], flow: TrafficFlow, road_users: Int[np.ndarray, " t"]
) -> Float[np.ndarray, "t g"]:
    """Return the fraction of each lane's length that each road user alone drove along, see `driven_fraction`."""
    tracks = [jax.tree.map(lambda leaf, user=user: leaf[user : user + 1], flow) for user in road_users]
    return np.array([driven_fraction(lanes, track)[0] for track in tracks]).reshape(len(road_users), len(lanes))


def valid_lanes(task: HostPredictor, example: Example) -> Float[np.ndarray, "g n 3"]:
    """Return the points of the valid true lanes of one example, metres: lane segments if the model predicts them."""
    lanes = _truth(task, example)
    return np.asarray(lanes.points)[np.asarray(lanes.valid)]


def _truth(task: HostPredictor, example: Example) -> LaneGraph:
    return example.segments if _of_segments(task) else example.lanes


def _of_segments(task: HostPredictor) -> bool:
    return "segments" in task.model.predicts


def _flow(example: Example) -> TrafficFlow:
    if example.traffic_flow is None:
        raise UserError("these examples have no traffic flow, so no road user can be taken away")
    return example.traffic_flow


def _frames(task: HostPredictor, params: Params, examples: Any, batch_size: int) -> Iterator[CenterlinePrediction]:
    """Yield the predicted lanes of each example, those of lane segments by their centerlines and first class."""
    for indices, answer in predictions(task, params, examples, batch_size):
        for i in range(len(indices)):
            lanes: Any = row_of(answer, i)
            if _of_segments(task):
                yield CenterlinePrediction(lanes.segments.points, lanes.segments.logits[:, :1])
            else:
                yield lanes.centerlines

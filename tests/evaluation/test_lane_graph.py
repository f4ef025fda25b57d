"""Every part of a prediction is measured by the protocols that apply to it."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.fakes import fake_elements, fake_example
from tflane_jax.evaluation.lane_graph import LaneGraphMetrics, evaluate_lanes
from tflane_jax.evaluation.lane_groups import LANE_GROUPS, lane_groups
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.geometry import BevGrid
from tflane_jax.scene import (
    AreaType,
    CenterlinePrediction,
    ElementPrediction,
    LineClass,
    LinePrediction,
    MapLines,
    Prediction,
    SegmentPrediction,
    stack_examples,
)

BOTH = EvaluationConfig(batch_size=2, versions=("v2.1", "v1.0"))


def sure(flags):
    """Return logits whose probabilities are close to 0 or 1."""
    return np.where(flags, 9.0, -9.0).astype(np.float32)


def labelled(seed=0):
    """Return an example with map lines of every class, one of them padding."""
    example = fake_example(seed)
    rng = np.random.default_rng(seed)
    lines = MapLines.empty(6, 5)
    lines.points[:5] = np.cumsum(rng.uniform(0.5, 2.0, (5, 5, 3)), 1).astype(np.float32)
    lines.points[5] = np.nan
    lines.category[:5] = [0, 1, 2, LineClass.CENTERLINE, 2]
    lines.valid[:5] = True
    lanes, across = example.lanes, np.array([0.0, 1.5, 0.0], np.float32)
    types = {name: np.array([1, 2, 0, 0, 0], np.int32) for name in ("left_type", "right_type")}
    segments = lanes.replace(left=lanes.points + across, right=lanes.points - across, **types)
    elements = example.traffic_elements
    attribute = np.full_like(elements.attribute, elements.attribute[0])
    box = np.broadcast_to(np.array([[10.0, 10.0], [30.0, 40.0]], np.float32), elements.box.shape)
    return example.replace(
        map_lines=lines, segments=segments, traffic_elements=elements.replace(attribute=attribute, box=box)
    )


@dataclass(frozen=True)
class Oracle:
    """Predicts the true values of the chosen parts, moved by `shift` metres."""

    parts: tuple[str, ...]
    shift: float = 0.0
    streams: bool = False

    def predict(self, params, example):
        example = jax.tree.map(jnp.asarray, example)
        found = {}
        lanes, segments, lines = example.lanes, example.segments, example.map_lines
        if "centerlines" in self.parts:
            points = lanes.points + self.shift
            edges = jnp.where(lanes.successor, 9.0, -9.0)
            found["centerlines"] = CenterlinePrediction(points, jnp.where(lanes.valid[:, None], 9.0, -9.0), edges)
        if "segments" in self.parts:
            kind = jnp.stack([segments.valid, jnp.zeros_like(segments.valid)], -1)
            edges = jnp.where(segments.successor, 9.0, -9.0)
            points, left, right = (x + self.shift for x in (segments.points, segments.left, segments.right))
            logits = jnp.where(kind, 9.0, -9.0)
            types = (jax.nn.one_hot(kind, 3) for kind in (segments.left_type, segments.right_type))
            found["segments"] = SegmentPrediction(points, left, right, logits, *types, successor_logits=edges)
        if "lines" in self.parts:
            kind = jax.nn.one_hot(lines.category, 4) * lines.valid[:, None]
            points = jnp.nan_to_num(lines.points) + self.shift
            found["lines"] = LinePrediction(points, jnp.where(kind > 0, 9.0, -9.0))
        if "elements" in self.parts:
            elements = example.traffic_elements
            kind = jax.nn.one_hot(elements.attribute, 13)  # padding repeats the first attribute, with a low score
            logits = jnp.where(kind > 0, jnp.where(elements.valid[:, None], 9.0, -5.0), -9.0)
            found["elements"] = ElementPrediction(elements.box, logits, jnp.where(elements.lane, 9.0, -9.0))
        return Prediction(**found)


def measured(parts, shift=0.0, config=BOTH):
    return evaluate_lanes(Oracle(parts, shift), {}, stack_examples([labelled(i) for i in range(3)]), config)


def test_an_oracle_gets_the_full_score_in_every_protocol():
    metrics = measured(("centerlines", "segments", "lines", "elements"))
    found = metrics.compute()
    assert {"all", "occluded", "clear", "segments all", "segments occluded", "lines"} <= set(found)
    assert found["all"]["DET_l"] == found["all"]["TOP_ll"] == found["all"]["DET_t"] == found["all"]["OLS"] == 1.0
    assert found["all"]["OLS_v1.0"] > 0
    segments = found["segments all"]
    assert segments["AP_ls"] == segments["TOP_lsls"] == segments["DET_t"] == segments["TOP_lste"] == 1.0
    assert (segments["AE_dist"], segments["AE_type"]) == (0.0, 0.0)
    assert found["lines"]["mAP"] == 1.0
    for name in ("OpenLane-V2 centerline", "LaneSegNet lane segments", "OpenLane-V2 lane segments", "MapTR"):
        assert name in metrics.protocol


@pytest.mark.parametrize("part", ["centerlines", "segments", "lines"])
def test_only_predicted_parts_are_measured_and_errors_lower_the_score(part):
    near, far = measured((part,)).compute(), measured((part,), shift=30.0).compute()
    names = {"centerlines": ("all", "DET_l"), "segments": ("all", "AP_ls"), "lines": ("lines", "mAP")}
    group, name = names[part]
    assert near[group][name] == 1.0
    assert far[group][name] < 0.2
    assert ("lines" in near) == (part == "lines")
    assert ("all" in near) == (part != "lines")
    assert ("AP_ped" in near.get("all", {})) == ("DET_a" in near.get("all", {})) == (part == "segments")


def test_a_second_version_adds_columns_and_changes_none():
    one = measured(("centerlines", "elements"), 0.7, EvaluationConfig(batch_size=2)).compute()["all"]
    two = measured(("centerlines", "elements"), 0.7).compute()["all"]
    assert set(two) - set(one) == {"OLS_v1.0", "TOP_ll_v1.0", "TOP_lt_v1.0"}
    assert {name: two[name] for name in one} == one


def test_map_lines_without_labels_are_derived_from_segments_and_areas():
    example = labelled().replace(map_lines=None)
    crossings = np.asarray(example.areas.category) == AreaType.PEDESTRIAN_CROSSING
    points = np.asarray(example.areas.points)[crossings & example.areas.valid]
    logits = sure(np.eye(4)[np.full(len(points), LineClass.CROSSING)])
    metrics = LaneGraphMetrics()
    metrics.update(Prediction(lines=LinePrediction(points, logits)), example)
    assert metrics.compute()["lines"]["AP_ped_crossing"] == (1.0 if len(points) else 0.0)


def test_predictions_without_topology_are_measured():
    example = fake_example(1)
    lanes = example.lanes
    found = []
    for successor in (None, sure(lanes.successor)):
        metrics = LaneGraphMetrics()
        prediction = CenterlinePrediction(lanes.points, sure(lanes.valid[:, None]), successor)
        metrics.update(Prediction(centerlines=prediction), example)
        found.append(metrics.compute()["all"])
    without, with_topology = found
    assert without["DET_l"] == with_topology["DET_l"] == with_topology["TOP_ll"] == 1.0
    assert without["TOP_ll"] < 1.0


def test_nothing_to_measure_is_an_error():
    with pytest.raises(ValueError, match="nothing to measure"):
        LaneGraphMetrics().update(Prediction(elements=fake_elements()), fake_example())


@dataclass(frozen=True)
class Unlinked:
    """Predicts the true lanes and no edge."""

    streams: bool = False

    def predict(self, params, example):
        lanes = jax.tree.map(jnp.asarray, example.lanes)
        edges = jnp.full(lanes.successor.shape, -9.0)
        return Prediction(centerlines=CenterlinePrediction(lanes.points, jnp.zeros((5, 1)), edges))


def test_the_geometric_topology_finds_the_edges_of_lanes_that_meet():
    example = fake_example()
    lanes = example.lanes
    lanes.points[1] += lanes.points[0, -1] - lanes.points[1, 0]
    found = {}
    for topology in ("learned", "geometric"):
        config = EvaluationConfig(batch_size=1, topology=topology)
        found[topology] = evaluate_lanes(Unlinked(), {}, stack_examples([example]), config).compute()["all"]
    assert found["learned"]["TOP_ll"] < found["geometric"]["TOP_ll"] == 1.0
    changed = {name for name, score in found["learned"].items() if found["geometric"][name] != score}
    assert changed == {"TOP_ll"}  # no OLS without traffic elements


@dataclass(frozen=True)
class Follower:
    """Predicts the true lanes, raised by the height of the first road user; without road users far too high."""

    streams: bool = False

    def predict(self, params, example):
        example = jax.tree.map(jnp.asarray, example)
        flow = example.traffic_flow
        raised = example.lanes.points.at[..., 2].add(jnp.where(flow.valid[0, 2], flow.position[0, 2, 2], 500.0))
        return Prediction(centerlines=CenterlinePrediction(raised, jnp.zeros((5, 1))))


def with_groups(count=5):
    """Return examples whose first lane is driven along, stacked; 0 and 1 are a scene, 2 and 3 the next."""
    examples = [labelled(i) for i in range(count)]
    for example in examples:
        lane, flow = example.lanes.points[0], example.traffic_flow
        forward = np.gradient(lane, axis=0)
        flow.position[0] = 300.0, 300.0, 0.0
        flow.position[1, 2:], flow.yaw[1, 2:], flow.category[1] = lane, np.arctan2(forward[:, 1], forward[:, 0]), 0
    return stack_examples(examples)


def test_lanes_are_grouped_by_evidence_and_traffic():
    arrays, ground = with_groups(), BevGrid().range
    found = evaluate_lanes(Oracle(("centerlines",)), {}, arrays, BOTH, ground=ground).compute()
    expected = dict.fromkeys(LANE_GROUPS, 0)
    for i in range(5):
        row = jax.tree.map(lambda leaf, i=i: leaf[i], arrays)
        for name, members in lane_groups(row.lanes, row.bev, row.traffic_flow, ground).items():
            expected[name] += int(members.sum())
    assert {name: found[name]["lanes"] for name in LANE_GROUPS} == expected
    assert expected["visible+traffic"] > 0
    assert all(found[name]["recall"] == 1.0 for name in LANE_GROUPS if expected[name])
    assert list(measured(("centerlines",)).compute()) == ["all", "occluded", "clear"]
    for lacking in ("bev", "traffic_flow"):
        without = evaluate_lanes(Oracle(("centerlines",)), {}, arrays.replace(**{lacking: None}), BOTH, ground=ground)
        assert list(without.compute()) == ["all", "occluded", "clear"]


def test_segments_have_the_groups_of_centerlines():
    arrays, ground = with_groups(), BevGrid().range
    lanes, segments = (
        evaluate_lanes(Oracle((part,)), {}, arrays, BOTH, ground=ground) for part in ("centerlines", "segments")
    )
    expected, found = lanes.compute(), segments.compute()
    assert list(found) == list(expected) == ["all", "occluded", "clear", *LANE_GROUPS]
    for group in found:  # the segments of these examples are the centerlines
        assert found[group]["lanes"] == expected[group]["lanes"]
        assert found[group]["recall"] == expected[group]["recall"]
        assert ("mAP" in found[group]) == (group == "all")
    ratios = {name: ratio for name, ratio in lanes.ratios().items() if not name.endswith("_v1.0")}
    assert {name.replace("TOP_lsls", "TOP_ll"): ratio for name, ratio in segments.ratios().items()} == ratios


def test_types_count_only_where_they_are_predicted():
    example = labelled()
    segments = example.segments
    logits = np.stack([np.where(segments.valid, 9.0, -9.0), np.full(5, -9.0)], -1)
    wrong = np.eye(3)[(segments.left_type + 1) % 3]
    for types, expected in ((None, None), (wrong, 1.0)):
        metrics = LaneGraphMetrics()
        lines = segments.points, segments.left, segments.right
        metrics.update(Prediction(segments=SegmentPrediction(*lines, logits, types, types)), example)
        assert metrics.compute()["all"].get("AE_type") == expected


@pytest.mark.parametrize("count", [0, 1])
def test_no_segments_and_one_and_padding_of_nan(count):
    example = labelled()
    segments = example.segments.replace(valid=np.arange(5) < count)
    for line in (segments.points, segments.left, segments.right, segments.visibility):
        line[count:] = np.nan
    queries = segments.points[:count], segments.left[:count], segments.right[:count], np.tile([[9.0, -9.0]], (count, 1))
    metrics = LaneGraphMetrics()
    metrics.update(Prediction(segments=SegmentPrediction(*queries)), example.replace(segments=segments))
    found = metrics.compute()["all"]
    assert (found["AP_ls"], found["lanes"]) == (1.0, count)
    assert np.isfinite(list(found.values())).all()
    assert ("AE_dist" in found) == bool(count)


def test_an_intervention_changes_what_the_model_sees_and_neither_truth_nor_groups():
    arrays, ground = with_groups(), BevGrid().range

    def recall(traffic):
        config = EvaluationConfig(batch_size=2, traffic=traffic)
        return evaluate_lanes(Follower(), {}, arrays, config, ground=ground).compute()

    own, none, other = (recall(traffic) for traffic in ("own", "none", "other-scene"))
    assert own["all"]["recall"] == other["all"]["recall"] == 1.0
    assert none["all"]["recall"] == 0.0
    arrays.traffic_flow.position[:2, 0, :, 2] = 500.0  # the first scene's: its receiver fails instead
    own, other = recall("own"), recall("other-scene")
    assert own["all"]["recall@3.0"] == pytest.approx(3 / 5)
    assert other["all"]["recall@3.0"] in (pytest.approx(3 / 5), pytest.approx(4 / 5))
    assert {name: own[name]["lanes"] for name in own} == {name: other[name]["lanes"] for name in other}


def test_recall_and_topology_are_ratios_of_sums_by_scene():
    metrics = evaluate_lanes(Oracle(("centerlines",), 0.9), {}, with_groups(), BOTH, ground=BevGrid().range)
    scores, ratios = metrics.compute(), metrics.ratios()
    names = ("recall", "TOP_ll", "TOP_ll_v1.0")
    assert set(ratios) == {f"{group}/{name}" for group in scores for name in names if name in scores[group]}
    for path, ratio in ratios.items():
        group, _, name = path.partition("/")
        assert len(ratio.numerator) == len(ratio.denominator) == 3
        assert sum(ratio.denominator) == (3 if name == "recall" else 2) * scores[group]["lanes"]
        assert sum(ratio.numerator) / max(sum(ratio.denominator), 1) == pytest.approx(scores[group][name], abs=1e-4)
    assert ratios["all/recall"].denominator == (12, 12, 6)  # two lanes a frame, at three thresholds
    assert 0 < scores["all"]["recall"] < 1


def test_recall_of_lines_is_the_ratio_of_counts_by_scene():
    metrics = measured(("lines",), 0.4)
    scores, ratios = metrics.compute(), metrics.ratios()
    assert (
        set(ratios)
        == {f"{group}/recall" for group in scores}
        == {f"lines{x}/recall" for x in ("", " occluded", " clear")}
    )
    assert ratios["lines/recall"].denominator == (30, 15)  # five lines a frame, at three thresholds
    assert scores["lines"]["recall"] == pytest.approx(sum(ratios["lines/recall"].numerator) / 45)


def test_groups_of_frames_are_measured_on_their_own():
    arrays = stack_examples([labelled(i) for i in range(3)])
    oracle = Oracle(("centerlines", "segments", "lines"))
    metrics = evaluate_lanes(oracle, {}, arrays, BOTH, frame_groups=("near", "far", "near"))
    found = metrics.compute()
    assert [found[group]["frames"] for group in ("all", "near", "far")] == [3, 2, 1]
    assert [found[f"segments {group}"]["frames"] for group in ("all", "near", "far")] == [3, 2, 1]
    assert found["near"]["lanes"] + found["far"]["lanes"] == found["all"]["lanes"]
    assert [found[f"lines{group}"]["frames"] for group in ("", " near", " far")] == [3, 2, 1]
    assert [found[f"lines{group}"]["lines"] for group in ("", " near", " far")] == [15, 10, 5]
    assert found["lines far"]["mAP"] == 1.0
    assert {"lines near/recall", "lines far/recall"} <= set(metrics.ratios())

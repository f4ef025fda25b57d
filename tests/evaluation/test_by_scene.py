"""Scores by scene: ratios, and the samples that all runs share."""

import numpy as np
import pytest

from tests.fakes import fake_example
from tflane_jax.evaluation import by_scene
from tflane_jax.evaluation.by_scene import SAMPLES, scene_numbers, scene_weights, shared_samples, summed_ratio
from tflane_jax.evaluation.lane_graph import LaneGraphMetrics
from tflane_jax.evaluation.results import SceneRatio
from tflane_jax.scene import CenterlinePrediction, LinePrediction, Prediction, SegmentPrediction

SCENE = (0, 0, 1, 2, 2)


def test_the_shared_draws_are_those_of_recorded_scores():
    """Another draw with the same seed, by another numpy, would make records of different times incomparable."""
    expected = [[1, 0, 0, 0, 4], [2, 2, 0, 1, 0], [1, 2, 1, 0, 1]]
    assert scene_weights(5, 3).tolist() == expected
    assert scene_weights(5, SAMPLES)[:3].tolist() == expected


def test_frames_are_numbered_by_scene():
    assert scene_numbers([False, True, False, True, True]).tolist() == [0, 0, 1, 1, 1]
    assert scene_numbers([True, False]).tolist() == [0, 1]  # the first frame begins a scene, whatever it says
    assert scene_numbers([]).tolist() == []


def test_sums_over_scenes_are_rounded():
    parts = np.array([[1 / 3, 2.0], [1 / 3, 1.0], [0.5, 4.0]])
    assert summed_ratio(parts, np.array([0, 0, 1])) == SceneRatio((0.6667, 0.5), (3, 4))


def test_scores_that_are_ratios_need_no_samples():
    def bootstrap(weights):
        assert weights.shape == (SAMPLES, 3)
        return {"all": {"DET_l": weights[:, 2] / 7, "TOP_ll": weights[:, 0]}}

    ratio = SceneRatio((1, 2), (3, 6))
    found = shared_samples(bootstrap, np.array([0, 0, 1]), {"all/recall": ratio, "all/TOP_ll": ratio})
    assert list(found) == ["all/DET_l"]
    assert found["all/DET_l"].lanes == (3, 6)
    assert set(found["all/DET_l"].values) == {0.0, 0.14286, 0.28571}
    assert shared_samples(bootstrap, np.zeros(2, int), {"all/recall": ratio}) == {}  # one scene tells of no other


def frames():
    """Return predictions of all parts, near the truth of their examples, with scores of their own."""
    for number, scene in enumerate(SCENE):
        example, rng = fake_example(number), np.random.default_rng([11, number])
        lanes = example.lanes
        across = np.array([0.0, 1.5, 0.0])
        types = {name: np.ones(5, np.int32) for name in ("left_type", "right_type")}
        example = example.replace(
            segments=lanes.replace(left=lanes.points + across, right=lanes.points - across, **types),
            has_previous=np.asarray(number > 0 and SCENE[number - 1] == scene),
        )
        points = np.nan_to_num(lanes.points) + rng.normal(0, 0.8, (5, 1, 3))
        lines = np.nan_to_num(example.segments.left) + rng.normal(0, 0.5, (5, 1, 3))
        edges, logits = rng.normal(0, 3, (5, 5)), rng.normal(0, 1, (5, 1))
        sides = points + across, points - across
        yield (
            Prediction(
                centerlines=CenterlinePrediction(points, logits, edges),
                segments=SegmentPrediction(points, *sides, np.c_[logits, logits - 1], successor_logits=edges),
                lines=LinePrediction(lines, np.c_[logits, logits - 1, logits - 2]),
            ),
            example,
        )


def run(order):
    metrics, found = LaneGraphMetrics(("v2.1", "v1.0"), ("even",), lane_groups=("odd",)), list(frames())
    for number in order:
        prediction, example = found[number]
        odd = {"odd": np.arange(np.sum(example.lanes.valid)) % 2 == 1}
        groups = {"centerlines": odd, "segments": odd}
        metrics.update(prediction, example, "even" if SCENE[number] % 2 == 0 else None, groups)
    return metrics


def test_samples_and_ratios_are_the_scores_of_repeated_scenes(monkeypatch):
    weights = np.array([[1, 1, 1], [0, 2, 1], [2, 0, 1]])
    monkeypatch.setattr(by_scene, "scene_weights", lambda scenes, samples: weights)
    whole = run(range(len(SCENE)))
    samples, ratios, scores = whole.samples(), whole.ratios(), whole.compute()
    assert not samples.keys() & ratios.keys()
    assert {"all/DET_l", "occluded/AP_l", "even/DET_l", "odd/DET_l", "segments all/mAP", "lines/mAP"} <= set(samples)
    assert {"all/TOP_ll", "clear/TOP_ll_v1.0", "segments even/TOP_lsls", "lines/recall"} <= set(ratios)
    assert {name.split("/")[0] for name in samples} == set(scores)
    for b, times in enumerate(weights):
        order = [
            number
            for scene, count in enumerate(times)
            for number in np.flatnonzero(np.equal(SCENE, scene)).tolist() * count
        ]
        expected = {
            f"{group}/{name}": value for group, each in run(order).compute().items() for name, value in each.items()
        }
        for name, sample in samples.items():
            assert sample.values[b] == pytest.approx(expected[name], abs=1e-5), name
        for name, ratio in ratios.items():
            total = times @ ratio.denominator
            assert times @ ratio.numerator / max(total, 1) == pytest.approx(expected.get(name, 0.0), abs=1e-4), name
    assert samples["all/DET_l"].lanes == ratios["all/recall"].denominator

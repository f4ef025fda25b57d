"""Pictures of a comparison: which frames and lanes they show, and what they say about them."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from tests.fakes import FakeConfig, FakeDataset
from tests.models.cases import WITH_TRAFFIC
from tflane_jax.datasets.loading import stream
from tflane_jax.datasets.procedural import ProceduralConfig
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.scene import CenterlinePrediction, Prediction
from tflane_jax.tasks import Model
from tflane_jax.tasks.lane_graph import LaneGraphTask

SIZE = 12


@dataclass(frozen=True)
class Knowing(LaneGraphTask):
    """Predicts the true lanes where the first one starts on the right side of x = `limit`, else lanes far away."""

    def predict(self, params, example):
        knows = params["sign"] * (example.lanes.points[0, 0, 0] - params["limit"]) > 0.0
        points = jnp.where(example.lanes.valid[:, None, None], example.lanes.points, 0.0)
        logits = jnp.where(example.lanes.valid[:, None], params["logit"], -9.0)
        return Prediction(centerlines=CenterlinePrediction(points + jnp.where(knows, 0.0, 500.0), logits))


class WithAreas(Knowing):
    """The same, of a part that others do not read."""

    @property
    def parts(self):
        return (*super().parts, "areas")

    def predict(self, params, example):
        assert len(example.areas.valid), "the data were loaded for another model"
        return super().predict(params, example)


def model(sign, limit, logit=1.0, task=None):
    values = {"sign": float(sign), "limit": float(limit), "logit": float(logit)}
    return Model(task or Knowing(), {name: jnp.asarray(value) for name, value in values.items()})


@pytest.fixture
def drawn(monkeypatch):
    """Return a function that draws a comparison of fake examples, and gives the arguments of the picture."""
    calls = []
    monkeypatch.setattr(
        "tflane_jax.datasets.sources.open_dataset", lambda *_, **__: FakeDataset(FakeConfig(size=SIZE, seed=3))
    )
    monkeypatch.setattr("tflane_jax.plots.save_differences", lambda *args, **names: calls.append((args, names)))

    def draw(models, streamed=False):
        source, (first, *_) = ProceduralConfig(), models.values()
        data = first.task.load(source)
        if streamed:
            data = stream(FakeDataset(FakeConfig(SIZE, 3)), StreamingConfig(threads=0), first.task.parts)
        first.task.draw_comparison(models, source, data, "a.png")
        ((_, examples, findings, outlined), words) = calls.pop()
        return examples, findings, outlined, words

    return draw


def starts():
    """Return the x at which the first lane of each frame starts; that lane alone is occluded."""
    return np.array([FakeDataset(FakeConfig(SIZE, 3)).example(i).lanes.points[0, 0, 0] for i in range(SIZE)])


@pytest.mark.parametrize("streamed", [False, True])
def test_the_frames_in_which_only_one_of_two_models_finds_an_occluded_lane(drawn, streamed):
    x = starts()
    # The first finds x > 5, the second x < 9.
    models = {"one": model(1, 5), "two": model(-1, 9, logit=2.0), "third": model(1, 5)}
    examples, findings, outlined, words = drawn(models, streamed)
    only_one, only_two = (x >= 9.0), (x <= 5.0)
    assert only_one.any()
    assert only_two.any()
    assert words["title"] == (
        f"Of {SIZE} lanes of which less than half is in line of sight, both models find "
        f"{SIZE - only_one.sum() - only_two.sum()}, only two {only_two.sum()}, only one {only_one.sum()}"
    )
    shown = examples.lanes.points[:, 0, 0, 0]
    assert set(shown) <= set(x[only_one | only_two])
    assert len(shown) == len(words["titles"]) == 4
    # Frames of the second first; the occluded lane is outlined, the clear one and padding are not.
    leads = (shown <= 5.0).tolist()
    assert leads == sorted(leads, reverse=True)
    assert len(set(leads)) == 2
    np.testing.assert_array_equal(outlined, [[True, *[False] * 4]] * 4)
    for name, finds in (("one", shown > 5.0), ("two", shown < 9.0), ("third", shown > 5.0)):
        np.testing.assert_array_equal(findings[name].found[:, :2], np.stack([finds, finds], 1))
        assert not findings[name].found[:, 2:].any()
        assert len(findings[name].lanes.points) == 4
    assert findings["two"].threshold == pytest.approx(1 / (1 + np.exp(-2.0)))
    assert "0.73 (one), 0.88 (two)" in words["caption"]


def test_equal_models_are_drawn_on_the_frames_with_the_most_lanes(drawn):
    examples, _, outlined, words = drawn({"one": model(1, 0), "two": model(1, 0)})
    assert len(examples.has_previous) == 4
    assert not outlined.any()
    assert "no model is ahead" in words["caption"]


def test_every_model_predicts_from_the_parts_that_it_reads(drawn):
    assert drawn({"one": model(1, 5), "two": model(-1, 9, task=WithAreas())})[1]["two"].found.any()


def test_with_traffic_flow_the_lanes_are_those_that_vehicles_drove_along(drawn):
    words = drawn({"one": model(1, 5), "two": model(-1, 9, task=Knowing(WITH_TRAFFIC))})[3]
    # The fake vehicles jump about, so they drive along no lane.
    assert words["title"].startswith("Of 0 lanes that the sensor hardly shows and vehicles drove along")


def test_a_single_model_is_drawn_on_the_frames_with_the_most_occluded_lanes(monkeypatch):
    shown = []
    monkeypatch.setattr("tflane_jax.datasets.sources.open_dataset", lambda *_, **__: FakeDataset(FakeConfig(3)))
    monkeypatch.setattr("tflane_jax.plots.save_examples", lambda path, *args, **names: shown.append((args, names)))
    alone, source = model(1, 0), ProceduralConfig()
    data = alone.task.load(source)
    data.lanes.visibility[:, 1] = [1.0, 0.0, 1.0]
    alone.task.draw_comparison({"alone": alone}, source, data, "a.png")
    (((examples, lanes), names),) = shown
    assert list(lanes) == ["alone"]
    assert [title.rsplit(" at ")[0] for title in names["titles"]] == ["scene 0", "scene 0", "scene 1"]
    expected = [FakeDataset(FakeConfig(3)).example(i).lanes.points for i in (1, 0, 2)]
    np.testing.assert_array_equal(examples.lanes.points, expected)

"""Pictures of a comparison: which frames and lanes they show, and what they say about them."""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from tests.fakes import FakeConfig, FakeDataset, fake_views
from tests.models.cases import WITH_TRAFFIC
from tflane_jax.datasets.base import FrameInfo
from tflane_jax.datasets.loading import stream
from tflane_jax.datasets.procedural import ProceduralConfig, WorldData
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.metrics.directions import lower_is_better
from tflane_jax.models.host import HostConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import CenterlinePrediction, Prediction, SegmentPrediction
from tflane_jax.startup import showing
from tflane_jax.tasks import Model
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_pictures import titles

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


@dataclass(frozen=True, kw_only=True)
class SegmentHost(TopoNetConfig):
    """Stands for a host of segments; `KnowingSegments` predicts in its place."""

    truth: ClassVar[tuple[str, ...]] = ("segments", "areas")
    predicts: ClassVar[tuple[str, ...]] = ("segments",)


@dataclass(frozen=True)
class KnowingSegments(Knowing):
    """As `Knowing`, of segments."""

    model: HostConfig = SegmentHost()

    def predict(self, params, example):
        found = super().predict(params, example).centerlines
        assert found is not None
        side = jnp.array([[[0.0, 1.8, 0.0]]])
        logits = jnp.concatenate([found.logits, jnp.full_like(found.logits, -9.0)], -1)
        return Prediction(segments=SegmentPrediction(found.points, found.points + side, found.points - side, logits))


class SegmentData(FakeDataset):
    """Its segments are its lanes, with boundaries."""

    def example(self, index):
        example, side = super().example(index), np.array([0.0, 1.8, 0.0], np.float32)
        lanes = example.lanes
        segments = lanes.replace(left=lanes.points + side, right=lanes.points - side)
        return example.replace(segments=segments, cameras=fake_views(index))


@pytest.fixture
def of_segments(monkeypatch):
    monkeypatch.setattr(
        "tflane_jax.datasets.sources.open_dataset", lambda *_, **__: SegmentData(FakeConfig(size=SIZE, seed=3))
    )
    return ProceduralConfig()


def test_differences_of_segments_are_those_of_centerlines(drawn, of_segments, monkeypatch):
    models = {name: model(*args, task=KnowingSegments()) for name, args in (("one", (1, 5)), ("two", (-1, 9)))}
    lanes = drawn({name: model(*args) for name, args in (("one", (1, 5)), ("two", (-1, 9)))})
    segments = drawn_with(of_segments, models, monkeypatch)
    assert segments[3]["title"] == lanes[3]["title"]
    np.testing.assert_array_equal(segments[2], lanes[2])
    for name in models:
        np.testing.assert_array_equal(segments[1][name].found, lanes[1][name].found)
        assert isinstance(segments[1][name].lanes, SegmentPrediction)


def drawn_with(source, models, monkeypatch):
    calls = []
    monkeypatch.setattr("tflane_jax.plots.save_differences", lambda *args, **names: calls.append((args, names)))
    task = next(iter(models.values())).task
    task.draw_comparison(models, source, task.load(source), "a.png")
    ((_, examples, findings, outlined), words) = calls.pop()
    return examples, findings, outlined, words


def test_hosts_of_different_lanes_are_not_compared(of_segments, monkeypatch):
    models = {"one": model(1, 5), "two": model(-1, 9, task=KnowingSegments())}
    with pytest.raises(UserError, match="lanes of different kinds"):
        drawn_with(of_segments, models, monkeypatch)


@pytest.mark.slow
def test_training_and_comparing_segments_leave_pictures(of_segments, tmp_path):
    pytest.importorskip("matplotlib")
    task = KnowingSegments()
    knows = model(1, -500, task=task)
    draw = task.drawing(WorldData(), EvaluationConfig(pictures=2))
    draw(tmp_path, 3, knows.params)
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == [
        "step_00000003.png",
        "step_00000003_cameras.png",
    ]
    data = task.load(of_segments)
    assert task.draw_comparison({"alone": knows}, of_segments, data, tmp_path / "a.png").is_file()
    other = model(-1, -500, task=task)
    assert task.draw_comparison({"a": knows, "b": other}, of_segments, data, tmp_path / "b.png").is_file()


def test_the_numbers_of_a_host_of_segments_have_the_announced_names(of_segments):
    task, config = KnowingSegments(), EvaluationConfig()
    found = task.evaluate(model(1, -500, task=task).params, task.load(of_segments), config)
    announced = task.score_names(WorldData(), config)
    assert {name for name in found.scores() if "@" not in name} <= announced
    assert found.scores()["all/AP_ls"] == 1.0
    assert {"all/mAP", "hidden+traffic/recall", "occluded/AP_ls", "all/AE_dist"} <= announced
    assert set(task.compared) & found.scores().keys() >= {"all/mAP", "all/AE_dist", "occluded/TOP_lsls"}
    assert {name for name in task.compared if lower_is_better(name, task.errors)} == {"all/AE_type", "all/AE_dist"}


@pytest.mark.parametrize(
    ("scene", "title"),
    [
        ("scene-0061", "scene-0061 at 2.5 s"),
        ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "7fab2350…1bede at 2.5 s"),
        ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede-00003", "7fab2350…00003 at 2.5 s"),
    ],
)
def test_titles_have_room_for_the_ids_of_logs(scene, title):
    class OneFrame(FakeDataset):
        def info(self, index):
            return FrameInfo("fake", scene, 2_500_000_000, np.eye(4))

    assert titles(OneFrame(FakeConfig()), [0]) == [title]


def test_the_program_that_scores_predicts_for_pictures(drawn, monkeypatch, tmp_path):
    """Regression: a training showed "compiling the prediction" twice; later it compiled two programs in fact."""
    monkeypatch.setattr("tflane_jax.evaluation.predict._compiled", set())
    both, told = {"one": replace(model(1, 5), batch_size=5), "two": replace(model(-1, 9), batch_size=5)}, []
    task, params = both["one"].task, both["one"].params
    config = EvaluationConfig(batch_size=5, pictures=2)
    with showing(told.append):
        task.evaluate(params, task.load(ProceduralConfig()), config)
        task.drawing(WorldData(), config)(tmp_path, 1, params)
        drawn(both)
        drawn({"other": model(1, 5), "two": both["two"]})
    compiling = [name for name in told if name.startswith("compiling")]
    assert compiling == ["compiling the prediction for scores", "compiling the prediction for pictures"]
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 1

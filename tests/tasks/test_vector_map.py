"""A host of map lines end to end on the built-in world: evaluated, named, drawn and compared, without training."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import LIFTED_LINES
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.loading import load_arrays
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.procedural import STREET_EXAMPLE, ProceduralDataset, WorldData
from tflane_jax.errors import UserError
from tflane_jax.evaluation.found_lanes import confidences_of, detection_scores
from tflane_jax.evaluation.lane_groups import LANE_GROUPS
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.losses.common import HostLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.host import Host, HostConfig
from tflane_jax.scene import LineClass, LinePrediction, MapLines, Prediction
from tflane_jax.tasks import Model
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.cameras.ring import CameraRigConfig

EXAMPLE = dataclasses.replace(STREET_EXAMPLE, map_lines=MapLinesConfig(lines=24, centerlines="include"))
DATA = dataclasses.replace(WorldData.street(2, 2, 2), example=EXAMPLE)
CONFIG = EvaluationConfig(batch_size=4)


@dataclass(frozen=True, kw_only=True)
class KnowingConfig(HostConfig):
    """Predicts the true lines, moved to the left by a parameter; those of some classes with low confidence."""

    unsure: tuple[int, ...] = ()

    truth: ClassVar[tuple[str, ...]] = ("map_lines",)
    predicts: ClassVar[tuple[str, ...]] = ("lines",)

    @property
    def query_dim(self) -> int:
        return 8

    @property
    def example_points(self) -> dict[str, tuple[int, str]]:
        return {"map_lines.points": (20, "as many as it predicts")}

    def build(self) -> Knowing:
        return Knowing(self)


class Knowing(Host):
    @nn.compact
    def decode_example(self, example, bev, elements, tokens, *, deterministic):
        lines = example.map_lines
        aside = self.param("aside", nn.initializers.zeros, ())
        points = jnp.where(lines.valid[:, None, None], lines.points[..., :2], 0.0)
        points = points.at[..., 1].add(aside)
        kind = (jax.nn.one_hot(lines.category, 4) > 0) & lines.valid[:, None]
        level = [-3.0 if name in self.config.unsure else 3.0 for name in range(4)]
        logits = jnp.where(kind, jnp.array(level)[None], -9.0)
        return Prediction(lines=LinePrediction(points[None], logits[None]))


def knowing(aside=0.0, **settings):
    encoder = EvidenceEncoderConfig(dim=8, cell=2, dilations=(1,), range=EXAMPLE.ground)
    task = LaneGraphTask(KnowingConfig(encoder=encoder, range=EXAMPLE.range, **settings), HostLossConfig())
    return task, aside


@functools.cache
def dataset():
    return ProceduralDataset(DATA.source("val"))


@functools.cache
def arrays():
    return load_arrays(dataset(), parts=knowing()[0].parts, progress=False)


@functools.cache
def params(task, aside):
    return task.init(jax.random.key(0), dataset().example(0)) | {"aside": jnp.asarray(aside)}


def model(aside=0.0, **settings):
    task, aside = knowing(aside, **settings)
    return Model(task, params(task, aside))


def test_all_scores_are_named_and_an_oracle_has_the_best():
    task, values = model().task, model().params
    assert "map_lines" in task.parts
    found = task.evaluate(values, arrays(), CONFIG)
    scores = found.scores()
    names = task.score_names(DATA, CONFIG)
    assert set(scores) <= names
    assert {"lines occluded/mAP@1.0", "lines clear/AP_centerline"} <= names >= {"lines hidden+traffic/AP_ped_crossing"}
    assert "lines clear/C-mAP" not in names
    assert {"lines/mAP", "lines/AP_centerline", "lines/C-mAP", "lines clear/recall"} <= set(scores)
    assert scores["lines/recall"] == 1.0
    assert scores["lines/C-AP_divider"] == 1.0
    assert {f"lines {group}" for group in LANE_GROUPS} <= set(found.groups)
    assert {"lines/mAP", "lines/C-mAP", "lines hidden+traffic/recall"} <= set(task.compared)
    assert {"C-mAP", "AP_centerline"} <= set(task.columns)
    assert "C-mAP" in found.protocol
    # Every compared score of the groups is a ratio of counts by scene, for bootstraps.
    assert {name for name in task.compared if name.startswith("lines") and name.endswith("recall")} <= set(found.ratios)


def test_lines_aside_are_worse():
    task, values = model(aside=1.2).task, model(aside=1.2).params
    scores = task.evaluate(values, arrays(), CONFIG).scores()
    assert scores["lines/AP_divider@0.5"] == scores["lines/AP_divider@1.0"] == 0.0
    assert scores["lines/AP_divider@1.5"] > 0.5


def test_the_overlap_is_measured_if_asked_for():
    config = dataclasses.replace(CONFIG, map_measures=("chamfer", "iou"))
    task, values = model().task, model().params
    found = task.evaluate(values, arrays(), config)
    assert found.groups["lines IoU"]["AP_divider@0.95"] == 1.0
    assert set(found.scores()) <= task.score_names(DATA, config)


def test_data_without_lines_or_with_other_points_are_refused():
    task = knowing()[0]
    task.check(DATA, arrays())
    for lines, message in ((None, "set data.example.map_lines"), (MapLinesConfig(points=11), "map_lines.points=20")):
        other = dataclasses.replace(DATA, example=dataclasses.replace(EXAMPLE, map_lines=lines))
        with pytest.raises(UserError, match=message):
            task.check(other, arrays())


def test_the_depth_network_is_told_the_scale_of_the_images():
    task = LaneGraphTask(LIFTED_LINES, MapTrV2LossConfig())
    example = ExampleConfig(sensor=None, cameras=CameraRigConfig(scale=0.5), map_lines=MapLinesConfig(points=5))
    task.check_settings(dataclasses.replace(DATA, example=example))
    smaller = dataclasses.replace(example, cameras=CameraRigConfig(scale=0.3))
    with pytest.raises(UserError, match=r"have 0\.3 times .* is told 0\.5 \(task\.model\.encoder\.bev\.image_scale\)"):
        task.check_settings(dataclasses.replace(DATA, example=smaller))


@pytest.mark.slow
def test_pictures_of_training_and_of_a_comparison(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("tflane_jax.datasets.sources.open_dataset", lambda *_, **__: dataset())
    first, second = model(unsure=(int(LineClass.BOUNDARY),)), model()
    first.task.drawing(DATA, dataclasses.replace(CONFIG, pictures=1))(tmp_path, 3, first.params)
    assert (tmp_path / "pictures" / "step_00000003.png").is_file()
    calls = []
    monkeypatch.setattr("tflane_jax.plots.save_differences", lambda *args, **names: calls.append((args, names)))
    path = tmp_path / "a.png"
    second.task.draw_comparison({"far": model(aside=500.0), "near": second}, DATA.source("val"), arrays(), path)
    ((_, examples, findings, outlined), words) = calls.pop()
    lines = examples.map_lines
    occluded = lines.valid & (lines.visibility < 0.5)
    assert outlined.any()
    np.testing.assert_array_equal(outlined, occluded)
    assert (findings["near"].found[occluded]).all()
    assert not (findings["far"].found[occluded]).any()
    assert "lines of which less than half is in line of sight" in words["title"]
    assert "within 1.5 m" in words["caption"]
    single = first.task.draw_comparison({"one": first}, DATA.source("val"), arrays(), tmp_path / "b.png")
    assert single.is_file()


def test_confidences_of_lines_are_those_of_their_class():
    lines = MapLines.empty(4, 3)
    lines.points[:2] = np.linspace((0, 0, 0), (9, 0, 0), 3), np.linspace((0, 5, 0), (9, 5, 0), 3)
    lines.points[2:] = np.nan
    lines.category[:2], lines.valid[:2] = [LineClass.DIVIDER, LineClass.BOUNDARY], True
    points = np.stack([np.linspace((0, 1), (9, 1), 3), np.linspace((0, 5), (9, 5), 3)])
    found = LinePrediction(points, np.array([[1.0, -9.0, -2.0], [0.0, -9.0, -9.0]]))
    # The second detection lies on the boundary, but is a divider.
    assert confidences_of(lines, found).tolist() == [pytest.approx(1 / (1 + np.exp(-1.0))), -np.inf, -np.inf, -np.inf]
    np.testing.assert_allclose(detection_scores(found), 1 / (1 + np.exp([-1.0, 0.0])))

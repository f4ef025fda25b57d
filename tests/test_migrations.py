"""Configurations of older versions: renamed, moved, nested and removed settings."""

import copy
import json
from pathlib import Path

import pytest

from tflane_jax.config import RunConfig
from tflane_jax.config_io import added_settings, first_difference, from_json, to_json
from tflane_jax.errors import UserError
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.losses.maptrv2 import MapTrV2LossConfig
from tflane_jax.migrations import (
    migrate,
    moved_setting,
    nested_settings,
    removed_setting,
    renamed_class,
    renamed_setting,
    unused_setting,
    value_at,
)
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.marker_fusion import MarkerFusionConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.sd_map_encoder import SdMapModuleConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.adaptive import AdaptiveConfig
from tflane_jax.training.restarts import RestartsConfig
from tflane_jax.training.schedule import OptimConfig

OLD = {
    "class": "Top",
    "part": {"class": "Part", "width": 3, "range": [0, 9]},
    "others": [{"class": "Part", "width": 4, "range": [0, 9]}],
    "range": [0, 9],
}


@pytest.mark.parametrize(
    ("migration", "name", "value"),
    [
        (renamed_class("Part", "Piece"), "part", {"class": "Piece", "width": 3, "range": [0, 9]}),
        (renamed_setting("Part", "width", "breadth"), "part", {"class": "Part", "breadth": 3, "range": [0, 9]}),
        (renamed_setting("Part", "width", "breadth"), "others", [{"class": "Part", "breadth": 4, "range": [0, 9]}]),
        (removed_setting("Part", "range", [0, 9]), "part", {"class": "Part", "width": 3}),
        (removed_setting("Part", "range", lambda root: root["range"]), "others", [{"class": "Part", "width": 4}]),
        (unused_setting("Part", "range"), "part", {"class": "Part", "width": 3}),
        (unused_setting("Part", "range"), "others", [{"class": "Part", "width": 4}]),
        (moved_setting("part.width", "width"), "width", 3),
        (moved_setting("range", "part.limits"), "part.limits", [0, 9]),
        (moved_setting("range", "nowhere.limits"), "range", [0, 9]),
        (moved_setting("nothing", "part.nothing"), "part.nothing", None),
        (nested_settings("Part", ["range"], "box", "Box"), "part.box", {"class": "Box", "range": [0, 9]}),
    ],
)
def test_a_change_is_made_once_and_leaves_the_input_alone(migration, name, value):
    before = copy.deepcopy(OLD)
    new, _ = migrate(OLD, [migration])
    assert before == OLD
    assert value_at(new, name) == value
    assert migrate(new, [migration]) == (new, [])


def test_a_moved_setting_is_gone_from_its_old_place():
    assert "width" not in migrate(OLD, [moved_setting("part.width", "width")])[0]["part"]


def test_removed_settings_are_named_with_their_place():
    (_, notices) = migrate(OLD, [removed_setting("Part", "range", lambda root: root["range"])])
    assert notices == [
        f"setting {place}range no longer exists: its value, [0, 9], is what this version always uses"
        for place in ("part.", "others.")
    ]
    with pytest.raises(UserError, match=r"setting part\.width is 3: .* always uses 5\. Widen the host"):
        migrate(OLD, [removed_setting("Part", "width", 5, instead="Widen the host")])


def renamed_back(content, names):
    """Return a configuration (JSON) as a version with other names wrote it."""
    if isinstance(content, list):
        return [renamed_back(item, names) for item in content]
    if not isinstance(content, dict):
        return content
    own = names.get(content.get("class"), {})
    old = {own.get(name, name): renamed_back(value, names) for name, value in content.items()}
    return old | {"class": CLASSES.get(content.get("class"), content.get("class"))}


OLD_NAMES = {
    "OptimConfig": {"optimizer": "matrices"},
    "MarkerFusionConfig": {"radius": "reach"},
    "SdMapModuleConfig": {"radius": "reach"},
    "AdaptiveConfig": {"fraction": "share"},
}
CLASSES = {"LaneShapeTask": "LaneCurveTask", "LaneShapeLossConfig": "LaneCurveLossConfig"}


@pytest.mark.parametrize(
    "config",
    [
        RunConfig(optim=OptimConfig(optimizer="muon", restarts=RestartsConfig(adaptive=AdaptiveConfig(fraction=0.3)))),
        RunConfig(LaneGraphTask(TopoNetConfig(priors=PriorsConfig(markers=MarkerFusionConfig(radius=3.0))))),
        RunConfig(LaneGraphTask(TopoNetConfig(priors=PriorsConfig(sd_map=SdMapModuleConfig(radius=7.0))))),
        RunConfig(LaneShapeTask()),
    ],
)
def test_configurations_with_the_names_of_earlier_versions_can_be_read(config):
    old = renamed_back(to_json(config), OLD_NAMES)
    assert old != to_json(config)
    with pytest.raises(UserError):
        from_json(RunConfig, old)
    assert from_json(RunConfig, migrate(old)[0]) == config
    assert migrate(to_json(config)) == (to_json(config), [])


OLD_CONFIGS = sorted((Path(__file__).parent / "old_configs").glob("*.json"))


@pytest.mark.parametrize("path", OLD_CONFIGS, ids=lambda path: path.stem)
def test_configurations_that_an_earlier_version_wrote_can_be_read(path):
    """Of the version before priors became one part of a host and ranges became the host's."""
    old = json.loads(path.read_text())
    config = from_json(RunConfig, migrate(old)[0])
    host, saved = config.task.model, old["task"]["model"]
    assert type(config.task.losses).__name__ == type(host).__name__.replace("Config", "LossConfig")
    assert host.encoder.bev_range.x == tuple(saved["decoder"]["range"]["x"])
    for name in ("traffic_flow", "markers", "sd_map"):
        assert (getattr(host.priors, name) is None) == (saved.get(name) is None)
    if saved.get("traffic_flow"):
        assert host.range.x == tuple(saved["traffic_flow"]["prior"]["region"]["x"])
    assert getattr(host, "control_points", None) == old["task"]["losses"]["control_points"]
    assert migrate(to_json(config)) == (to_json(config), [])


def test_a_range_that_is_not_the_hosts_is_refused():
    old = json.loads(OLD_CONFIGS[-1].read_text())
    old["task"]["model"]["sd_map"]["prior"]["range"]["x"] = [-1.0, 1.0]
    with pytest.raises(UserError, match=r"sd_map\.prior\.range"):
        migrate(old)


@pytest.mark.parametrize(("scaling", "expected"), [("none", None), ("sqrt", 8)])
def test_a_reference_batch_that_changed_nothing_is_that_of_the_configuration(scaling, expected):
    old = to_json(RunConfig())
    old["optim"] |= {"lr_scaling": scaling, "reference_batch": 8}
    assert migrate(old)[0]["optim"]["reference_batch"] == expected


@pytest.mark.parametrize("weight", [0.6, 0.9])
@pytest.mark.parametrize("host", [TopoNetConfig, BevFormerDetrConfig, LaneSegNetConfig])
def test_the_edge_weight_is_that_of_the_host_with_a_scene_graph(host, weight):
    """Regression: every lane host had it in its decoder, and only TopoNet read it."""
    now = to_json(RunConfig(LaneGraphTask(host())))
    old = copy.deepcopy(now)
    old["task"]["model"].pop("edge_weight", None)
    old["task"]["model"]["decoder"]["edge_weight"] = weight
    read = from_json(RunConfig, migrate(old)[0]).task.model
    if host is TopoNetConfig:
        assert read.edge_weight == weight
    else:
        assert read == host()
        assert f"edge_weight no longer exists: its value, {weight}, never had an effect" in migrate(old)[1][0]
    assert migrate(now) == (now, [])


@pytest.mark.parametrize("losses", [MapTrLossConfig(), MapTrV2LossConfig()])
def test_a_weight_that_no_loss_of_map_lines_read_is_dropped(losses):
    """Regression: MapTR's losses had a weight of BEV cells, which they do not learn."""
    old = to_json(RunConfig(LaneGraphTask(MapTrConfig(), losses)))
    assert "cell_weight" not in old["task"]["losses"]
    old["task"]["losses"]["cell_weight"] = 0.5
    assert from_json(RunConfig, migrate(old)[0]).task.losses == losses


@pytest.mark.parametrize(
    ("threads", "ahead", "expected"),
    [(4, 16, (None, None)), (8, 16, (8, 16)), (4, 32, (4, 32)), (4, None, (4, None))],
)
def test_workers_of_the_former_default_are_those_of_the_machine(threads, ahead, expected):
    old = to_json(RunConfig())
    old["data"]["loading"] |= {"threads": threads, "ahead": ahead}
    loading = migrate(old)[0]["data"]["loading"]
    assert (loading["threads"], loading["ahead"]) == expected


def test_the_mean_of_the_segments_topology_is_the_published_one():
    old = to_json(RunConfig(LaneGraphTask(LaneSegNetConfig(), LaneSegNetLossConfig())))
    assert "successor_mean" not in old["task"]["losses"]
    losses = {mean: old["task"]["losses"] | {"successor_mean": mean} for mean in ("negatives", "pairs")}
    read = migrate(old | {"task": old["task"] | {"losses": losses["negatives"]}})[0]
    assert read == old
    with pytest.raises(UserError, match=r"losses\.successor_mean is pairs"):
        migrate(old | {"task": old["task"] | {"losses": losses["pairs"]}})


def test_new_settings_are_listed_with_their_defaults():
    now = to_json(RunConfig())
    before = copy.deepcopy(now)
    del before["evaluation"], before["optim"]["eps"]
    assert added_settings(before, now) == [
        "setting optim.eps is new: default 1e-08",
        "setting evaluation is new: default EvaluationConfig",
    ]


@pytest.mark.parametrize(
    ("there", "here", "message"),
    [
        ({"a": 1}, {"a": 1}, ""),
        ({"a": {"class": "A", "b": 1}}, {"a": {"class": "A", "b": 2}}, "a.b: 1 there, 2 here"),
        ({"a": {"class": "A", "b": 1}}, {"a": {"class": "B", "b": 1}}, "a: A there, B here"),
        ({"a": {"class": "A"}}, {"a": None}, "a: A there, None here"),
    ],
)
def test_the_first_difference_is_named(there, here, message):
    assert first_difference(there, here) == message

"""Wrong settings: each ends in one message with its name and value, before data are built or anything is written."""

import dataclasses
import functools
import math
from dataclasses import replace
from pathlib import Path

import pytest

from tflane_jax import devices, runs
from tflane_jax.cli import main
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_io import to_json, with_setting
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets import sources
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import SettingError
from tflane_jax.run_checks import agree_on_settings, check_run
from tflane_jax.training.restarts import RestartsConfig
from tflane_jax.training.run_folder import without_workers
from tflane_jax.training.schedule import DropsConfig

NAN, INF = math.nan, math.inf
REVERSED = PerceptionRange((50.0, -50.0), (-25.0, 25.0))

# Configuration -> setting -> values that it must not have.
WRONG = {
    "tf_lane/toponet_tfm": {
        "optim.lr": (-1.0, NAN, INF, "fast", None, True),
        "optim.b1": (1.0, 1.5, -0.1, NAN),
        "optim.b2": (1.0, 2.0),
        "optim.eps": (0.0, -1e-8),
        "optim.ema_decay": (1.0, 1.1),
        "optim.weight_decay": (-0.1, INF),
        "optim.clip_norm": (0.0, -1.0, NAN),
        "optim.warmup_ratio": (-0.1, 2.0),
        "optim.final_ratio": (-1.0, 1.5),
        "optim.warmup_steps": (-1, 1_000_000, 2.5),
        "optim.epoch_steps": (-5,),
        "optim.optimizer": ("sgd", None),
        "optim.decay": ("none",),
        "optim.restarts": ("cosine", DropsConfig()),
        "optim.drops": (DropsConfig(()), DropsConfig((5, 5)), DropsConfig((1,), 0.0), DropsConfig((1,), 2.0)),
        "training.steps": (0, -3, 1.5, None),
        "training.batch_size": (0, "8"),
        "training.accumulate": (0, 3, 16),
        "optim.lr_scaling": ("square", "sqrt", None),
        "optim.reference_batch": (0, 8.0),
        "training.seeds": ((), (1, 1), (-1,), 3, (0.5,)),
        "training.log_every": (0,),
        "training.eval_every": (0,),
        "training.checkpoint_every": (-1,),
        "training.keep_checkpoints": (0,),
        "training.best_metric": ("all/DETl", "DET_l", "", None, "all/OLS", "lines/mAP"),
        "training.init_partly": ("yes", 1),
        "evaluation.batch_size": (0,),
        "evaluation.pictures": (-1,),
        "evaluation.versions": ((), ("v3",), ("v2.1", "v2.1"), "v2.1"),
        "evaluation.traffic": ("some",),
        "evaluation.map_measures": (("frechet",),),
        "data.train": (0, -1),
        "data.val": (0,),
        "data.test": (2.0,),
        "data.world.severity": (-0.1, 1.1, NAN),
        "data.world.keyframes": (0, 10_000),
        "data.world.duration_s": (0.0, 1.0),
        "data.world.rate_hz": (0.0, -10.0, 7.0),
        "data.world.roads.lane_width": ((3.8, 2.9), (-1.0, 2.0), (3.0,)),
        "data.world.roads.signals": (1.2,),
        "data.world.roads.kinds": ((),),
        "data.world.roads.junction_lanes": (0,),
        "data.world.traffic.vehicles_per_metre": (-0.1,),
        "data.world.traffic.step_s": (0.0,),
        "data.world.traffic.parked_share": (2.0,),
        "data.world.tracker.correlation": (1.5,),
        "data.world.tracker.range": (0.0,),
        "data.example.history": (0, 3, -1),
        "data.example.history_hz": (0.0, 3.0, NAN),
        "data.example.lanes": (0,),
        "data.example.lane_points": (1, 7),
        "data.example.range": (REVERSED, PerceptionRange((-90.0, 90.0), (-60.0, 60.0)), None),
        "data.example.sensor": (None,),
        "data.example.elements_of": ("lanes",),
        "data.example.sensor.grid.rows": (0,),
        "data.example.sensor.lost": (1.5,),
        "task.clip": (0, 3),
        "task.time": ("loop", "scan"),
        "task.empty_frames": ("drop",),
        "task.model": (None, RestartsConfig()),
        "task.losses": (None,),
        "task.losses.class_weight": (-1.0, NAN),
        "task.losses.alpha": (1.5,),
        "task.losses.matcher": ("auction",),
        "task.model.encoder.dim": (0, 30),
        "task.model.encoder.cell": (0,),
        "task.model.encoder.dilations": ((0,), (1.5,)),
        "task.model.decoder.heads": (0, 7),
        "task.model.decoder.dim": (0, 60),
        "task.model.decoder.layers": (0,),
        "task.model.decoder.queries": (0, -5),
        "task.model.decoder.points": (1, 12),
        "task.model.decoder.dropout": (1.0, -0.1),
        "task.model.decoder.sampling_points": (0,),
        "task.model.decoder.metres": ((5.0, 5.0), (5.0, 0.0, 0.3)),
        "task.model.priors.traffic_flow.prior.frames": (0, 40),
        "task.model.priors.traffic_flow.prior.min_valid_frames": (0, 21),
        "task.model.priors.traffic_flow.prior.max_instances": (0,),
        "task.model.priors.traffic_flow.prior.top_instances": (-1, 31),
        "task.model.priors.traffic_flow.prior.front_sector_deg": (400.0,),
        "task.model.priors.traffic_flow.module.heads": (3, 0),
        "task.model.priors.traffic_flow.module.fusions": ((), ("L->L", "L->L"), ("L->X",)),
        "task.model.priors.traffic_flow.module.masking.window": (0.0, -1.0, NAN),
        "task.model.priors.traffic_flow.module.masking.nearest": (0,),
        "task.model.priors.traffic_flow.module.masking.head_windows": ((1.0,),),
        "task.model.priors.traffic_flow": ("on",),
    },
    "tf_lane/lanesegnet": {
        "task.model.decoder.heads": (1, 3),
        "task.model.decoder.classes": (1, 3),
        "data.example.segment_points": (7,),
        "data.example.area_points": (1, 6),
    },
    "tf_lane/maptrv2": {
        "data.example.map_lines": (None,),
        "task.model.encoder.cells": (True,),
        "task.model.decoder.coordinates": (4,),
        "task.losses.many_repeats": (0,),
        "task.losses.least_step": (0.0, 1e-10),
    },
    "camera/toponet": {
        "data.example.cameras": (None,),
        "data.example.cameras.scale": (0.0, 0.0001),
        "data.example.cameras.cameras": ((),),
        "data.example.cameras.severity": (7.0,),
        "task.model.encoder.bev.dim": (63, 48),
        "task.model.encoder.bev.heads": (5,),
        "task.model.encoder.bev.spatial_points": (7,),
        "task.model.encoder.images.stages": ((), (2, 9), (3, 2)),
        "task.model.encoder.images.frozen_stages": (9,),
        "task.model.encoder.images.pyramid.levels": (1, 5),
        "task.model.encoder.images.backbone.strides": ((1, 2),),
        "task.model.elements.layers": (1,),
    },
    "markers/cameras": {
        "data.example.markers": (None,),
        "data.example.markers.points": (1,),
        "data.example.markers.simulation.jump": (1.5,),
        "task.model.priors.markers.memory.decay": (0.0, 1.5),
        "task.model.priors.markers.memory.threshold": (-0.1,),
        "task.model.priors.markers.heads": (7,),
    },
    "gtn_lane/gtn": {
        "training.best_metric": ("all/loss", "all/FN"),
        "task.model.dim": (30,),
        "task.model.queries": (0,),
        "task.model.encoder.channels": (5,),
        "task.model.encoder.relations": (("self", "self"), ("diagonal",)),
        "task.model.anchors": ((0.9, 0.4), (0.4,)),
        "task.model.decoder.heads": (3,),
        "data.augmentation.crop": (0.0, 1.5),
        "data.augmentation.rotation": (10.0,),
        "task.losses.least_depth": (0.0,),
    },
    "tf_lane/lanesegnet_r50": {
        "data.root": (Path("no/such/folder"), "data", None),
        "data.image.scale": (0.0, 2.0),
        "data.augmentation.contrast": ((1.5, 0.5),),
        "data.loading.ahead": (0,),
        "data.loading.where": ("ram",),
    },
    "tf_lane/argoverse2": {"data.train": (Path("no/such/folder"),), "data.val": (None,)},
    "real_maps": {"data.maps": (Path("no/such/folder"),), "data.generated": (1.1,)},
}
CASES = [(name, setting, value) for name, each in WRONG.items() for setting, values in each.items() for value in values]


@functools.cache
def loaded(reference: str) -> RunConfig:
    return load_config(reference) if reference else RunConfig()


@functools.cache
def existing(reference: str, folder: Path) -> RunConfig:
    """Return a configuration whose data lie in a folder that exists."""
    config = loaded(reference)
    for field in dataclasses.fields(config.data):
        if isinstance(getattr(config.data, field.name), Path):
            config = with_setting(config, f"data.{field.name}", folder)
    return config


@pytest.mark.parametrize(("reference", "setting", "value"), CASES)
def test_a_wrong_setting_is_named_with_its_value(reference, setting, value, tmp_path_factory, monkeypatch):
    monkeypatch.setattr(runs, "train", None)  # data are not looked at, and nothing is compiled
    for function in ("load", "open_dataset", "make_dataset", "sample"):
        monkeypatch.setattr(sources, function, None)
    out = tmp_path_factory.getbasetemp() / "never_written"
    config = with_setting(existing(reference, tmp_path_factory.getbasetemp()), setting, value)
    with pytest.raises(UserError) as error:
        runs.train_run(config, out, progress=False)
    message = str(error.value)
    assert setting in message or FITS.get(setting, setting) in message
    assert "\n" not in message
    assert not out.exists()
    if isinstance(error.value, SettingError) and error.value.setting == setting:
        assert f"{setting} is {shown(value)}: it must be " in message


# The message is about the setting that the value no longer fits.
FITS = {
    "optim.lr_scaling": "optim.reference_batch is None",
    "data.world.duration_s": "data.world.keyframes is 4",
    "data.world.rate_hz": "data.example.history_hz is 2.0",
    "task.model.decoder.dim": "task.model.decoder.heads is 8: it must be a divisor of dim",
}


def shown(value):
    """Return a value as messages show it: a path as text, a configuration by its class."""
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    return repr(str(value) if isinstance(value, Path) else value)


def test_there_are_enough_cases():
    assert len(CASES) >= 150


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--optim.lr", "-1"], ["--optim.lr is -1.0", "at least 0"]),
        (["--task.model.decoder.heads", "7"], ["--task.model.decoder.heads is 7", "divisor of dim (64)"]),
        (["--training.best_metric", "all/DETl"], ["training.best_metric is 'all/DETl'", "did you mean all/DET_l"]),
        (
            ["--data.world.terrain", "default", "--data.example.markers", "default"],
            ["--data.world.terrain is TerrainConfig", "it must be None, or example.markers None", "level ground"],
        ),
        (["--training.init-from", "no/run"], ["training.init_from is no/run", "holds no run", "tflane convert"]),
        (["--optim.bl", "0.5"], ["unknown setting --optim.bl", "--optim.b1"]),
        (["--optim.lr", "fast"], ["--optim.lr", "fast"]),
    ],
)
def test_the_command_line_ends_with_the_message(arguments, words, tmp_path, capsys, monkeypatch):
    for function in ("load", "open_dataset", "make_dataset", "sample"):
        monkeypatch.setattr(sources, function, None)
    assert main(["train", "--config", "tf_lane/toponet", "--out", str(tmp_path / "run"), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("tflane: ")
    assert error.count("\n") == 1
    assert all(word in error for word in words), error
    assert not (tmp_path / "run").exists()


HEAD = "from dataclasses import replace\nfrom tflane_jax.config import OptimConfig, RunConfig\n\n\n"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("RunConfig(\n        optim=OptimConfig(\n            lr=-1.0)\n    )", ["line 8: optim.lr is -1.0"]),
        ("RunConfig(optim=OptimConfig(lrr=1.0))", ["line 6: OptimConfig has no setting lrr", "did you mean lr?"]),
        ("replace(RunConfig(), optin=None)", ["line 6: RunConfig has no setting optin", "did you mean optim?"]),
        ("RunConfig(optim=OptimConfig(b1=0.5, b2='x'))", ["line 6: optim.b2 is 'x'"]),
        ("RunConfig(optim=OptimConfig(*[-1.0]))", [".py: optim.lr is -1.0"]),
    ],
)
def test_wrong_settings_of_a_file_are_named_with_their_line(body, words, tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text(f"{HEAD}def get_config():\n    return {body}\n")
    with pytest.raises(UserError) as error:
        load_config(str(path))
    assert all(word in str(error.value) for word in [str(path), *words]), str(error.value)


def test_images_do_not_train_a_model_of_lane_graphs():
    images = loaded("gtn_lane/gtn")
    with pytest.raises(UserError, match=r"data are images \(data is FrontViewData\).*task is LaneGraphTask"):
        check_run(replace(RunConfig(), data=images.data))


def test_overrides_may_break_no_limit_of_another_setting():
    with pytest.raises(UserError, match=r"--optim\.warmup_steps is 500: it must be less than .*training\.steps, 100"):
        apply_overrides(RunConfig(), ["--training.steps", "100"])


def test_patterns_of_learning_rates_are_checked_before_data_are_built(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "load", None)
    config = loaded("gtn_lane/gtn")
    config = replace(config, optim=replace(config.optim, lr_factors=(("backbone/nowhere", 0.1),)))
    with pytest.raises(UserError, match=r"optim\.lr_factors: no parameter matches 'backbone/nowhere'"):
        runs.train_run(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_a_batch_that_devices_cannot_share_is_refused_before_data_are_built(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "load", None)
    monkeypatch.setattr(devices.jax, "device_count", lambda: 3)
    with pytest.raises(UserError, match=r"training\.batch_size is 8, which 3 devices cannot share evenly"):
        runs.train_run(loaded(""), tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_processes_with_other_settings_or_code_are_told(monkeypatch):
    """Regression: they trained one wrong model together, or waited for each other for ever."""
    config = load_config("tf_lane/toponet_tfm")
    agree_on_settings(config)

    def first_has(**other):
        monkeypatch.setattr("tflane_jax.run_checks.from_first", lambda found: found() | other)

    for setting, value in (("optim.lr", 0.5), ("evaluation.batch_size", 5), ("training.shard_state", True)):
        first_has(settings=without_workers(to_json(with_setting(config, setting, value))))
        with pytest.raises(UserError, match=rf"not those of the first process \({setting}: {value} there, .* here\)"):
            agree_on_settings(config)
    first_has(settings=without_workers(to_json(with_setting(config, "data.loading.threads", 7))))
    agree_on_settings(config)
    first_has(code="another")
    with pytest.raises(UserError, match="own modules have other code than those of the first process"):
        agree_on_settings(config)

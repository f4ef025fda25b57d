"""Settings changed by arguments: what they change, and errors that name the setting."""

import argparse
import contextlib
import dataclasses
import io
from dataclasses import replace
from pathlib import Path

import pytest
import tyro

from tflane_jax.commands import train
from tflane_jax.config import OpenLaneV2Data, RunConfig, epochs_of, load_config
from tflane_jax.config_io import from_json, settings, to_json
from tflane_jax.config_overrides import _without_boxes, apply_overrides, batch_notices, unread_notices
from tflane_jax.errors import UserError
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.marker_fusion import MarkerFusionConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.restarts import RestartsConfig
from tflane_jax.training.schedule import DropsConfig, OptimConfig

FLOW = RunConfig(task=LaneGraphTask(TopoNetConfig(priors=PriorsConfig(traffic_flow=TrafficFlowConfig()))))


@pytest.mark.parametrize(
    ("arguments", "changed"),
    [
        ([], {}),
        (["--optim.lr", "1e-3"], {"optim.lr": 1e-3}),
        (["--optim.lr=1e-3", "--training.seeds", "4", "5"], {"optim.lr": 1e-3, "training.seeds": (4, 5)}),
        (["--training.init-from", "runs/a"], {"training.init_from": "runs/a"}),
        (
            ["--task.model.priors.traffic_flow.prior.top_instances", "0"],
            {"task.model.priors.traffic_flow.prior.top_instances": 0},
        ),
        (["--data.world.severity", "1"], {"data.world.severity": 1.0}),
    ],
)
def test_overrides_change_only_the_named_setting(arguments, changed):
    before, after = dict(settings(FLOW)), dict(settings(apply_overrides(FLOW, arguments)))
    differing = {k: v for k, v in after.items() if v != before[k] and not dataclasses.is_dataclass(v)}
    assert differing == changed


WHOLE = [
    # A number, flags set and cleared, several values, a choice, enumerations, optional numbers and text, negative ones.
    ["--optim.lr", "1e-3", "--training.shard-state", "--training.seeds", "4", "5", "--task.losses.matcher=scipy"],
    ["--task.model.encoder.no-cells", "--training.init-from", "None", "--task.model.range.z", "-3", "2"],
    ["--task.model.encoder.range.x", "-10", "20.5", "--data.world.roads.kinds", "ROAD", "0.5", "EXIT_RAMP", "0.5"],
    ["--task.model.priors.traffic_flow.prior.top_instances", "3", "--optim.lr", "1", "--optim.lr", "2"],
    ["--training.seeds", "4", "five"],
    ["--task.model.encoder.range.x", "-10"],
    ["--data.world.roads.kinds", "RIVER", "0.5"],
    ["--optim.lr", "1e-3", "stray", "words"],
]


@pytest.mark.parametrize("arguments", WHOLE)
def test_arguments_are_read_as_those_of_the_whole_configuration(arguments):
    """tyro gets the named settings alone, because it takes a third of a second for all of them."""
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
            whole = tyro.cli(RunConfig, default=FLOW, args=arguments, config=(tyro.conf.AvoidSubcommands,))
    except SystemExit:
        with pytest.raises(UserError) as error:
            apply_overrides(FLOW, arguments)
        assert str(error.value) == _without_boxes(output.getvalue(), FLOW)
    else:
        assert apply_overrides(FLOW, arguments) == whole


def test_parts_are_switched_on_and_off():
    arguments = [
        "--data.example.markers.simulation.jump",
        "0.2",
        "--data.example.markers",
        "default",
        "--task.model.priors.markers.memory",
        "None",
        "--task.model.priors.traffic-flow=None",
        "--task.model.priors.markers",
        "MarkerFusionConfig",
    ]
    config = apply_overrides(FLOW, arguments)
    model = FLOW.task.model
    assert config.data.example == replace(
        FLOW.data.example, markers=MarkerConfig(simulation=MarkerSimulationConfig(jump=0.2))
    )
    assert config.task.model == replace(
        model, priors=replace(model.priors, traffic_flow=None, markers=MarkerFusionConfig(memory=None))
    )
    assert (
        apply_overrides(config, ["--task.model.priors.traffic_flow", "default"]).task.model.priors.traffic_flow
        is not None
    )


def test_settings_of_other_data_can_be_changed():
    config = RunConfig(data=OpenLaneV2Data(Path("a")))
    arguments = ["--data.image.scale", "0.25", "--data.augmentation.grid-mask", "0.7", "--data.root", "b"]
    data = apply_overrides(config, arguments).data
    assert isinstance(data, OpenLaneV2Data)
    assert (data.image.scale, data.augmentation.grid_mask, data.root) == (0.25, 0.7, Path("b"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--optim.lrr", "1"], r"unknown setting --optim\.lrr: did you mean --optim\.lr\?"),
        (["--lr", "1"], r"did you mean --optim\.lr\?"),
        (["--xyz", "1"], "see --help for all settings"),
        (["--optim.steps", "1"], r"did you mean --training\.steps"),
        (["--optim.learning-rate", "1"], r"unknown setting --optim\.learning_rate: did you mean --optim\.lr\?"),
        (["--epochs", "3"], r"did you mean --training\.steps\?"),
        (["--training.batch", "3"], r"did you mean --training\.batch_size"),
        (["--training.steps", "ten"], "^--training.steps is 'ten': it must be a whole number$"),
        (["--training.steps", "1.5"], "^--training.steps is '1.5': it must be a whole number$"),
        (["--optim.lr", "high"], "^--optim.lr is 'high': it must be a number$"),
        (["--training.seeds", "1", "a"], "^--training.seeds cannot be 1 a: it must be a tuple, each item a whole"),
        (["--data.world.roads.kinds", "RUNDABOUT", "1"], r"RUNDABOUT 1: it must be .* \(ROAD or .* ROUNDABOUT or"),
        (["--no-training.same-examples"], r"did you mean --training\.no-same-examples\?"),
        (["--training.same-examples", "False"], r"is a flag .* or --training\.no-same-examples for False"),
        (["--training.no-same-examples=True"], r"^--training\.same-examples is a flag without a value"),
        (["--training.steps"], "Missing value"),
        (["--task.losses.matcher", "magic"], "invalid choice 'magic'"),
        (["stray"], "stray"),
        (
            ["--task.model.priors.markers", "on"],
            r"--task\.model\.priors\.markers takes None, default, MarkerFusionConfig, not 'on'",
        ),
        (["--task.model.priors.markers"], "takes None, default"),
        (
            ["--task.model.priors", "MyPriorsConfig"],
            r"MyPriorsConfig.*; import the module of a class of yours, --import MODULE$",
        ),
        (["--data", "OpenLaneV2Data"], "OpenLaneV2Data has no defaults for all of its settings"),
    ],
)
def test_invalid_overrides_give_a_one_line_error(arguments, message):
    with pytest.raises(UserError, match=message) as error:
        apply_overrides(FLOW, arguments)
    assert "\n" not in str(error.value)


RESNET = RunConfig(
    training=TrainingConfig(steps=24 * 2810, batch_size=8, eval_every=2810, checkpoint_every=1000),
    optim=OptimConfig(epoch_steps=2810),
)
SAME = "--training.same-examples"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--training.batch-size", "16"], (24 * 2810, 2810, 1000, 2810)),
        (["--training.batch-size", "16", SAME], (24 * 1405, 1405, 500, 1405)),
        (["--training.batch-size", "4", SAME], (48 * 2810, 5620, 2000, 5620)),
        (["--training.batch-size=64", SAME], (24 * 352, 352, 125, 352)),  # 351.25 updates are a whole epoch
        ([SAME], (24 * 2810, 2810, 1000, 2810)),
        (["--training.batch-size", "16", SAME, "--training.steps", "2810"], (2810, 1405, 500, 1405)),
        (["--training.batch-size", "16", SAME, "--optim.epoch-steps", "1400"], (24 * 1400, 1400, 500, 1400)),
        (["--training.batch-size", "16", SAME, "--optim.epoch-steps", "0"], (24 * 1405, 1405, 500, 0)),
    ],
)
def test_another_batch_may_keep_the_number_of_examples(arguments, expected):
    config = apply_overrides(RESNET, arguments)
    training = config.training
    assert (training.steps, training.eval_every, training.checkpoint_every, config.optim.epoch_steps) == expected
    assert training.log_every == RESNET.training.log_every
    # A saved configuration is what is trained, and may be changed again.
    assert from_json(RunConfig, to_json(config)) == config
    assert apply_overrides(config, [SAME]) == replace(config, training=replace(training, same_examples=True))


@pytest.mark.parametrize(
    ("optim", "arguments", "expected"),
    [
        (OptimConfig(drops=DropsConfig((4000, 6001))), [], OptimConfig(drops=DropsConfig((2000, 3001)))),
        (
            OptimConfig(restarts=RestartsConfig(1001)),
            ["--optim.restarts.factor", "3"],
            OptimConfig(restarts=RestartsConfig(501, factor=3.0)),
        ),
        (OptimConfig(), ["--optim.restarts", "default"], OptimConfig(restarts=RestartsConfig())),
        (
            OptimConfig(restarts=RestartsConfig(1001)),
            ["--optim.restarts.cycle-steps", "100"],
            OptimConfig(restarts=RestartsConfig(100)),
        ),
        (  # 40 of 67,430 steps after the warm-up are 19 of 33,710
            OptimConfig(warmup_steps=10, restarts=RestartsConfig(40, last_cycle="fit")),
            [],
            OptimConfig(warmup_steps=10, restarts=RestartsConfig(19, last_cycle="fit")),
        ),
    ],
)
def test_drops_and_cycles_are_divided_too_unless_they_are_given(optim, arguments, expected):
    config = apply_overrides(replace(RESNET, optim=optim), ["--training.batch-size", "16", SAME, *arguments])
    assert config.optim == expected


@pytest.mark.parametrize("batch", [2, 8, 32])
@pytest.mark.parametrize("name", ["gtn_lane/table1:gtn_restarts", "gtn_lane/fine_tuned:gtn_restarts"])
def test_cycles_that_fill_a_run_are_as_many_with_another_batch(name, batch):
    config = apply_overrides(load_config(name), ["--training.batch-size", str(batch), SAME])
    restarts, steps = config.optim.restarts, config.training.steps
    rest = steps - config.optim.warmup_steps - 7 * restarts.cycle_steps  # cycles of 1, 2 and 4 parts
    assert 0 <= rest < 2 * 7  # which rounding leaves, here and with the first batch


def test_tflane_train_tells_what_another_batch_trains(tmp_path, capsys):
    options = argparse.Namespace(config="camera/toponet_r50")
    train._config(options, tmp_path, ["--training.batch-size", "16"])
    assert "48 epochs in place of 24" in capsys.readouterr().err
    config = train._config(options, tmp_path, ["--training.batch-size", "16", SAME])
    assert capsys.readouterr().err == ""
    assert epochs_of(config) == 24


def test_what_another_batch_trains_is_told():
    changed = apply_overrides(RESNET, ["--training.batch-size", "16"])
    (notice,) = batch_notices(RESNET, changed)
    assert "sees 2 times as many examples, 48 epochs in place of 24. --training.same-examples" in notice
    without = replace(RESNET, optim=OptimConfig())
    (notice,) = batch_notices(without, apply_overrides(without, ["--training.batch-size", "2"]))
    assert "sees 0.25 times as many examples. --training.same-examples" in notice
    for known in ([], ["--training.batch-size", "16", SAME], ["--training.batch-size", "16", "--training.steps", "9"]):
        assert batch_notices(RESNET, apply_overrides(RESNET, [*known, "--optim.warmup-steps", "3"])) == []


MAP, MARKERS = ["--data.example.sd-map", "default"], ["--data.example.markers", "default"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (MAP, ["examples have an SD map (data.example.sd_map), which no prior of this model "]),
        (MARKERS, ["examples have markers (data.example.markers), "]),
        ([*MAP, *MARKERS, "--task.model.priors.markers", "default"], ["examples have an SD map "]),
        ([*MAP, "--task.model.priors.sd-map", "default"], []),
        ([], []),
    ],
)
def test_examples_with_what_the_model_does_not_read_are_told(arguments, told, tmp_path, capsys):
    train._config(argparse.Namespace(config="tf_lane/toponet"), tmp_path, arguments)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(told)
    assert all(line.startswith(start) for line, start in zip(lines, told, strict=True))


def test_a_control_that_is_shipped_with_examples_of_other_models_is_not_told():
    control, images = load_config("markers/toponet_markers:toponet"), load_config("gtn_lane/gtn")
    assert unread_notices(control, apply_overrides(control, ["--optim.lr", "0.5"])) == []
    assert unread_notices(images, images) == []

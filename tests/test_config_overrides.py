"""Settings changed by arguments: what they change, and errors that name the setting."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import pytest

from tflane_jax.config import OpenLaneV2Data, RunConfig
from tflane_jax.config_io import settings
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.markers.simulation import MarkerConfig, MarkerSimulationConfig
from tflane_jax.models.marker_fusion import MarkerFusionConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask

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
        (["--training.steps"], "Missing value"),
        (["--task.losses.matcher", "magic"], "invalid choice 'magic'"),
        (["stray"], "stray"),
        (
            ["--task.model.priors.markers", "on"],
            r"--task\.model\.priors\.markers takes None, default, MarkerFusionConfig, not 'on'",
        ),
        (["--task.model.priors.markers"], "takes None, default"),
        (["--data", "OpenLaneV2Data"], "OpenLaneV2Data has no defaults for all of its settings"),
    ],
)
def test_invalid_overrides_give_a_one_line_error(arguments, message):
    with pytest.raises(UserError, match=message) as error:
        apply_overrides(FLOW, arguments)
    assert "\n" not in str(error.value)

"""Own parts of a run as subclasses outside the package: they are built, checked, changed by arguments and read back."""

import json
import re
from dataclasses import dataclass, fields, replace
from typing import Any

import flax.linen as nn
import jax
import pytest

from tests.models.cases import BASELINE, CAMERA, make_camera_example, make_example
from tests.models.toy_prior import CrossingsConfig
from tests.shared import ROOT
from tflane_jax.config import RunConfig
from tflane_jax.config_io import choices, from_json, to_json, with_setting
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.limits import Count, check_settings
from tflane_jax.models.camera_encoder import CameraEncoder, CameraEncoderConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.raster_fusion import TrafficRasterConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.run_checks import check_run
from tflane_jax.scene import Example, Prediction
from tflane_jax.tasks.lane_graph import LaneGraphTask


@dataclass(frozen=True)
class PlainEncoderConfig(EvidenceEncoderConfig):
    """One convolution."""

    kernel: Count = 3

    def build(self) -> nn.Module:
        return PlainEncoder(self)


class PlainEncoder(nn.Module):
    config: PlainEncoderConfig

    @nn.compact
    def __call__(self, bev, fuse=None):
        step = self.config.cell
        return nn.Conv(self.config.dim, (self.config.kernel,) * 2, strides=step, name="plain")(bev / 255.0)


@dataclass(frozen=True)
class NightEncoderConfig(CameraEncoderConfig):
    """The cameras of the package, with a brightness of its own."""

    def build(self) -> nn.Module:
        return NightEncoder(self)


class NightEncoder(nn.Module):
    config: NightEncoderConfig

    @nn.compact
    def __call__(self, example, memory, *, train, fuse=None):
        out = CameraEncoder(self.config, name="cameras")(example, memory, train=train, fuse=fuse)
        return out._replace(bev=out.bev * self.param("brightness", nn.initializers.ones, ()))


@dataclass(frozen=True)
class MapPriorsConfig(PriorsConfig):
    crossings: CrossingsConfig | None = None


@dataclass(frozen=True)
class QuietTask(LaneGraphTask):
    patience: Count = 3


def shaped(task: LaneGraphTask, example: Example) -> tuple[Any, Prediction]:
    """Return the shapes of a model's parameters and prediction."""
    params = jax.eval_shape(task.init, jax.random.key(0), example)
    return params, jax.eval_shape(task.predict, params, example)


PARTS = {
    "task.model.encoder": PlainEncoderConfig(dim=16, kernel=5),
    "task.model.priors": MapPriorsConfig(crossings=CrossingsConfig(4)),
    "task": QuietTask(patience=5),
}


@pytest.mark.parametrize("name", PARTS)
def test_an_own_part_is_checked_changed_and_read_back(name):
    part = PARTS[name]
    config = with_setting(RunConfig(), name, part)
    check_settings(config)
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    changed = apply_overrides(config, ["--optim.lr", "0.5"])
    assert changed == with_setting(config, "optim.lr", 0.5)
    own = {"task.model.encoder": "kernel", "task.model.priors": "crossings.width", "task": "patience"}[name]
    changed = apply_overrides(RunConfig(), [*chosen(name, type(part)), f"--{name}.{own}", "7"])
    assert type(part) in choices(config, name).values()
    assert f"'{own.rpartition('.')[2]}': 7" in str(to_json(changed))
    with pytest.raises(UserError, match="it must be a whole number"):
        apply_overrides(config, [f"--{name}.{own}", "x"])


def test_a_derived_class_keeps_what_is_set():
    """Regression: an own prior switched the shipped ones off, and an own encoder had the shipped default size."""
    model = replace(RunConfig().task.model, priors=PriorsConfig(traffic_flow=TrafficFlowConfig(insert="every_layer")))
    config = with_setting(RunConfig(), "task.model", model)
    config = with_setting(config, "task.model.encoder", replace(model.encoder, dim=96))
    changed = apply_overrides(
        config, ["--task.model.priors", "MapPriorsConfig", "--task.model.encoder", "PlainEncoderConfig"]
    )
    assert changed.task.model.priors == MapPriorsConfig(traffic_flow=TrafficFlowConfig(insert="every_layer"))
    assert changed.task.model.encoder == PlainEncoderConfig(dim=96)
    assert apply_overrides(config, ["--task.model.priors.traffic_flow", "None"]).task.model.priors == PriorsConfig()
    shipped = apply_overrides(config, ["--task.model.encoder", "EvidenceEncoderConfig"])
    assert shipped.task.model.encoder == EvidenceEncoderConfig()
    again = apply_overrides(config, ["--task.model.priors.traffic_flow", "default"]).task.model.priors
    assert again == PriorsConfig(traffic_flow=TrafficFlowConfig())


def chosen(name: str, kind: type) -> list[str]:
    more = [f"--{name}.crossings", "default"] if kind is MapPriorsConfig else []
    return [f"--{name}", kind.__name__, *more]


def test_shipped_parts_can_be_chosen_beside_own_ones():
    found = choices(RunConfig(), "task.model.priors")
    assert {"PriorsConfig", "MapPriorsConfig"} <= found.keys()
    assert next(iter(choices(RunConfig(), "task.model.encoder"))) == "EvidenceEncoderConfig"
    assert "HostConfig" not in choices(RunConfig(), "task.model")


@pytest.mark.slow
def test_an_own_encoder_of_evidence_is_built():
    encoder = PlainEncoderConfig(**{f.name: getattr(BASELINE.encoder, f.name) for f in fields(BASELINE.encoder)})
    params, prediction = shaped(LaneGraphTask(replace(BASELINE, encoder=encoder)), make_example(0))
    assert list(params["encoder"]) == ["plain"]
    assert prediction == shaped(LaneGraphTask(BASELINE), make_example(0))[1]


def with_traffic_in_bev(kind: type[EvidenceEncoderConfig]) -> LaneGraphTask:
    """Return a host with an encoder of a class, and traffic in its BEV features."""
    traffic = replace(TrafficFlowConfig(), bev=TrafficRasterConfig())
    encoder = kind(**vars(BASELINE.encoder))
    return LaneGraphTask(replace(BASELINE, encoder=encoder, priors=PriorsConfig(traffic_flow=traffic)))


def test_the_encoder_of_the_page_takes_priors():
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "fuse_priors(" in block]
    names: dict[str, Any] = {}
    exec(compile(code, "architecture.md", "exec"), names)
    task = with_traffic_in_bev(names["PatchEncoderConfig"])
    params, prediction = shaped(task, make_example(0))
    assert sorted(params["encoder"]) == ["block_0", "block_1", "patch", "traffic_flow_0"]
    assert prediction == shaped(LaneGraphTask(BASELINE), make_example(0))[1]
    encoder, bev = task.model.encoder, make_example(0).bev
    features, _ = jax.eval_shape(encoder.build().init_with_output, jax.random.key(0), bev)
    assert features.shape == (bev.shape[0] // encoder.cell, bev.shape[1] // encoder.cell, encoder.dim)


def test_an_encoder_that_leaves_priors_out_is_an_error():
    with pytest.raises(UserError, match=r"PlainEncoder never calls `fuse_priors` for layer 0.*task\.model\.priors"):
        shaped(with_traffic_in_bev(PlainEncoderConfig), make_example(0))


def test_an_own_encoder_of_cameras_is_built():
    encoder = NightEncoderConfig(**{f.name: getattr(CAMERA, f.name) for f in fields(CAMERA)})
    params, _ = shaped(LaneGraphTask(replace(BASELINE, encoder=encoder)), make_camera_example(0))
    assert sorted(params["encoder"]) == ["brightness", "cameras"]


def test_data_that_fit_an_own_encoder_are_checked():
    config = with_setting(RunConfig(), "task.model.encoder", PlainEncoderConfig(cell=7))
    with pytest.raises(UserError, match=r"do not fold into blocks of 7 x 7 \(task\.model\.encoder\.cell\)"):
        check_run(config)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("optim.lrr", r"lrr is no setting of OptimConfig: did you mean lr"),
        ("optim.lr.x", r"x is no setting of float, which has none"),
        ("task.model.prior", r"prior is no setting of TopoNetConfig: did you mean priors"),
    ],
)
def test_names_that_are_no_settings_are_refused(name, said):
    with pytest.raises(UserError, match=said):
        with_setting(RunConfig(), name, 1)

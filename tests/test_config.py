"""Configurations: text and JSON, and the golden text of every shipped configuration."""

import enum
import functools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pytest

from tests.shared import ROOT
from tflane_jax.config import (
    LogData,
    OpenLaneV2Data,
    RunConfig,
    load_ablations,
    load_config,
    with_reference_batch,
)
from tflane_jax.config_io import from_json, to_json, to_text, with_setting
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.errors import UserError
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.models.traffic_flow_module import TrafficFlowConfig
from tflane_jax.run_checks import check_run
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.schedule import scaled_to_batch

GOLDEN = Path(__file__).parent / "golden_configs"
FLOW = RunConfig(task=LaneGraphTask(TopoNetConfig(priors=PriorsConfig(traffic_flow=TrafficFlowConfig()))))


@functools.cache
def shipped() -> dict[str, str]:
    """Return name -> reference of every configuration and ablation under configs/."""
    found = {"default": ""}
    for path in sorted((ROOT / "configs").rglob("*.py")):
        if path.name.startswith("_"):
            continue
        reference = path.relative_to(ROOT).as_posix()
        name = reference.removeprefix("configs/").removesuffix(".py").replace("/", ".")
        found[name] = reference
        if "def ablations(" in path.read_text(encoding="utf-8"):
            found |= {f"{name}.{ablation}": f"{reference}:{ablation}" for ablation in load_ablations(str(path))}
    return found


@functools.cache
def configurations() -> dict[str, RunConfig]:
    """Return every configuration by its name in `shipped`; each file is run once."""
    found = {"default": RunConfig()}
    for name, reference in shipped().items():
        file, _, ablation = reference.partition(":")
        if reference and not ablation:
            found[name] = load_config(str(ROOT / file))
            if any(other.startswith(f"{file}:") for other in shipped().values()):
                found |= {f"{name}.{key}": config for key, config in load_ablations(str(ROOT / file)).items()}
    return found


def changed_settings(text: str, base: str) -> str:
    """Return the lines of `to_text` that differ between an ablation and its file's configuration, by setting."""
    kept, found = base.splitlines(), text.splitlines()
    lines = [f"- {line}" for line in kept if line not in set(found)]
    lines += [f"+ {line}" for line in found if line not in set(kept)]
    return "".join(
        f"{line}\n" for line in sorted(lines, key=lambda line: (line[2:].partition(" = ")[0], line[0] == "+"))
    )


@functools.cache
def golden_texts() -> dict[str, str]:
    """Return the golden text of each file below configs/: its configuration, and what each ablation changes."""
    texts: dict[str, str] = {}
    for name, reference in shipped().items():
        text, (_, _, ablation) = to_text(configurations()[name]), reference.partition(":")
        if ablation:
            file = name.removesuffix(f".{ablation}")
            texts[file] += f"\n:{ablation}\n{changed_settings(text, to_text(configurations()[file]))}"
        else:
            texts[name] = text
    return texts


@pytest.mark.parametrize("name", [name for name, reference in shipped().items() if ":" not in reference])
def test_shipped_configurations_have_not_changed_silently(name, tmp_path):
    text, golden = golden_texts()[name], GOLDEN / f"{name}.txt"
    if not golden.exists() or golden.read_text(encoding="utf-8") != text:
        (tmp_path / golden.name).write_text(text, encoding="utf-8")
        change = f"diff {golden} {tmp_path / golden.name}"
        pytest.fail(f"{name} has changed ({change}); if that is meant: python -m tests.test_config")


def test_the_settings_of_an_ablation_that_differ_are_listed():
    base = to_text(Outer(Inner(), rate=1.0))
    assert changed_settings(base, base) == ""
    assert changed_settings(to_text(Outer(Other(3), rate=2.0)), base) == (
        "- part = Inner\n+ part = Other\n- part.pairs = [['RED', 0.5]]\n+ part.size = 3\n- rate = 1.0\n+ rate = 2.0\n"
    )


@pytest.mark.parametrize("name", sorted(shipped().keys() - {"default", "camera.native_ring"}))
def test_shipped_configurations_keep_their_limits(name, monkeypatch):
    """Types and ranges, data against model, names of scores; files are not looked for.

    `camera.native_ring` has data to export, which fit no small model.
    """
    config = configurations()[name]
    monkeypatch.setattr(Path, "exists", lambda path: True)
    check_run(config)


@pytest.mark.parametrize("name", ["default", *(name for name in shipped() if "." in name and name.count(".") == 1)])
def test_a_shipped_learning_rate_is_that_of_the_shipped_batch(name):
    config = configurations()[name]
    optim = with_reference_batch(replace(config, optim=replace(config.optim, lr_scaling="linear")), config).optim
    assert scaled_to_batch(optim, config.training.batch_size).lr == config.optim.lr


@pytest.mark.parametrize(
    "name", sorted({name for name in shipped() if name.endswith("_r50")} - {"markers.toponet_r50"})
)
def test_a_configuration_of_paper_size_has_half_precision_and_recomputed_activations(name):
    """The marker paper's has the settings alone, docs/scale.md."""
    found = {key: to_text(configurations()[f"{name}.{key}"]) for key in ("remat", "bfloat16")}
    assert "encoder.images.remat = True" in found["remat"]
    assert "encoder.images.precision = 'bfloat16'" in found["bfloat16"]


@pytest.mark.parametrize(
    ("name", "same"),
    [("tf_lane/toponet", False), ("gtn_lane/gtn", False), ("camera/toponet_r50", True), ("tf_lane/argoverse2", True)],
)
def test_a_configuration_says_whether_its_best_checkpoint_is_chosen_by_test_examples(name, same):
    config = load_config(name)
    assert config.chosen_by(config.data.source("test")) == same
    assert config.chosen_by(config.data.source("val"))
    assert not config.chosen_by(config.data.source("train"))
    assert not with_setting(config, "training.eval_every", config.training.steps).chosen_by(config.data.source("val"))


def test_a_scaled_learning_rate_starts_from_the_batch_of_the_file():
    arguments = ["--optim.lr_scaling", "linear", "--training.batch_size", "64"]
    config = apply_overrides(load_config("tf_lane/maptr_r50"), arguments)
    assert config.optim.reference_batch == 32
    assert apply_overrides(config, ["--training.batch_size", "16"]).optim.reference_batch == 32


def test_every_golden_text_has_its_configuration():
    assert {path.stem for path in GOLDEN.glob("*.txt")} == set(golden_texts())


@pytest.mark.parametrize(
    "config",
    [
        RunConfig(),
        FLOW,
        RunConfig(data=LogData(Path("a"), Path("b/c"), Path("d"), openlane=Path("e"))),
        RunConfig(data=OpenLaneV2Data(Path("a"), subset="B")),
        RunConfig(data=OpenLaneV2Data(Path("a"), augmentation=None)),
    ],
)
def test_json_round_trip(config):
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    assert hash(config) == hash(from_json(RunConfig, to_json(config)))


class Colour(enum.Enum):
    RED = "crimson"


@dataclass(frozen=True)
class Inner:
    pairs: tuple[tuple[Colour, float], ...] = ((Colour.RED, 0.5),)


@dataclass(frozen=True)
class Other:
    size: int = 1


@dataclass(frozen=True)
class Outer:
    part: Inner | Other | None = None
    mode: Literal["a", "b"] = "a"
    rate: float = 1.0
    path: Path | None = None


def test_text_is_one_line_per_setting():
    assert to_text(Outer(Inner(), path=Path("x/y"))) == (
        "part = Inner\npart.pairs = [['RED', 0.5]]\nmode = 'a'\nrate = 1.0\npath = 'x/y'\n"
    )


@pytest.mark.parametrize("value", [Outer(), Outer(Inner(), "b", 2.5, Path("p")), Outer(Other(3)), Outer(Inner(()))])
def test_every_kind_of_setting_survives_json(value):
    assert from_json(Outer, json.loads(json.dumps(to_json(value)))) == value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "c"}, "setting mode cannot be 'c'"),
        ({"rate": "fast"}, "setting rate cannot be 'fast'"),
        ({"rate": True}, "setting rate cannot be True"),
        ({"speed": 3}, "setting speed is unknown"),
        ({"part": {"class": "os.system", "size": 1}}, r"class os\.system \(setting part\) is not part of this version"),
        ({"part": {"class": "Other", "size": 1.5}}, r"setting part\.size cannot be 1\.5"),
        ({"part": {"class": "Inner", "pairs": [["BLUE", 1.0]]}}, r"setting part\.pairs cannot be 'BLUE'"),
        ({"class": "Inner"}, "should be a Outer"),
    ],
)
def test_json_that_does_not_fit_is_named(change, message):
    with pytest.raises(UserError, match=message):
        from_json(Outer, to_json(Outer()) | change)


def test_settings_that_a_file_lacks_take_their_defaults():
    assert from_json(Outer, {"class": "Outer", "rate": 2.0}) == Outer(rate=2.0)


def write_golden_texts() -> None:
    """Accept every configuration as it is now: `python -m tests.test_config`."""
    for path in GOLDEN.glob("*.txt"):
        path.unlink()
    for name, text in golden_texts().items():
        (GOLDEN / f"{name}.txt").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_golden_texts()

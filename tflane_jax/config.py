"""A run's configuration, assembled from those of its parts, and configuration files.

A config file is Python with `get_config() -> RunConfig` and optionally `ablations() -> dict[str, RunConfig]`.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import re
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tflane_jax.config_files import find_config, is_shipped, split_reference
from tflane_jax.config_io import part_classes, with_setting
from tflane_jax.datasets.argoverse2 import LogData
from tflane_jax.datasets.front_views import FrontViewData
from tflane_jax.datasets.nuscenes import NuScenesData
from tflane_jax.datasets.nuscenes_scenes import SceneFileData
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Data
from tflane_jax.datasets.procedural import WorldData
from tflane_jax.datasets.real_maps import RealMapData
from tflane_jax.datasets.recorded_logs import RecordedData
from tflane_jax.datasets.sources import data_classes, when_added
from tflane_jax.datasets.tusimple import TuSimpleData
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.layers.precision import Precision
from tflane_jax.limits import Rules, SettingError, check_settings, forget_types
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.own_modules import import_file
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.restarts import doubling_cycles
from tflane_jax.training.schedule import OptimConfig, warmup_fits

if TYPE_CHECKING:
    from tflane_jax.datasets.data_source import SplitData as Data
else:
    Data = data_classes()  # at runtime, the union of all data classes, for JSON and overrides

    @when_added
    def _take_added_classes() -> None:
        globals()["Data"] = data_classes()
        forget_types()


T = TypeVar("T")
_STEP_COUNTS = ("steps", "eval_every", "checkpoint_every")  # of `TrainingConfig`
_RUNNING = set[tuple[Path, str]]()  # functions of configuration files, with their files
_RESULTS: ContextVar[dict[tuple[Path, str], Any] | None] = ContextVar("results", default=None)  # of `loaded_once`
# Configuration files import data classes from here or from their dataset's file.
__all__ = [
    "EvaluationConfig",
    "FrontViewData",
    "LogData",
    "NuScenesData",
    "OpenLaneV2Data",
    "RealMapData",
    "RecordedData",
    "RunConfig",
    "SceneFileData",
    "TuSimpleData",
    "WorldData",
    "load_ablations",
    "load_config",
]


@dataclass(frozen=True)
class RunConfig:
    """Complete configuration of a run.

    Attributes:
        task: model, priors and losses.
        data: examples of each split, of the task's type; one of the classes of `datasets.sources`.
        optim: optimizer and schedule.
        training: the training program.
        evaluation: metrics and pictures.
        weights: file of published PyTorch weights, or their name (`convert.weights_files`), with which `tflane predict`
            and `eval` can use the configuration.
    """

    task: LaneGraphTask | LaneShapeTask = LaneGraphTask()
    data: Data = WorldData()
    optim: OptimConfig = OptimConfig()
    training: TrainingConfig = TrainingConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    weights: Path | None = None

    def limits(self) -> Rules:
        """The warm-up ends before the run does."""
        yield warmup_fits(self.optim, self.training.steps)

    def chosen_by(self, source: Any) -> bool:
        """Return whether the best of a run's checkpoints is chosen by the examples of this source."""
        return self.training.steps > self.training.eval_every and self.data.source("val") == source


def load_config(reference: str) -> RunConfig:
    """Return a configuration: `path.py`, a shipped one (`tf_lane/toponet_tfm`), or an ablation of either (`...:name`).

    Raises:
        UserError: no such file, name, function or ablation, an exception inside the file, or a setting that breaks a
            limit (both named with the line).
    """
    with loaded_once():
        return _load_config(*split_reference(reference))


@contextlib.contextmanager
def loaded_once() -> Iterator[None]:
    """Run a function of a configuration file once within this block, however many configurations build on it."""
    token = _RESULTS.set({}) if _RESULTS.get() is None else None
    try:
        yield
    finally:
        if token is not None:
            _RESULTS.reset(token)


def _load_config(name: str, ablation: str) -> RunConfig:
    if not ablation:
        config = _run_function(find_config(name), "get_config", RunConfig)
        return _checked(find_config(name), with_reference_batch(config, config))
    ablations = load_ablations(name)
    if odd := [key for key in ablations if not isinstance(key, str)]:
        raise UserError(f"config file {name}: ablations() has the name {odd[0]!r}; names are text")
    if ablation not in ablations:
        close = difflib.get_close_matches(ablation, ablations, 3)
        raise UserError(
            f"config file {name} has no ablation {ablation}, only {', '.join(ablations)}{_did_you_mean(close)}"
        )
    config = ablations[ablation]
    if not isinstance(config, RunConfig):
        raise UserError(f"ablation {ablation} of config file {name} is a {type(config).__name__}, not a RunConfig")
    return _checked(find_config(name), with_reference_batch(config, config))


def with_reference_batch(config: RunConfig, chosen: RunConfig) -> RunConfig:
    """Return a configuration with `optim.reference_batch`: the batch size of `chosen`, for which its rate was chosen.

    Unchanged without `optim.lr_scaling`, or where the setting is given.
    """
    if not (isinstance(config.optim, OptimConfig) and isinstance(chosen.training, TrainingConfig)):
        return config  # of a file; its check names the type
    if config.optim.lr_scaling == "none" or config.optim.reference_batch is not None:
        return config
    optim = dataclasses.replace(config.optim, reference_batch=chosen.training.batch_size)
    return dataclasses.replace(config, optim=optim)


def with_same_examples(config: RunConfig, chosen: RunConfig, given: Collection[str] = ()) -> RunConfig:
    """Return a configuration that trains on as many examples as the one whose numbers were chosen for its batch.

    With `training.same_examples`, the settings of `with_step_counts` are divided by the ratio of the batch sizes and
    rounded up; whole epochs (`optim.epoch_steps`) stay whole. `training.log_every` and the warm-up stay. Cycles that
    are to fill the run (`optim.restarts.last_cycle` "fit") keep their part of what follows the warm-up, rounded down,
    so that as many fit as before. Without it nothing changes.

    Args:
        config: with the batch size to train with.
        chosen: the same configuration before its batch size was changed.
        given: names of settings, or of parts, that stay as they are.
    """
    before, after = chosen.training.batch_size, config.training.batch_size
    if not config.training.same_examples or before == after:
        return config

    def stays(name: str) -> bool:
        return any(name == one or name.startswith(f"{one}.") for one in given)

    def divided(number: int) -> int:
        return -(-number * before // after)

    epoch = chosen.optim.epoch_steps
    new_epoch = config.optim.epoch_steps if stays("optim.epoch_steps") else divided(epoch)

    def change(name: str, number: int) -> int:
        if stays(name):
            return number
        is_whole_epochs = epoch > 0 and new_epoch > 0 and number % epoch == 0
        return number // epoch * new_epoch if is_whole_epochs else divided(number)

    changed, restarts, warmup = with_step_counts(config, change), config.optim.restarts, config.optim.warmup_steps
    if restarts is None or restarts.last_cycle == "cut" or stays("optim.restarts.cycle_steps"):
        return changed
    old_steps, new_steps = chosen.training.steps, changed.training.steps
    if min(old_steps, new_steps) <= warmup:  # an error, told where the schedule is made
        return changed
    cycle_steps = max(restarts.cycle_steps * (new_steps - warmup) // (old_steps - warmup), 1)
    return with_setting(changed, "optim.restarts.cycle_steps", cycle_steps)


def with_step_counts(config: RunConfig, change: Callable[[str, int], int]) -> RunConfig:
    """Return a configuration with other numbers of updates; `change` takes the name of a setting and its value.

    These are `steps`, `eval_every` and `checkpoint_every` of `training`, `epoch_steps`, `drops.steps` and
    `restarts.cycle_steps` of `optim`. `log_every` and the warm-up are not among them.
    """
    training, optim = config.training, config.optim
    counts = {name: change(f"training.{name}", getattr(training, name)) for name in _STEP_COUNTS}
    drops, restarts = optim.drops, optim.restarts
    if drops is not None:
        drops = dataclasses.replace(drops, steps=tuple(change("optim.drops.steps", step) for step in drops.steps))
    if restarts is not None:
        cycle_steps = change("optim.restarts.cycle_steps", restarts.cycle_steps)
        restarts = dataclasses.replace(restarts, cycle_steps=cycle_steps)
    epoch_steps = change("optim.epoch_steps", optim.epoch_steps)
    optim = dataclasses.replace(optim, epoch_steps=epoch_steps, drops=drops, restarts=restarts)
    return dataclasses.replace(config, training=dataclasses.replace(training, **counts), optim=optim)


def load_ablations(name: str) -> dict[str, RunConfig]:
    """Return the ablations of a config file or shipped configuration; raises UserError where it has none.

    Their settings are not checked; `load_config` does that for one of them.
    """
    return dict(_run_function(find_config(name), "ablations", dict))


def with_priors_of(other: RunConfig, config: RunConfig) -> RunConfig:
    """Return a configuration whose host has the priors of the host of another one."""
    if not isinstance(other.task, LaneGraphTask) or not isinstance(config.task, LaneGraphTask):
        raise UserError("only models of lanes around the vehicle have priors")
    return with_setting(config, "task.model.priors", other.task.model.priors)


def with_remat(config: RunConfig, precision: Precision = "float32") -> RunConfig:
    """Return a configuration whose camera encoder recomputes activations in the backward pass, in some precision."""
    if not isinstance(config.task, LaneGraphTask) or not isinstance(config.task.model.encoder, CameraEncoderConfig):
        raise UserError("only models with a camera encoder have its settings remat and precision")
    for part in ("task.model.encoder.images", "task.model.encoder.bev"):
        config = with_setting(with_setting(config, f"{part}.remat", True), f"{part}.precision", precision)
    return config


def epochs_of(config: RunConfig) -> int:
    """Return the number of epochs of `optim.epoch_steps` updates that a configuration trains for."""
    return config.training.steps // config.optim.epoch_steps


def with_epochs(config: RunConfig, epochs: int) -> RunConfig:
    """Return a configuration that trains for another number of epochs, each of `optim.epoch_steps` updates."""
    steps = epochs * config.optim.epoch_steps
    if steps == 0:
        raise UserError("optim.epoch_steps is 0: the configuration does not say how long an epoch is")
    return dataclasses.replace(config, training=dataclasses.replace(config.training, steps=steps))


def with_restarts(config: RunConfig, *, cycles: int = 3) -> RunConfig:
    """Return a run with the GTN paper's Eq. (2) and the adaptive rule as its schedule, see `doubling_cycles`."""
    optim = config.optim
    restarts = doubling_cycles(config.training.steps, warmup_steps=optim.warmup_steps, cycles=cycles)
    return dataclasses.replace(config, optim=dataclasses.replace(optim, drops=None, restarts=restarts))


def _run_function(path: Path, function: str, kind: type[T]) -> T:
    """Run a config file and return the result of one of its functions."""
    if path.suffix != ".py":
        raise UserError(f"config file {path} is no Python file (.py)")
    with _named_errors(path):
        module = import_file(path, beside=not is_shipped(path))
    if not hasattr(module, function):
        raise UserError(f"config file {path} has no function {function}()")
    results, key = _RESULTS.get(), (path.resolve(), function)
    if results is not None and key in results:
        return results[key]
    if key in _RUNNING:
        raise UserError(f"config file {path} loads itself")
    _RUNNING.add(key)
    try:
        with _named_errors(path):
            value = getattr(module, function)()
    finally:
        _RUNNING.remove(key)
    if not isinstance(value, kind):
        raise UserError(f"{function}() in config file {path} gave a {type(value).__name__}, not a {kind.__name__}")
    if results is not None:
        results[key] = value
    return value


@contextlib.contextmanager
def _named_errors(path: Path):
    try:
        yield
    except (Exception, SystemExit) as error:
        own = str(path.resolve())  # as `import_file` does
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else "?"
        if (
            unknown := re.search(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'", str(error))
        ) is None:
            raise UserError(f"config file {path}, line {line}: {type(error).__name__}: {error}") from error
        kind, name = unknown.groups()
        known = [field.name for field in dataclasses.fields(part_classes(RunConfig).get(kind, RunConfig))]
        hint = _did_you_mean(difflib.get_close_matches(name, known, 3, 0.5))
        raise UserError(f"config file {path}, line {line}: {kind} has no setting {name}{hint}") from error


def _checked(path: Path, config: RunConfig) -> RunConfig:
    """Return the configuration that a file gave; raise UserError, with file and line, if it breaks a limit."""
    try:
        check_settings(config)
    except SettingError as error:
        own = "; an own dataset is added by datasets.sources.add_source" if error.setting == "data" else ""
        raise UserError(f"config file {path}{_lines_of(path, error)}: {error}{own}") from error
    return config


def _lines_of(path: Path, error: SettingError) -> str:
    """Return the lines of a file that set a setting, in words for an error; "" if none can be identified."""
    name = re.sub(r"\[\d+\]$", "", error.setting).rpartition(".")[2]
    given = [k for k in ast.walk(ast.parse(path.read_bytes())) if isinstance(k, ast.keyword) and k.arg == name]
    written = [k for k in given if ast.unparse(k.value) == error.shown] or given
    return f", line {' or '.join(str(k.lineno) for k in written)}" if written else ""


def _did_you_mean(close: Sequence[str]) -> str:
    return f"; did you mean {' or '.join(close)}?" if close else ""

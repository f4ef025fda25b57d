"""`tflane eval`."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

from tflane_jax.commands.chosen_evaluation import evaluation_suffix, with_chosen_evaluation
from tflane_jax.commands.outputs import check_table
from tflane_jax.commands.sources import data_name, limited_task, opened, source_for
from tflane_jax.config_io import to_json
from tflane_jax.datasets import sources
from tflane_jax.datasets.base import spread
from tflane_jax.datasets.front_views import FrontViewConfig, FrontViewDataset
from tflane_jax.datasets.overlap import Nearness
from tflane_jax.errors import UserError
from tflane_jax.evaluation.edge_types import has_edge_weights
from tflane_jax.evaluation.interventions import with_traffic
from tflane_jax.evaluation.lane_errors import lane_errors
from tflane_jax.evaluation.predict import undivided_notices
from tflane_jax.plots.tables import FRACTIONS, PERCENT, format_table, save_table, written_to
from tflane_jax.runs import Run, evaluate_run
from tflane_jax.scene import stack_examples
from tflane_jax.startup import showing, stage
from tflane_jax.tasks.base import Model
from tflane_jax.tasks.edge_types import save_edge_types
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask
from tflane_jax.training.notices import print_notices
from tflane_jax.training.runtime import configure_jax
from tflane_jax.training_nearness import training_nearness

_IMAGES = 8  # over which a HAN's weights are averaged


def run(options: argparse.Namespace) -> int:
    """Evaluate, print the table, and write it as Markdown and JSON."""
    if options.out is not None:
        check_table(options.out)  # before the evaluation, which takes minutes
    configure_jax()
    trained, rest = opened(options)
    if rest:
        raise UserError(f"tflane eval takes one run: leave {rest[0]} out")
    own = trained.config.evaluation
    trained = with_chosen_evaluation(trained, options)
    evaluation = trained.config.evaluation
    if options.errors and not _predicts_lanes(trained.config.task):
        raise UserError("--errors needs a model that predicts centerlines or lane segments")
    source = source_for(trained, options)
    near = _nearness(trained, source, options.training_root)
    groups = _weather(source) if near is None else near.groups
    task = limited_task(trained, options)
    name = f"{data_name(source, options)}-step{trained.step}"
    if options.max_instances is not None:
        name += f"-max_instances{options.max_instances}"
    name += evaluation_suffix(evaluation, own)
    # Published weights have no run folder: theirs are distinguished by name.
    of_weights = Path("runs") / "evaluations" / f"{Path(trained.name).stem}-{name}"
    stem = options.out or (of_weights if options.config else Path(trained.name) / "evaluations" / name)
    check_table(stem)
    print_notices(undivided_notices(task or trained.config.task, evaluation.batch_size))
    protocol, rows = evaluate_run(trained, source, task=task, frame_groups=groups)
    title = f"{trained.name}, {name}: {protocol}"
    meta = {
        "run": trained.name,
        "step": trained.step,
        "protocol": protocol,
        "max_instances": options.max_instances,
        "traffic": evaluation.traffic,
        "topology": evaluation.topology,
        "source": to_json(source),
        "near_training": None if near is None else near.sentence(),
        "unit": FRACTIONS,
    }
    paths = list(save_table(stem, rows, meta, title=title))  # before anything is printed, which may fail
    print(format_table(rows, title=title))
    counts = [row[kind] for row in rows for kind in ("lanes", "lines") if kind in row]
    if counts and not any(counts):
        print(f"tflane: warning: {name} has no true lane: scores are those of an empty truth", file=sys.stderr)
    if near is not None:
        print(f"\n{near.sentence()}")
    if trained.chosen and trained.config.chosen_by(source):
        print(
            f"\nStep {trained.step} was chosen as the best one by these examples: its scores are too good by chance, "
            "those of --checkpoint last are not."
        )
    paths += _save_edge_types(trained, source, stem)
    if options.errors:
        paths += _save_errors(trained, task or trained.config.task, source, stem, meta)
    print(f"\n{written_to(paths)}")
    return 0


def _predicts_lanes(task: Any) -> bool:
    return isinstance(task, LaneGraphTask) and not {"centerlines", "segments"}.isdisjoint(task.model.predicts)


def _save_errors(run: Run, task: Any, source: Any, stem: Path, meta: dict[str, Any]) -> list[Path]:
    """Print and write why lanes are not found, in percent of the true lanes and of the detections of each seed."""
    arrays = with_traffic(task.load(source, progress=False), run.config.evaluation.traffic)
    rows: list[dict[str, Any]] = []
    for seed, params in zip(run.config.training.seeds, run.params, strict=True):
        with showing(True), stage("counting errors of lanes"):
            errors = lane_errors(task, params, arrays, run.config.evaluation.batch_size)
        confidence = errors.threshold if math.isfinite(errors.threshold) else None  # no detection finds a lane
        for name, counts in (("true lanes", errors.lanes), ("detections", errors.detections)):
            every = sum(counts.values())
            fractions = {outcome: 100.0 * number / every if every else 0.0 for outcome, number in counts.items()}
            rows.append({"of": name, "seed": seed, "number": every, "confidence": confidence} | fractions)
    title = "why lanes are not found, percent; detections with at least the confidence of the best F-score"
    paths = list(save_table(stem.with_name(f"{stem.name}-errors"), rows, meta | {"unit": PERCENT}, title=title))
    print(f"\n{format_table(rows, title=title)}")
    return paths


def _save_edge_types(run: Run, source: Any, stem: Path) -> list[Path]:
    """Write which edge types the graph encoder of each seed uses, for models that have one."""
    task = run.config.task
    if not isinstance(task, LaneShapeTask) or not has_edge_weights(task.model):
        return []
    dataset, seeds = sources.open_dataset(source), run.config.training.seeds
    examples = stack_examples([dataset.example(index) for index in spread(len(dataset), _IMAGES)])
    models = {f"seed {seed}": Model(task, params) for seed, params in zip(seeds, run.params, strict=True)}
    return save_edge_types(models, examples, stem.with_name(f"{stem.name}-edge_types"))


def _weather(source: Any) -> list[str]:
    """Return the weather of each image of the built-in world's front views; other data do not name theirs."""
    if not isinstance(source, FrontViewConfig):
        return []
    dataset = FrontViewDataset(source)
    return [dataset.weather(index) for index in range(len(dataset))]


def _nearness(run: Run, source: Any, root: Path | None) -> Nearness | None:
    """Return how far the examples are from the training frames; None if that is unknown and no `root` is given."""
    if root is not None:
        if (found := training_nearness(run.config, source, root)) is None:
            raise UserError(f"{root}: no training frame is in a city of the evaluated frames")
        return found
    try:
        return training_nearness(run.config, source)
    except UserError as error:
        print(f"no groups by distance to training frames, whose files are needed for that: {error}", file=sys.stderr)
        return None

"""Pictures of a comparison of lane-graph models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Bool

from tflane_jax.datasets import sources
from tflane_jax.datasets.base import Dataset, spread
from tflane_jax.datasets.batches import ordered_batches
from tflane_jax.datasets.data_source import LaneGraphSource
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.errors import UserError
from tflane_jax.evaluation.found_lanes import (
    LINE_WITHIN,
    WITHIN,
    best_threshold,
    confidences_of,
    detection_scores,
    frames_of_difference,
)
from tflane_jax.evaluation.interventions import example_scenes
from tflane_jax.evaluation.lane_groups import lane_groups, line_groups
from tflane_jax.evaluation.predict import FOR_PICTURES, predict_examples, predicted_batches
from tflane_jax.scene import Example, LaneGraph, LanePrediction, MapLines, Prediction, stack_examples
from tflane_jax.tasks.base import Model

Group = Literal["hidden+traffic", "occluded"]
Field = Literal["lanes", "segments", "map_lines"]
_MEANING: dict[Group, str] = {
    "hidden+traffic": "that the sensor hardly shows and vehicles drove along",
    "occluded": "of which less than half is in line of sight",
}
_groups_of: Mapping[type, Callable[..., Mapping[str, np.ndarray]]] = {LaneGraph: lane_groups, MapLines: line_groups}
_FRAMES = 4
_FRAMES_OF_ONE_MODEL = 6
_BATCH = 16
# Characters of a scene's name in a title.
_LONGEST_NAME = 20


def draw_examples(
    model: Model, source: LaneGraphSource, dataset: Dataset, indices: list[int], folder: Path, step: int
) -> None:
    """Write pictures of some examples to a folder, from above and, where there are any, in their camera images."""
    from tflane_jax.plots import save_camera_views, save_examples

    examples, answer = _predicted(model, dataset, indices)
    found = answer.lanes
    path, names = folder / f"step_{step:08d}.png", titles(dataset, indices)
    ground, view = source.example.ground, source.example.range
    save_examples(path, examples, {f"step {step}": found}, titles=names, ground=ground, view=view)
    if examples.cameras is not None:
        path = path.with_stem(f"{path.stem}_cameras")
        save_camera_views(path, examples, found, answer.elements, titles=names, ground=ground, view=view)


def _predicted(model: Model, dataset: Dataset, indices: Sequence[int]) -> tuple[Example, Prediction]:
    """Return some examples and the predictions for them, by the program of the model's evaluation."""
    task, size = model.task, model.batch_size
    return predict_examples(task, model.params, dataset, indices, batch_size=size, parts=task.parts, what=FOR_PICTURES)


def draw_hidden_lanes(
    models: Mapping[str, Model], source: LaneGraphSource, data: Example | Streamed, path: Path
) -> Path:
    """Draw the frames with the most occluded lanes, every model beside the truth; frames spread evenly if streamed."""
    from tflane_jax.plots import save_examples

    dataset = sources.open_dataset(source)
    field = truth_field(next(iter(models.values())))
    if isinstance(data, Streamed):
        indices = spread(len(data), _FRAMES_OF_ONE_MODEL)
    else:
        lanes = getattr(data, field)
        hidden = (lanes.valid & _occluded(lanes)).sum(-1)
        indices = np.argsort(-hidden, kind="stable")[:_FRAMES_OF_ONE_MODEL].tolist()
    examples = stack_examples([dataset.example(index) for index in indices])
    found = {name: _predicted(model, dataset, indices)[1].lanes for name, model in models.items()}
    ground, view = source.example.ground, source.example.range
    return save_examples(path, examples, found, titles=titles(dataset, indices), ground=ground, view=view)


@dataclass(frozen=True)
class _Answers:
    """One model on all F frames of a split.

    Attributes:
        found: (F, G) true lanes that the model finds, by row of the padded truth.
        threshold: lowest confidence that counts.
        lanes: predictions, stacked.
    """

    found: Bool[np.ndarray, "f g"]
    threshold: float
    lanes: LanePrediction


def draw_differences(
    models: Mapping[str, Model], source: LaneGraphSource, data: Example | Streamed, path: Path, group: Group
) -> Path:
    """Draw the frames in which the first two models differ most, and outline the lanes that only one of them finds.

    All models predict the whole split once. `evaluation.found_lanes` says which lanes are found and which frames are
    drawn. Lanes are merged centerlines, or segments or lines of a vector map where the models predict these.

    Args:
        models: by name, at least two.
        source, data: of the split; the data as the first model reads them.
        path: of the picture.
        group: the lanes that are counted and outlined: `hidden+traffic` of `evaluation.lane_groups`, for examples with
            BEV evidence and traffic flow; or lanes of which less than half is in line of sight.

    Raises:
        UserError: the models predict lanes of different kinds, or lines of a vector map that the data do not label.
    """
    from tflane_jax.plots import Findings, save_differences

    parts, answers = next(iter(models.values())).task.parts, {}
    fields: list[Field] = sorted({truth_field(model) for model in models.values()})
    if len(fields) > 1:
        raise UserError("these models predict lanes of different kinds: compare hosts of one kind")
    field = fields[0]
    lanes = "lines" if field == "map_lines" else "lanes"
    if field == "map_lines" and source.example.map_lines is None:
        raise UserError("these examples label no lines of a vector map: set data.example.map_lines")
    for name, model in models.items():
        mine = data if model.task.parts == parts else model.task.load(source, progress=False)
        answers[name] = _answers(model, mine, field)
    first, second = list(answers)[:2]
    kinds = min(np.shape(one.lanes.logits)[-1] for one in answers.values())
    members = _members(data, source, group, field, kinds)
    by_first, by_second = (members & answers[name].found for name in (first, second))
    alone = {first: by_first & ~by_second, second: by_second & ~by_first}
    frames = frames_of_difference(alone[first].sum(1), alone[second].sum(1), example_scenes(data), _FRAMES)
    ahead = dict(zip((first, second), frames, strict=True))
    chosen = [*ahead[second], *ahead[first]] or np.argsort(-members.sum(1), kind="stable")[:_FRAMES].tolist()

    dataset = sources.open_dataset(source)
    only = ", ".join(f"only {name} {alone[name].sum()}" for name in (second, first))
    return save_differences(
        path,
        stack_examples([dataset.example(index) for index in chosen]),
        {
            name: Findings(jax.tree.map(lambda leaf: leaf[chosen], one.lanes), one.threshold, one.found[chosen])
            for name, one in answers.items()
        },
        (alone[first] | alone[second])[chosen],
        title=f"Of {members.sum()} {lanes} {_MEANING[group]}, both models find {(by_first & by_second).sum()}, {only}",
        caption=_caption(answers, {name: ahead[name] for name in (second, first)}, len(members), field),
        meaning=f"{lanes[:-1]} that only one of {first} and {second} finds",
        titles=titles(dataset, chosen),
        ground=source.example.ground,
        view=source.example.range,
    )


def _caption(answers: Mapping[str, _Answers], ahead: Mapping[str, Sequence[int]], frames: int, field: Field) -> str:
    """Return the rules by which the frames were chosen and the lanes found."""
    rows = [f"the {len(rows)} in which {name} is ahead the most" for name, rows in ahead.items() if rows]
    chosen = " and ".join(rows) + ", in the ratio of the lanes that only they find (for each, one frame of a scene)"
    chosen = chosen if rows else "those with the most such lanes, because no model is ahead in any"
    within = LINE_WITHIN if field == "map_lines" else WITHIN
    levels = ", ".join(f"{one.threshold:.2f} ({name})" for name, one in answers.items())
    return (
        f"Of {frames} frames, {chosen}.\nFound: within {within:g} m of a drawn prediction. Drawn: predictions with at "
        f"least the confidence of the model's best F-score, {levels}."
    )


def _answers(model: Model, data: Example | Streamed, field: Field) -> _Answers:
    """Return what a model predicts for a whole split."""
    confidences, valid, lanes, scores = [], [], [], []
    for indices, batch, answer in predicted_batches(
        model.task, model.params, data, model.batch_size, what=FOR_PICTURES
    ):
        lanes.append(answer.lanes)
        scores.append(detection_scores(lanes[-1]))
        for row in range(len(indices)):
            truth, found = jax.tree.map(lambda leaf, i=row: np.asarray(leaf[i]), (getattr(batch, field), lanes[-1]))
            confidences.append(confidences_of(truth, found))
            valid.append(truth.valid)
    stacked: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves), *lanes)
    found = np.stack(confidences)
    threshold = best_threshold([found[np.stack(valid)]], [np.concatenate(scores).ravel()])
    return _Answers(found >= threshold, threshold, stacked)


def _members(
    data: Example | Streamed, source: LaneGraphSource, group: Group, field: Field, kinds: int
) -> Bool[np.ndarray, "f g"]:
    """Return which true lanes, by row of the padded truth, belong to the group; of lines, the first `kinds` classes."""
    every = []
    for indices, batch in ordered_batches(data, _BATCH):
        for row in range(len(indices)):
            lanes, bev, flow = jax.tree.map(
                lambda leaf, i=row: np.asarray(leaf[i]), (getattr(batch, field), batch.bev, batch.traffic_flow)
            )
            if group == "occluded":
                members = lanes.valid & _occluded(lanes)
            else:
                members = np.zeros(len(lanes.valid), bool)
                members[lanes.valid] = _groups_of[type(lanes)](lanes, bev, flow, source.example.ground)[group]
            every.append(members & (lanes.category < kinds) if isinstance(lanes, MapLines) else members)
    return np.stack(every)


def _occluded(lanes: LaneGraph | MapLines) -> Bool[np.ndarray, "*b n"]:
    """Return which lanes are out of sight along more than half of their length; none where it is not known."""
    return np.zeros(lanes.valid.shape, bool) if lanes.visibility is None else np.asarray(lanes.visibility) < 0.5


def truth_field(model: Model) -> Field:
    """Return the field of `Example` that holds the truth of what `Prediction.lanes` is for this model."""
    host: Any = getattr(model.task, "model", None)
    predicts = () if host is None else host.predicts
    if "lines" in predicts and "segments" not in predicts and "centerlines" not in predicts:
        return "map_lines"
    return "segments" if "segments" in predicts else "lanes"


def titles(dataset: Dataset, indices: list[int]) -> list[str]:
    """Return a title for the picture of each example."""
    infos = [dataset.info(index) for index in indices]
    return [f"{_shortened(info.scene)} at {info.timestamp_ns / 1e9:.1f} s" for info in infos]


def _shortened(name: str) -> str:
    """Return a scene's name as a title has room for it: the ids of logs have 36 characters."""
    return name if len(name) <= _LONGEST_NAME else f"{name[:8]}…{name[-5:]}"

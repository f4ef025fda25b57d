"""Interventions on the examples that a trained model sees: what does it predict with other traffic flow, or none?"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from tflane_jax.datasets.base import FrameInfo, IndexedExamples
from tflane_jax.datasets.streaming import Streamed
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import scene_numbers
from tflane_jax.evaluation.results import EvaluationConfig, Traffic
from tflane_jax.scene import Example, TrafficFlow

NO_TRAFFIC = "no traffic flow at inference"
"""Name of the intervention in which a model that was trained with traffic flow gets none."""
OTHER_TRAFFIC = "traffic of another scene"
"""Name of the intervention in which it gets that of another scene."""
INTERVENTIONS = (NO_TRAFFIC, OTHER_TRAFFIC)
_SEED = 0


def with_traffic(arrays: Example | Streamed, traffic: Traffic) -> Example | Streamed:
    """Return the examples with other traffic flow, and everything else unchanged.

    Scenes exchange their traffic by one fixed permutation, drawn at random, in which no scene gets its own. The frames
    of a scene get those of the other scene in order, from the beginning again if it has fewer.

    Args:
        arrays: examples, stacked or streamed, the frames of a scene in succession.
        traffic: which traffic flow; "own" returns `arrays` itself.

    Raises:
        UserError: the examples have no traffic flow; or "other-scene" with fewer than two scenes.
    """
    if traffic == "own":
        return arrays
    if isinstance(arrays, Streamed):
        return replace(arrays, dataset=dataset_with_traffic(arrays.dataset, traffic))
    rows = other_scene_rows(example_scenes(arrays)) if traffic == "other-scene" else None
    flow = _flow(arrays)
    return replace(arrays, traffic_flow=_none(flow) if rows is None else jax.tree.map(lambda leaf: leaf[rows], flow))


def dataset_with_traffic(dataset: IndexedExamples, traffic: Traffic) -> IndexedExamples:
    """Return a dataset whose examples have other traffic flow, like `with_traffic`."""
    if traffic == "own":
        return dataset
    return _Changed(dataset, other_scene_rows(_scenes_of(dataset)) if traffic == "other-scene" else None)


def traffic_interventions(arrays: Example | Streamed, config: EvaluationConfig) -> dict[str, EvaluationConfig]:
    """Return by name the evaluations without traffic flow, and with that of another scene if there are several scenes.

    Empty for an evaluation that is an intervention itself.
    """
    if config.traffic != "own":
        return {}
    found = {NO_TRAFFIC: replace(config, traffic="none")}
    if len(np.unique(example_scenes(arrays))) > 1:
        found[OTHER_TRAFFIC] = replace(config, traffic="other-scene")
    return found


def example_scenes(arrays: Example | Streamed) -> Int[np.ndarray, " n"]:
    """Return the number of each example's scene, 0 for the first."""
    if isinstance(arrays, Streamed):
        return _scenes_of(arrays.dataset)
    return scene_numbers(np.asarray(arrays.has_previous).tolist())


def _scenes_of(dataset: IndexedExamples) -> Int[np.ndarray, " n"]:
    names = [dataset.info(index).scene for index in range(len(dataset))]
    return scene_numbers([name == before for before, name in zip([None, *names], names, strict=False)])


def other_scene_rows(scene: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return for each example the index of the example whose traffic it gets; see `with_traffic`.

    Args:
        scene: number of each example's scene, ascending from 0 without gaps.
    """
    first, size = np.unique(scene, return_index=True, return_counts=True)[1:]
    if len(first) < 2:
        raise UserError("traffic of another scene needs test data with at least two scenes")
    # One cycle through all scenes: no scene gets its own.
    order = np.random.default_rng(_SEED).permutation(len(first))
    giver = np.empty_like(order)
    giver[order] = np.roll(order, 1)
    giver = giver[scene]
    return first[giver] + (np.arange(len(scene)) - first[scene]) % size[giver]


class _Changed:
    """A dataset whose examples get the traffic of others, `rows` by index, or none."""

    def __init__(self, dataset: IndexedExamples, rows: Int[np.ndarray, " n"] | None):
        self.name, self.dataset, self.rows = dataset.name, dataset, rows

    def __len__(self) -> int:
        return len(self.dataset)

    def example(self, index: int) -> Example:
        example: Any = self.dataset.example(index)
        if self.rows is None:
            return replace(example, traffic_flow=_none(_flow(example)))
        other: Any = self.dataset.example(int(self.rows[index]))
        return replace(example, traffic_flow=_flow(other))

    def info(self, index: int) -> FrameInfo:
        return self.dataset.info(index)


def _flow(example: Example) -> TrafficFlow:
    if example.traffic_flow is None:
        raise UserError("these examples have no traffic flow, so none can be taken away or exchanged")
    return example.traffic_flow


def _none(flow: TrafficFlow) -> TrafficFlow:
    return replace(flow, valid=np.zeros_like(flow.valid))

"""The kinds of task and what the program around the training loop knows of each."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from tflane_jax.tasks.base import Evaluation, Model, System, spread
from tflane_jax.tasks.lane_shape import LaneShapeTask

if TYPE_CHECKING:
    from tflane_jax.config import RunConfig

__all__ = ["Evaluation", "Model", "System", "load_test_data", "spread", "system_of"]


def system_of(config: RunConfig) -> System:
    """Return the system that a configuration's task belongs to."""
    # Imported here, because each brings its own data and metrics along.
    if isinstance(config.task, LaneShapeTask):
        from tflane_jax.tasks.lane_shape_system import LaneShapeSystem

        return LaneShapeSystem()
    from tflane_jax.tasks.lane_graph_system import LaneGraphSystem

    return LaneGraphSystem()


def load_test_data(config: RunConfig) -> Any:
    """Return the examples of a configuration's test split; the last ones asked for stay in memory."""
    return _loaded(config.data.source("test"), type(system_of(config)))


@functools.lru_cache(maxsize=1)
def _loaded(source: Any, system: type[System]) -> Any:
    return system().load(source)

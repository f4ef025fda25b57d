"""Published PyTorch weights for any task that can use them."""

from __future__ import annotations

from pathlib import Path

from tflane_jax.convert.hosts import PublishedHost, load_host
from tflane_jax.convert.lstr import load_lstr
from tflane_jax.errors import UserError
from tflane_jax.models.parameters import Params
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask


def load_weights(path: Path, task: LaneShapeTask | LaneGraphTask) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters from a checkpoint of its reference, and an account of the file's tensors.

    Raises:
        UserError: the file cannot be read, or its tensors are not exactly those of the model.
    """
    if isinstance(task, LaneShapeTask):
        return load_lstr(path, task.model)
    if not isinstance(task.model, PublishedHost):
        raise UserError(f"no published weights are known for a {type(task.model).__name__}")
    return load_host(path, task.model)

"""Published PyTorch weights for any task that can use them."""

from __future__ import annotations

from pathlib import Path

from tflane_jax.convert.fitting import Missing
from tflane_jax.convert.hosts import PublishedHost, load_host
from tflane_jax.convert.lstr import load_lstr
from tflane_jax.convert.weights_files import lane_graph_weights
from tflane_jax.errors import UserError
from tflane_jax.models.parameters import Params
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.tasks.lane_shape import LaneShapeTask


def load_weights(
    path: Path,
    task: LaneShapeTask | LaneGraphTask,
    missing: Missing = "left out",
    edge_weight: float | None = None,
    entry: str | None = None,
) -> tuple[Params, list[dict[str, str]]]:
    """Return a task's parameters from a checkpoint of its reference, and an account of the file's tensors.

    Args:
        path: the checkpoint.
        task: whose model takes them.
        missing: what becomes of parameters that the file may lack: of auxiliary heads, and of graph encoders.
        edge_weight: of the edge types that a GTN encoder selects, see `convert.lstr_graphs`; None for the default, 1.
        entry: path of the weights in the file, see `torch_file.read_checkpoint`.

    Raises:
        UserError: the file cannot be read, or its tensors are not exactly those of the model.
    """
    if isinstance(task, LaneShapeTask):
        return load_lstr(path, task.model, missing, 1.0 if edge_weight is None else edge_weight, entry)
    if edge_weight is not None:
        raise UserError(f"{path}: an edge weight applies to GTN encoders only, not to a {type(task.model).__name__}")
    if not isinstance(task.model, PublishedHost):
        raise UserError(f"{path}: no published weights are known for a {type(task.model).__name__}")
    return load_host(lane_graph_weights(path), task.model, missing, entry)

"""Table and picture of the edge types that models with a graph encoder use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tflane_jax.evaluation.edge_types import edge_types
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.tables import save_table
from tflane_jax.scene import RoadImage
from tflane_jax.tasks.base import Model


def save_edge_types(models: Mapping[str, Model], examples: RoadImage, stem: Path) -> list[Path]:
    """Write `<stem>.md`, `.json` and, with matplotlib, `.png`, and return their paths; none without such a model.

    Args:
        models: by name, of any task.
        examples: some images, over which weights that depend on the image are averaged.
        stem: of the files.
    """
    found = {}
    for name, model in models.items():
        network = getattr(model.task, "model", None)
        if isinstance(network, LstrConfig) and (one := edge_types(network, model.params, examples)) is not None:
            found[name] = one
    if not found:
        return []
    rows = [{"model": name} | row for name, one in found.items() for row in one.rows()]
    title = "Weights of the edge types that the encoder selects (GTN) or attends with (HAN, mean over images)"
    written = list(save_table(stem, rows, {"images": len(examples.image)}, title=title, digits=2))
    if can_draw():
        from tflane_jax.plots.edge_types import save_edge_types as save_picture

        written.append(save_picture(stem.with_name(f"{stem.name}.png"), found))
    return written

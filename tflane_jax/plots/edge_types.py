"""Weights of edge types as a picture: a row for each hop of each meta-path (channel), a column for each edge type."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tflane_jax.evaluation.edge_types import EdgeTypes
from tflane_jax.plots.figure import new_figure, save_figure


def save_edge_types(path: Path, found: Mapping[str, EdgeTypes]) -> Path:
    """Write a panel for each model, and return the path.

    Args:
        path: .png, .pdf or .svg.
        found: by the name of the model, at least one.
    """
    tallest = max(sum(layer.shape[0] * layer.shape[1] for layer in one.layers) for one in found.values())
    figure, axes = new_figure(1, len(found), panel=(4.4, 1.2 + 0.3 * tallest))
    for ax, (name, one) in zip(axes.flat, found.items(), strict=True):
        weights = np.concatenate([layer.reshape(-1, len(one.names)) for layer in one.layers])
        several = any(layer.shape[:2] != (1, 1) for layer in one.layers)
        labels = [
            f"layer {row['layer']}" + (f", hop {row['hop']}, channel {row['channel']}" if several else "")
            for row in one.rows()
        ]
        ax.imshow(weights, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
        for (i, j), weight in np.ndenumerate(weights):
            if np.isfinite(weight):
                best = weight == np.nanmax(weights[i])
                colour = "white" if weight > 0.5 else "black"
                ax.text(
                    j,
                    i,
                    f"{weight:.2f}",
                    ha="center",
                    va="center",
                    fontsize=7,
                    color=colour,
                    weight="bold" if best else "normal",
                )
        ax.set_xticks(range(len(one.names)), one.names, rotation=40, ha="right", fontsize=7)
        ax.set_yticks(range(len(labels)), labels, fontsize=7)
        ax.set_title(name, fontsize=9, loc="left")
    return save_figure(figure, path)

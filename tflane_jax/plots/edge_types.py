"""Weights of edge types as a picture: a row for each hop of each meta-path (channel), a column for each edge type."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tflane_jax.evaluation.edge_types import EdgeTypes
from tflane_jax.plots.figure import new_figure, save_figure


def save_edge_types(path: Path, found: Mapping[str, EdgeTypes]) -> Path:
    """Write a panel for each model, and return the path; the cell of an edge type that a hop is not offered is grey.

    Args:
        path: .png, .pdf or .svg.
        found: by the name of the model, at least one.
    """
    tallest = max(sum(layer.shape[0] * layer.shape[1] for layer in one.layers) for one in found.values())
    columns = [len(one.names) for one in found.values()]
    # Labels of rows take about four cells: cells are as wide in all panels.
    width = 0.5 * (sum(columns) + 4 * len(found))
    figure, axes = new_figure(1, len(found), panel=(width / len(found), 1.3 + 0.3 * tallest))
    axes[0, 0].get_gridspec().set_width_ratios(columns)
    for ax, (name, one) in zip(axes.flat, found.items(), strict=True):
        weights = np.concatenate([layer.reshape(-1, len(one.names)) for layer in one.layers])
        several = any(layer.shape[:2] != (1, 1) for layer in one.layers)
        labels = [
            f"layer {row['layer']}" + (f", hop {row['hop']}, channel {row['channel']}" if several else "")
            for row in one.rows()
        ]
        ax.set_facecolor("#d9d9d9")
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
    figure.supxlabel("weight of each edge type; the weights of a row sum to 1, bold: its largest", fontsize=8)
    return save_figure(figure, path)

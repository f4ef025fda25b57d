"""Detection rate and pose errors of fiducial markers over distance, beside the assumptions of the marker paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.plots.figure import new_figure, save_figure

# Standard deviation of the paper's forward error and of its yaw and pitch errors at 60 m, metres and degrees.
PAPER_DISTANCE, PAPER_FORWARD, PAPER_ANGLE = 60.0, 3.0, 2.0


def save_error_curves(path: Path, curves: dict[str, list[dict[str, Any]]], sigma_d: float) -> Path:
    """Draw rate, forward error and rotation error over distance, beside the paper's assumptions, and return the path.

    Args:
        path: .png, .pdf or .svg.
        curves: rows of `summarise` by name.
        sigma_d: of the paper's probability of detection exp(-d^2 / 2 sigma_d^2), metres.
    """
    figure, axes = new_figure(1, 4, panel=(3.6, 3.0))
    panels = (
        ("found", "detection rate"),
        ("forward m", "forward error, rms [m]"),
        ("rotation median", "rotation error, median [deg]"),
        ("wrong pose", "other pose nearer to the truth"),
    )
    far = np.linspace(0.0, PAPER_DISTANCE, 61)
    paper = {
        "found": np.exp(-0.5 * (far / sigma_d) ** 2),
        "forward m": PAPER_FORWARD * far / PAPER_DISTANCE,
        "rotation median": PAPER_ANGLE * far / PAPER_DISTANCE,
    }
    for ax, (key, label) in zip(axes.flat, panels, strict=True):
        for name, rows in curves.items():
            ax.plot([row["distance m"] for row in rows], [row[key] for row in rows], ".-", label=name)
        if key in paper:
            ax.plot(far, paper[key], "k--", label="the paper's assumption")
        ax.set_xlabel("distance [m]")
        ax.set_ylabel(label)
        ax.set_xlim(0.0, None)
        ax.set_ylim(0.0, None)
        ax.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7)
    return save_figure(figure, path)

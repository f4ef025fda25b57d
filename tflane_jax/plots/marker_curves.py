"""Detection rate and pose errors of fiducial markers over distance, beside the assumptions of the marker paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.plots import style
from tflane_jax.plots.figure import new_figure, save_figure

# Standard deviation of the paper's forward error and of its yaw and pitch errors at 60 m, metres and degrees.
PAPER_DISTANCE, PAPER_FORWARD, PAPER_ANGLE = 60.0, 3.0, 2.0
_LINES = (("-", "o"), ("--", "s"), ("-.", "^"), (":", "D"))


def save_error_curves(path: Path, curves: dict[str, list[dict[str, Any]]], sigma_d: float) -> Path:
    """Draw rate, forward error and rotation error over distance, beside the paper's assumptions, and return the path.

    Args:
        path: .png, .pdf or .svg.
        curves: rows of `summarise` by name.
        sigma_d: of the paper's probability of detection exp(-d^2 / 2 sigma_d^2), metres.
    """
    # Two rows, so that the text can be read where a page shows the whole picture.
    figure, axes = new_figure(2, 2, panel=(4.4, 2.7), footer=0.5)
    panels = (
        ("found", "found", "fraction of the boards"),
        ("forward m", "error along the line of sight", "rms [m]"),
        ("rotation median", "error of the rotation", "median [degrees]"),
        ("wrong pose", "the other of the two poses is nearer to the truth", "fraction of the detections"),
    )
    far = np.linspace(0.0, PAPER_DISTANCE, 61)
    paper = {
        "found": np.exp(-0.5 * (far / sigma_d) ** 2),
        "forward m": PAPER_FORWARD * far / PAPER_DISTANCE,
        "rotation median": PAPER_ANGLE * far / PAPER_DISTANCE,
    }
    assumed = f"the paper's assumption (found: sigma_d = {sigma_d:g} m)"
    for ax, (key, title, label) in zip(axes.flat, panels, strict=True):
        for number, (name, rows) in enumerate(curves.items()):
            # Boards found at one scale are the same for all corner methods: a later curve must not hide an earlier one.
            line, marker = _LINES[number % len(_LINES)]
            look = style.curve_style(number) | {"linestyle": line, "marker": marker}
            ax.plot([row["distance m"] for row in rows], [row[key] for row in rows], **look, ms=4, lw=1.3, label=name)
        if key in paper:
            ax.plot(far, paper[key], color="#777777", lw=3.0, alpha=0.5, label=assumed, zorder=1.0)
        ax.set_title(title, fontsize=9, loc="left")
        ax.set_ylabel(label, fontsize=8)
        ax.set_xlim(0.0, None)
        ax.set_ylim(0.0, None)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3, lw=0.5)
    for ax in axes[-1]:
        ax.set_xlabel("distance [m]", fontsize=8)
    figure.legend(
        handles=axes[0, 0].lines, loc="outside lower center", ncols=min(len(curves) + 1, 3), fontsize=8, frameon=False
    )
    return save_figure(figure, path)

"""Claims of recorded tables: treatment minus control with its interval, coloured by verdict."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.metrics.directions import unit_of
from tflane_jax.plots import style
from tflane_jax.plots.figure import new_figure, save_figure

_COLOURS = {"shown": style.SERIES[2], "contradicted": style.SERIES[5], "not shown": "#7a7a7a", "not tested": "#b5b5b5"}
_LABEL, _HEADING = 84, 92  # characters
_ROW = 0.2  # inches

Claim = Mapping[str, Any]


def save_claims(path: Path, claims: Mapping[str, Sequence[Claim]], headings: Mapping[str, tuple[str, str]]) -> Path:
    """Write a picture of claims, a line each, under the headings of their tables.

    A diamond is what the paper reports, where that is the same measure.

    Args:
        path: .png, .pdf or .svg.
        claims: of each table, as of `ablations.effect_records`; those without a difference are left out.
        headings: by name of the table, what may be shortened and what not.
    """
    from matplotlib.lines import Line2D

    lines: list[tuple[str, Claim | None]] = []
    for table, every in claims.items():
        if not (drawn := [claim for claim in every if claim["difference"] is not None]):
            continue
        heading, remark = headings[table]
        end = f" ({drawn[0]['measure']}){remark}"
        lines.append((textwrap.shorten(heading, _HEADING - len(end), placeholder="...") + end, None))
        for claim in drawn:
            label = f"{claim['treatment']}  vs.  {claim['control']}"
            lines.append((textwrap.shorten(label, _LABEL, placeholder="..."), claim))
    figure, axes = new_figure(panel=(10.5, 1.0 + _ROW * len(lines)))
    ax = axes[0, 0]
    ax.axvline(0.0, color="black", lw=0.8)
    papers = False
    for place, (label, claim) in enumerate(lines):
        if claim is None:
            ax.axhspan(place - 0.5, place + 0.5, color="#e8e8e8", lw=0, zorder=2.5)  # above the line at 0
            across = ax.get_yaxis_transform()
            ax.text(0.01, place, label, transform=across, fontsize=7.5, fontweight="bold", va="center")
            continue
        colour, (factor, _) = _COLOURS[claim["verdict"]], unit_of(claim["measure"])
        if claim["low"] is not None:
            ends = [factor * claim["low"], factor * claim["high"]]
            ax.plot(ends, [place, place], color=colour, lw=2.2, alpha=0.55)
        ax.plot(factor * claim["difference"], place, "o", color=colour, ms=4.5)
        for paper in claim["paper"]:
            if paper["measure"] == claim["measure"].rpartition("/")[2]:
                ax.plot(paper["difference"], place, "D", mfc="none", mec="black", ms=4.5, mew=0.9)
                papers = True
    ax.set_yticks(range(len(lines)), ["" if claim is None else label for label, claim in lines], fontsize=7.5)
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(lines) - 0.5, -0.5)
    ax.grid(axis="x", lw=0.4, alpha=0.6)
    ax.set_xlabel("treatment minus control, points (distances: metres); bar: 95 % interval over scenes")
    there = {claim["verdict"] for _, claim in lines if claim is not None}
    entries = [
        Line2D([], [], marker="o", ls="", color=colour, label=name)
        for name, colour in _COLOURS.items()
        if name in there
    ]
    if papers:
        entries.append(Line2D([], [], marker="D", ls="", mfc="none", mec="black", label="the paper, on its own data"))
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), fontsize=8, frameon=False)
    return save_figure(figure, path)

"""Entries of legends: each layer of a picture has the same colour and name in all of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from tflane_jax.plots import style
from tflane_jax.plots.priors import prior_entries
from tflane_jax.plots.segments import LINE_STYLES
from tflane_jax.scene import BevChannel, Example, LanePrediction, LinePrediction, LineType

if TYPE_CHECKING:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch


def visibility_entries() -> list:
    """Return the entries of a legend for true lanes by what the sensor can see of them."""
    from matplotlib.colors import to_rgb
    from matplotlib.lines import Line2D

    (r, g, b), (to_r, to_g, to_b) = to_rgb(style.LANE_CLEAR), to_rgb(style.LANE_HIDDEN)
    between = (r + to_r) / 2, (g + to_g) / 2, (b + to_b) / 2
    return [
        Line2D([], [], color=style.LANE_CLEAR, lw=2, label="lane in sight"),
        Line2D([], [], color=between, lw=2, label="lane partly in sight"),
        Line2D([], [], color=style.LANE_HIDDEN, lw=2, label="lane out of sight"),
    ]


def truth_entry() -> Line2D:
    """Return the entry of a legend for the truth below a prediction."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color="#b0b3ba", lw=1, label="truth, in predictions")


def prediction_entries() -> list:
    """Return the entries of a legend for predicted lanes and their topology."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=style.PREDICTION, lw=2, label="predicted lane (fainter: unsure)"),
        Line2D([], [], color=style.LINK, lw=1.2, marker="o", ms=3, label="predicted topology"),
    ]


def boundary_entries(colour: str = "#b0b3ba") -> list:
    """Return the entries of a legend for boundaries by type, and for crossings."""
    from matplotlib.lines import Line2D

    names = {LineType.SOLID: "solid boundary", LineType.DASHED: "dashed boundary", LineType.NONE: "unmarked boundary"}
    return [
        *(Line2D([], [], color=colour, lw=1.2, ls=LINE_STYLES[kind], label=name) for kind, name in names.items()),
        crossing_entry(),
    ]


def hidden_entries(examples: Example | None = None) -> list:
    """Return the entry of a legend for ground out of sight, if examples have it; None: as if they had."""
    from matplotlib.patches import Patch

    if examples is not None and examples.hidden is None:
        return []
    return [Patch(facecolor="#0f1116", edgecolor=style.HATCH, hatch="////", lw=0, label="ground out of sight")]


def evidence_entries(examples: Example | None = None, channels: Iterable[BevChannel] = tuple(style.EVIDENCE)) -> list:
    """Return the entries of a legend for channels of the evidence, if examples have it; None: as if they had."""
    from matplotlib.patches import Patch

    if examples is not None and examples.bev is None:
        return []
    names = {channel: channel.name.lower().replace("_", " ") for channel in channels}
    return [Patch(facecolor=style.EVIDENCE[channel], label=f"evidence: {name}") for channel, name in names.items()]


def crossing_entry() -> Patch:
    """Return the entry of a legend for crossings."""
    from matplotlib.patches import Patch

    return Patch(facecolor=style.CROSSING + "38", edgecolor=style.CROSSING, label="crossing")


def area_entries() -> list:
    """Return the entries of a legend for road boundaries and crossings."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], color=style.ROAD_BOUNDARY, lw=1, label="road boundary"), crossing_entry()]


def traffic_entries(examples: Example | None = None) -> list:
    """Return the entries of a legend for road users by class, if examples have them; None: as if they had."""
    from matplotlib.patches import Patch

    if examples is not None and examples.traffic_flow is None:
        return []
    users = [Patch(facecolor=colour, label=user.name.lower()) for user, colour in style.ROAD_USER.items()]
    return [*users, Patch(facecolor="none", edgecolor=style.OTHER_ELEMENT, label="road user not seen")]


def element_entries(examples: Example | None = None) -> list:
    """Return the entries of a legend for traffic lights and signs, if examples have them; None: as if they had."""
    from matplotlib.lines import Line2D

    if examples is not None and examples.traffic_elements is None:
        return []
    return [
        Line2D([], [], color=style.LIGHT[2], lw=0, marker="o", ms=4, mec="black", label="traffic light"),
        Line2D([], [], color=style.OTHER_ELEMENT, lw=0, marker="s", ms=4, mec="black", label="traffic sign"),
    ]


def above_entries(lanes: LanePrediction | None, examples: Example) -> list:
    """Return the entries of a legend for the view from above, beside camera images that explain the rest."""
    if lanes is None:
        truth = [] if examples.map_lines is not None else [*visibility_entries(), *area_entries()]
        given = [*traffic_entries(examples), *prior_entries(examples), *element_entries(examples)]
        return [*hidden_entries(examples), *truth, *given]
    return [] if isinstance(lanes, LinePrediction) else [truth_entry(), *prediction_entries()]

"""Road center lines without lanes, the input of the SD map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tflane_jax.world.roads.layout_junctions import JunctionsPlan
from tflane_jax.world.roads.streets import Street


def road_lines(streets: Sequence[Street], plan: JunctionsPlan | None = None) -> tuple[Float[np.ndarray, "n 2"], ...]:
    """Return one line for each street, midway between its kerbs (in the median where it has one), metres.

    Streets that meet at an intersection all end at its center, or at the nearest of its nodes, which a line of their
    own joins. At a roundabout they end on its circulating lane, which is a closed line and comes last.

    Args:
        streets: laid out.
        plan: of the intersections between them, None without any.
    """
    lines = []
    for street in streets:
        line = 0.5 * (street.forward.kerb_line + street.backward.kerb_line[::-1])
        if plan is not None:
            start = [_node(line[0], plan)] if street.plan.stops_at_start else []
            stop = [_node(line[-1], plan)] if street.plan.stops_at_end else []
            line = np.stack([*start, *line, *stop])
        lines.append(line)
    if plan is not None:
        lines += [np.stack(junction.nodes) for junction in plan.junctions if junction.nodes]
    if plan is not None and plan.ring is not None:
        angle = np.linspace(0.0, 2 * np.pi, 49)
        circle = plan.ring[0] * np.stack([np.cos(angle), np.sin(angle)], -1)
        circle[-1] = circle[0]
        lines.append(plan.junctions[0].center + circle)
    return tuple(lines)


def _node(end: Float[np.ndarray, "2"], plan: JunctionsPlan) -> Float[np.ndarray, "2"]:
    """Return the junction point nearest to a road's end."""
    centers = np.stack([node for junction in plan.junctions for node in junction.nodes or (junction.center,)])
    center = centers[np.argmin(np.linalg.norm(centers - end, axis=-1))]
    if plan.ring is None:
        return center
    spoke = end - center
    return center + plan.ring[0] * spoke / np.linalg.norm(spoke)

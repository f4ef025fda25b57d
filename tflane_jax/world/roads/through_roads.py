"""Laying out roads without intersections, with their ramps and gores, mid-block crossings and medians."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.world.roads.config import RoadConfig
from tflane_jax.world.roads.cross_sections import SidePlan
from tflane_jax.world.roads.curves import ReferenceLine, direction
from tflane_jax.world.roads.lane_network import LaneNetwork
from tflane_jax.world.roads.layout_roads import RampPlan, RoadPlan, ramp_side
from tflane_jax.world.roads.site import Site
from tflane_jax.world.roads.streets import Street, StreetPlan, build_street

# Medians keep this distance from the lines of the lanes beside them, metres.
_MEDIAN_MARGIN = 0.3
# The kerbs of a road and its ramp separate where the gap between them reaches this width, metres.
_GORE_NOSE = 0.5


def lay_out_road(plan: RoadPlan, network: LaneNetwork, config: RoadConfig) -> Site:
    """Lay out a road: add its lanes to `network` and return its lines."""
    road = build_street(plan.street, network, config.solid_before_stop, config.vertex_spacing)
    if plan.ramp is None:
        site = Site([road], [road.forward.kerb_line, road.backward.kerb_line], urban=plan.urban)
    else:
        site = _add_ramp(road, plan, plan.ramp, network, config)
    if plan.style.median:
        site.islands.append(median_ring(road))
    if plan.crossing is not None:
        site.crossings.append(_mid_block_crossing(road, *plan.crossing))
    return site


def median_ring(street: Street) -> Float[np.ndarray, "n 2"]:
    """Return the closed kerb ring of a street's raised median, with round noses."""
    line = street.forward.line
    right = line.xy + (street.forward.inner_edge - _MEDIAN_MARGIN)[:, None] * line.right
    left = line.xy - (street.backward.inner_edge[::-1] - _MEDIAN_MARGIN)[:, None] * line.right
    radius = 0.5 * np.linalg.norm(right[[0, -1]] - left[[0, -1]], axis=-1)
    keep = (line.s > line.s[0] + radius[0]) & (line.s < line.s[-1] - radius[1])
    right, left = right[keep], left[keep]
    far = _nose(right[-1], left[-1])
    near = _nose(left[0], right[0])
    return np.concatenate([right, far, left[::-1], near, right[:1]])


def _nose(start: Float[np.ndarray, "2"], stop: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
    """Return the inner points of the half circle from `start` counter-clockwise to `stop`."""
    center, spoke = 0.5 * (start + stop), 0.5 * (start - stop)
    angle = np.linspace(0.0, np.pi, 8)[1:-1, None]
    across = np.array([-spoke[1], spoke[0]])
    return center + np.cos(angle) * spoke + np.sin(angle) * across


def _mid_block_crossing(road: Street, station: float, width: float) -> Float[np.ndarray, "5 2"]:
    """Return the ring of a crossing from kerb to kerb, perpendicular to the road."""
    line, kerb_left = road.forward.line, road.backward.kerb[::-1]
    s = station - road.plan.start
    middle, heading = line.at(np.array([s]))
    u = direction(heading[0])
    across = np.array([u[1], -u[0]])
    edges = middle[0] + np.array([[-0.5], [0.5]]) * width * u
    right, left = np.interp(s, line.s, road.forward.kerb), np.interp(s, line.s, kerb_left)
    a0, b0 = edges + right * across
    a1, b1 = edges - left * across
    return np.stack([a0, a1, b1, b0, a0])


def _add_ramp(road: Street, plan: RoadPlan, ramp: RampPlan, network: LaneNetwork, config: RoadConfig) -> Site:
    """Lay out the ramp at the first extra lane of the forward side, and the kerbs of both."""
    side = road.forward
    extra, (first, last) = side.plan.extras[0], side.extra_segments[0]
    line = side.line
    attach = extra.start if ramp.enters else extra.stop
    at = int(np.argmin(np.abs(line.s - attach)))
    # A ramp runs beside the road for a long way, so routes on it must keep away from the road's end too.
    ego = config.ego_reach - abs(attach - 0.5 * line.s[-1])
    lane = ramp_side(plan.style)
    bare = SidePlan(lanes=0, gutter=lane.gutter)
    # The ramp's axis is the left line of its lane and runs away from the road.
    join = network.drafts[first].left[0] if ramp.enters else network.drafts[last].left[-1]
    hand = 1.0 if ramp.enters else -1.0
    peak, easing = hand / ramp.radius, 15.0
    arc = max(ramp.turn * ramp.radius - easing, 1.0)
    bends = ((0.0, 0.0), (easing, peak), (easing + arc, peak), (2 * easing + arc, 0.0))
    branch = build_street(
        StreetPlan(
            origin=join,
            heading=float(line.heading[at]) + (np.pi if ramp.enters else 0.0),
            start=0.0,
            stop=config.reach,
            forward=bare if ramp.enters else lane,
            backward=lane if ramp.enters else bare,
            speed=ramp.speed,
            ego=(0.0, ego),
            bends=bends,
        ),
        network,
        config.solid_before_stop,
        config.vertex_spacing,
    )
    if ramp.enters:
        slip = branch.backward.exits[0].segment
        network.weld(slip, first, keep=first)
        gore = branch.forward.kerb_line
        nose, on_road = _gore(gore, side.line, float(side.plan.kerb(0.0)))
        kerbs = [
            np.concatenate([side.kerb_line[: on_road + 1], gore[nose:]]),
            np.concatenate([branch.backward.kerb_line[:-1], side.kerb_line[at:]]),
        ]
    else:
        slip = branch.forward.entries[0].segment
        network.weld(last, slip, keep=last)
        gore = branch.backward.kerb_line[::-1]
        nose, on_road = _gore(gore, side.line, float(side.plan.kerb(0.0)))
        kerbs = [
            np.concatenate([side.kerb_line[: at + 1], branch.forward.kerb_line[1:]]),
            np.concatenate([gore[nose:][::-1], side.kerb_line[on_road:]]),
        ]
    return Site([road, branch], [*kerbs, road.backward.kerb_line], urban=plan.urban)


def _gore(gore: Float[np.ndarray, "n 2"], line: ReferenceLine, kerb: float) -> tuple[int, int]:
    """Return where the two kerbs separate: the vertex of the ramp's inner kerb and the nearest vertex of the road.

    Args:
        gore: inner kerb of the ramp, away from the road.
        line: axis of the road.
        kerb: distance of the road's own kerb from its axis.
    """
    nearest = ((gore[:, None] - line.xy[None]) ** 2).sum(-1).argmin(1)
    beside = ((gore - line.xy[nearest]) * line.right[nearest]).sum(-1)
    nose = int(np.argmax(beside > kerb + _GORE_NOSE))
    return nose, int(nearest[nose])

"""Driveways: short ways from a street to the plots beside it, with a vehicle that stands in them.

The drivable surface grows into the plot, so the road's edge is interrupted there. Its vehicle does not move: it is
parked, or waits to leave. No lane leads in, unless it is an access road (`access_roads`): wider, with rounded corners.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tflane_jax.geometry import wrap_angle
from tflane_jax.world.roads.config import RoadConfig
from tflane_jax.world.roads.curves import arc_length, direction, fillet, points_at, right_of
from tflane_jax.world.roads.layouts import chance, draw
from tflane_jax.world.roads.site import Driveway, Site

# A driveway widens by this much on both sides at the kerb, metres.
_FLARE = 0.8
# It keeps clear of the ends of streets at junctions, of crossings, and of every other kerb, metres.
_CLEAR_OF_JUNCTION, _CLEAR_OF_CROSSING, _CLEAR_OF_KERB = 9.0, 5.0, 4.0
# The kerb turns by less than this along it, radians.
_STRAIGHT = np.deg2rad(4.0)
# Distance of the vehicle's middle from the kerb and from the far end, metres; it stands behind the sidewalk.
_WAITS, _PARKS = 5.6, 3.2
# Of the vehicles in driveways, those that wait to leave and, of the others, those parked nose out.
_LEAVING, _NOSE_OUT = 0.25, 0.4
# A slot in a parking strip is left free if its middle is nearer than this to the middle of a driveway, metres.
_SLOT_CLEARANCE = 4.0


def draw_driveways(
    rng: np.random.Generator, site: Site, stop_lines: Float[np.ndarray, "j 2"], config: RoadConfig
) -> list[Driveway]:
    """Draw the driveways of a site.

    Args:
        rng: stream.
        site: with its kerbs and crossings.
        stop_lines: ends of the connectors of all junctions, metres.
        config: its settings of driveways and access roads are used.
    """
    found: list[Driveway] = []
    crossings = np.concatenate([np.zeros((0, 2)), *site.crossings])
    # Nothing is drawn where there are no access roads: other worlds stay what they were.
    spread = min(config.access_share, 1.0 - config.access_share)
    fraction = (
        draw(rng, (config.access_share - spread, config.access_share + spread)) if spread else config.access_share
    )
    for number, kerb in enumerate(site.kerbs):
        length = arc_length(kerb)[-1]
        others = [points_at(k, np.arange(0.0, arc_length(k)[-1], 1.0)) for k in (*site.kerbs, *site.islands)]
        last = -np.inf
        for middle in np.sort(rng.uniform(0.0, length, rng.poisson(config.driveways * length / 100.0))).tolist():
            access = fraction > 0.0 and chance(rng, fraction)
            width = draw(rng, config.access_width if access else config.driveway_width)
            rounding = draw(rng, config.access_rounding) if access else _FLARE
            depth = draw(rng, config.driveway_depth) + (rounding if access else 0.0)
            leaves, out = chance(rng, _LEAVING), chance(rng, _NOSE_OUT)
            start, stop = middle - 0.5 * width - rounding, middle + 0.5 * width + rounding
            if start < max(last + 1.0, 2.0) or stop > length - 2.0:
                continue
            at = points_at(kerb, np.array([start, middle, stop]))
            steps = np.diff(at, axis=0)
            turn = wrap_angle(np.arctan2(steps[1, 1], steps[1, 0]) - np.arctan2(steps[0, 1], steps[0, 0]))
            heading = float(np.arctan2(*(at[2] - at[0])[::-1]))
            ahead, outward = direction(heading), right_of(heading)
            half = 0.5 * width * ahead
            corners = at[1] + np.stack([-half, half])
            far = corners + depth * outward
            if access:
                ways = heading + np.pi, heading
                around = [fillet(corners[k], ways[k], heading - np.pi / 2, rounding) for k in range(2)]
                edge = np.concatenate([at[:1], around[0][1:], far, around[1][:0:-1], at[2:]])
            else:
                bent = corners + _FLARE * outward
                edge = np.stack([at[0], bent[0], far[0], far[1], bent[1], at[2]])
            # Its own kerb is beside it, but must not come back behind it.
            behind = [k[_beyond(k, at[1], outward)] if i == number else k for i, k in enumerate(others)]
            if (
                abs(turn) < _STRAIGHT
                and _clear(edge, stop_lines, _CLEAR_OF_JUNCTION)
                and _clear(edge, crossings, _CLEAR_OF_CROSSING)
                and _clear(
                    points_at(edge, np.linspace(0.0, arc_length(edge)[-1], 24)), np.concatenate(behind), _CLEAR_OF_KERB
                )
                and all(_clear(edge, one.edge, _CLEAR_OF_KERB) for one in found if one.kerb != number)
            ):
                xy = at[1] + (_WAITS if leaves else depth - _PARKS) * outward
                if access:
                    # On the lane out, or the lane in.
                    xy = xy + (0.5 if leaves or out else -0.5) * half
                yaw = wrap_angle(heading - np.pi / 2 + np.pi * (leaves or out))
                slot = np.array([*xy, yaw])
                lanes = {"lanes": width, "rounding": rounding} if access else {}
                found.append(Driveway(number, start, stop, edge, slot, **lanes))
                last = stop
    return found


def interrupted(kerbs: Sequence[Float[np.ndarray, "_ 2"]], driveways: Sequence[Driveway]) -> list[np.ndarray]:
    """Return the kerbs with the edges of driveways in the place of what they interrupt."""
    lines = []
    for number, kerb in enumerate(kerbs):
        pieces, along = [], arc_length(kerb)
        begin = 0.0
        for one in (one for one in driveways if one.kerb == number):
            pieces += [kerb[(along >= begin) & (along < one.start - 1e-6)], one.edge]
            begin = one.stop + 1e-6
        lines.append(np.concatenate([*pieces, kerb[along >= begin]]))
    return lines


def parking_beside(slots: Float[np.ndarray, "p 3"], driveways: Sequence[Driveway]) -> Float[np.ndarray, "q 3"]:
    """Return the slots of parking strips that no driveway needs, then those in the driveways."""
    free = np.ones(len(slots), bool)
    for one in driveways:
        mouth = 0.5 * (one.edge[0] + one.edge[-1])
        free &= np.linalg.norm(slots[:, :2] - mouth, axis=-1) > _SLOT_CLEARANCE + 0.5 * (one.stop - one.start)
    return np.concatenate([slots[free], *(one.slot[None] for one in driveways)])


def _beyond(
    points: Float[np.ndarray, "n 2"], origin: Float[np.ndarray, "2"], outward: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, " n"]:
    return (points - origin) @ outward > 2.0


def _clear(edge: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "m 2"], distance: float) -> bool:
    return bool((np.linalg.norm(edge[:, None] - points[None], axis=-1) > distance).all())

"""Laying out networks with intersections: arms, connectors, kerbs, crossings, lights and signs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tflane_jax.world.roads import intersections, roundabouts
from tflane_jax.world.roads.config import RoadConfig
from tflane_jax.world.roads.lane_network import LaneNetwork
from tflane_jax.world.roads.layout_junctions import JunctionPlan, JunctionsPlan, seen_from_end
from tflane_jax.world.roads.layouts import ArmPlan, chance
from tflane_jax.world.roads.movements import Approach, lay_connectors, plan_movements
from tflane_jax.world.roads.right_of_way import phases, set_priorities
from tflane_jax.world.roads.roundabouts import Ring
from tflane_jax.world.roads.site import Site
from tflane_jax.world.roads.streets import Side, Street, StreetPlan, build_street
from tflane_jax.world.roads.through_roads import median_ring
from tflane_jax.world.roads.traffic_control import signs, traffic_lights

_RING_HALF_ANGLE = np.deg2rad(29.0)


@dataclass(frozen=True)
class _Mouth:
    """A laid-out street at its intersection, with the sides that lead in and out."""

    arm: ArmPlan
    street: Street
    incoming: Side
    outgoing: Side

    def approach(self) -> Approach:
        return Approach(
            self.arm.heading,
            self.incoming.exits,
            self.outgoing.entries,
            self.arm.minor,
            self.arm.no_left,
            self.arm.style.speed,
            self.incoming.kerb_line[-1],
            self.outgoing.kerb_line[0],
        )


def lay_out_junctions(rng: np.random.Generator, plan: JunctionsPlan, network: LaneNetwork, config: RoadConfig) -> Site:
    """Lay out intersections and their streets: add lanes to `network` and return the lines."""
    arms = [_sorted(j, plan, i) for i, j in enumerate(plan.junctions)]
    ring = None if plan.ring is None else _ring(plan)
    distances = [_stop_distances(junction, around, ring) for junction, around in zip(plan.junctions, arms, strict=True)]
    link = _build_link(plan, arms, distances, network, config)
    site = Site([] if link is None else [link], [])
    mouths: list[list[_Mouth]] = []
    for index, around in enumerate(arms):
        mouths.append([])
        for arm, distance in zip(around, distances[index], strict=True):
            if link is not None and _is_link(arm, plan, index):
                sides = (link.backward, link.forward) if index == 0 else (link.forward, link.backward)
                mouths[-1].append(_Mouth(arm, link, *sides))
                continue
            street = build_street(
                arm.street(float(distance), config), network, config.solid_before_stop, config.vertex_spacing
            )
            site.streets.append(street)
            mouths[-1].append(_Mouth(arm, street, street.backward, street.forward))

    corners: dict[int, tuple[Float[np.ndarray, "n 2"], Side]] = {}  # incoming side -> kerb corner, outgoing side
    for index, junction in enumerate(plan.junctions):
        around, here = arms[index], mouths[index]
        approaches = [m.approach() for m in here]
        if ring is not None:
            lines = _ring_corners(ring, around, distances[index])
            _lay_roundabout(ring, approaches, network, config)
            site.islands.append(ring.island())
        else:
            lines = intersections.kerb_corners([a.arm for a in around], distances[index], junction.corner_radius)
            _lay_intersection(rng, index, junction, here, distances[index], lines, network, site, config)
        for k, mouth in enumerate(here):
            corners[id(mouth.incoming)] = lines[k], here[(k + 1) % len(here)].outgoing
        for arm, distance in zip(around, distances[index], strict=True):
            if arm.crossing:
                site.crossings.append(intersections.crossing_ring(arm.arm, float(distance)))
    site.islands += [median_ring(s) for s in site.streets if _has_median(s)]
    site.kerbs = _chain_kerbs(site.streets, corners)
    return site


def _sorted(junction: JunctionPlan, plan: JunctionsPlan, index: int) -> list[ArmPlan]:
    """Return all arms of an intersection, the link's included, counter-clockwise."""
    arms = list(junction.arms)
    if plan.link is not None:
        arms.append(plan.link if index == 0 else seen_from_end(plan.link, plan.distance))
    return sorted(arms, key=lambda a: a.heading % (2 * np.pi))


def _is_link(arm: ArmPlan, plan: JunctionsPlan, index: int) -> bool:
    return all(arm is not own for own in plan.junctions[index].arms)


def _ring(plan: JunctionsPlan) -> Ring:
    assert plan.ring is not None
    radius, width = plan.ring
    gutter = plan.junctions[0].arms[0].style.forward.gutter
    return Ring(radius, width, gutter, _RING_HALF_ANGLE, speed=6.5)


def _stop_distances(junction: JunctionPlan, around: Sequence[ArmPlan], ring: Ring | None) -> Float[np.ndarray, " arms"]:
    if ring is not None:
        return np.array([ring.stop_distance(a.crossing) for a in around])
    return intersections.stop_distances([a.arm for a in around], junction.corner_radius)


def _build_link(
    plan: JunctionsPlan,
    arms: Sequence[Sequence[ArmPlan]],
    distances: Sequence[Float[np.ndarray, " arms"]],
    network: LaneNetwork,
    config: RoadConfig,
) -> Street | None:
    """Lay out the street between two intersections."""
    if plan.link is None:
        return None
    first, second = (
        float(next(d for a, d in zip(arms[i], distances[i], strict=True) if _is_link(a, plan, i))) for i in range(2)
    )
    style = plan.link.style
    return build_street(
        StreetPlan(
            origin=plan.link.origin,
            heading=plan.link.heading,
            start=first,
            stop=plan.distance - second,
            forward=style.forward,
            backward=style.backward,
            speed=style.speed,
            ego=(0.0, plan.distance),
            stops_at_start=True,
            stops_at_end=True,
        ),
        network,
        config.solid_before_stop,
        config.vertex_spacing,
    )


def _lay_intersection(
    rng: np.random.Generator,
    index: int,
    junction: JunctionPlan,
    mouths: Sequence[_Mouth],
    distances: Float[np.ndarray, " arms"],
    corners: Sequence[Float[np.ndarray, "n 2"]],
    network: LaneNetwork,
    site: Site,
    config: RoadConfig,
) -> None:
    """Add the connectors of an intersection with their priorities, and its lights and signs."""
    approaches = [m.approach() for m in mouths]
    # No draw without the setting, so that its scenes stay what they were.
    wide = config.wide_turns > 0.0 and chance(rng, config.wide_turns)
    movements = plan_movements(approaches, "any lane" if wide else "one lane each")
    ids = lay_connectors(
        movements,
        approaches,
        network,
        config.comfortable_lateral_acceleration,
        config.vertex_spacing,
        corner_radius=junction.corner_radius,
        corners=corners if junction.nodes or len(mouths) > 4 else (),
    )
    # Traffic lights need at least two phases with incoming traffic.
    used = sorted({p for p, a in zip(phases(approaches), approaches, strict=True) if a.incoming})
    signalised = junction.signalised and len(used) > 1
    set_priorities(ids, movements, approaches, network, index, signalised)
    if signalised:
        green = int(rng.choice(used))
        # The corners of five legs reach farther into the intersection.
        beyond = 1.35 if len(mouths) > 4 else 1.7
        site.elements += traffic_lights(approaches, green, beyond=beyond * float(distances.mean()))
    site.elements += signs(approaches, movements, [m.arm.style.median > 0 for m in mouths])


def _lay_roundabout(ring: Ring, approaches: Sequence[Approach], network: LaneNetwork, config: RoadConfig) -> None:
    planned = roundabouts.lay_ring(ring, approaches, network, config.vertex_spacing)
    movements = [movement for movement, _ in planned]
    ids = lay_connectors(
        movements,
        approaches,
        network,
        config.comfortable_lateral_acceleration,
        config.vertex_spacing,
        corner_radius=None,
    )
    for connector, (_, circulating) in zip(ids, planned, strict=True):
        if circulating is not None:
            network.let_pass(connector, {circulating})


def _ring_corners(
    ring: Ring, around: Sequence[ArmPlan], distances: Float[np.ndarray, " arms"]
) -> list[Float[np.ndarray, "n 2"]]:
    arms = [a.arm for a in around]
    pairs = [(i, (i + 1) % len(arms)) for i in range(len(arms))]
    return [roundabouts.kerb_corner(ring, arms[i], arms[j], float(distances[i]), float(distances[j])) for i, j in pairs]


def _has_median(street: Street) -> bool:
    plan = street.plan
    return min(plan.forward.lanes, plan.backward.lanes) > 0 and plan.forward.inner > 0


def _chain_kerbs(
    streets: Sequence[Street], corners: dict[int, tuple[Float[np.ndarray, "n 2"], Side]]
) -> list[Float[np.ndarray, "n 2"]]:
    """Join kerbs of streets and corners into lines that run from border to border of the map."""
    reached = {id(side) for _, side in corners.values()}
    chains = []
    for side in (side for street in streets for side in (street.forward, street.backward)):
        if id(side) in reached:
            continue
        pieces = [side.kerb_line]
        while id(side) in corners:
            corner, side = corners[id(side)]
            # The ends of a corner lie on the kerbs that it joins.
            pieces += [corner[1:-1], side.kerb_line]
        chains.append(np.concatenate(pieces))
    return chains

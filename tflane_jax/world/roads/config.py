"""Settings of the road networks: scene kinds, and the ranges from which dimensions and probabilities are drawn."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated

from tflane_jax.limits import (
    ASCENDING,
    SOME_WEIGHT,
    Count,
    Fraction,
    Positive,
    PositiveOrZero,
    PositiveRange,
    Range,
    Rules,
    above_at_most,
    at_least,
)
from tflane_jax.scene import LineType

CLOSEST_JUNCTIONS = 60.0
"""Two four-way intersections take up nearly this much of the street between them, metres."""
LEAST_DEPTH = 6.0
"""A vehicle that is parked in a driveway of this depth does not reach the kerb, metres."""
Bends = Annotated[tuple[Annotated[float, at_least(20)], Annotated[float, at_least(20)]], ASCENDING]
"""Radii of streets; the inner edge of a street would fold on tighter ones."""
Markings = Annotated[tuple[tuple[LineType, PositiveOrZero], ...], SOME_WEIGHT]
"""Markings of lines with their relative frequencies."""


class SceneKind(enum.Enum):
    """The central feature of a road network."""

    ROAD = "road"
    LANE_DROP = "lane drop"
    LANE_GAIN = "lane gain"
    ON_RAMP = "on-ramp"
    EXIT_RAMP = "exit ramp"
    T_JUNCTION = "T junction"
    FOUR_WAY = "four-way intersection"
    TWO_JUNCTIONS = "two junctions"
    ROUNDABOUT = "roundabout"
    FIVE_LEGS = "five-leg intersection"
    STAGGERED = "staggered junction"


@dataclass(frozen=True)
class RoadConfig:
    """Dimensions and probabilities of procedural road networks. Lengths in metres, speeds in m/s, angles in degrees.

    Attributes:
        kinds: scene kinds with their relative frequencies.
        reach: distance from the central feature to the border of the map.
        ego_reach: distance from the central feature up to which ego routes run. Where a drive does not reach the end of
            its roads, key frames may lie beyond it. Where `reach - ego_reach` is less than half the diagonal of the
            perceived box, or a frame lies beyond, the border of the map may cut lanes inside the box.
        vertex_spacing: largest distance between vertices of a line.
        lane_width: width of vehicle lanes.
        single_lane_width: width of lanes on streets with at most one lane in each direction; None: no difference.
        ring_lane_width: width of the lane of a roundabout.
        bike_width: width of bike lanes.
        parking_width: width of kerb-side parking strips.
        gutter: distance between the outermost line and the kerb.
        wide_median: width of raised medians from which a turning lane can be carved.
        narrow_median: width of raised medians from which no turning lane can be carved.
        urban_speed, fast_speed, ramp_speed: ranges of speed limits, m/s.
        comfortable_lateral_acceleration: lateral acceleration, m/s^2, that limits the speed on connectors.
        bend_radius: radius of the arcs of streets.
        fast_bend_radius: radius of the arcs of roads with ramps and changing lane counts.
        corner_radius: radius of the kerb roundings of intersections.
        crossing_width: length of pedestrian crossings along the road.
        inner_marking, outer_marking: markings of the leftmost and the rightmost line of a direction of travel, with
            their relative frequencies over streets.
        divider_marking: markings of the lines between lanes of one direction.
        kerb_marking: instead of `inner_marking` and `outer_marking`, markings of lines with a kerb or a raised median
            beside them, not a bike lane, a parking strip or oncoming traffic; None: no difference.
        solid_before_stop: length of the solid divider before a stop line, where dividers are painted.
        taper: length over which a lane opens or closes.
        fast_taper: length over which a lane opens or closes on fast roads.
        pocket: length of a turning lane, taper included.
        skew: largest deviation of the arms of an intersection from the right angle.
        arm_offset: largest sideways shift of an arm from the intersection's center.
        junction_distance: distance between the centers of two junctions.
        side_lean: largest deviation of their side streets, and of those of staggered junctions, from the right angle;
            they also bend by less than this. Much of it lets streets on one side meet, if the junctions are near.
        stagger: distance between the two side streets of a staggered junction, along its main road; a little more where
            the lanes between them would be too short.
        junction_lanes: largest number of through lanes per direction of an intersection's main road, roundabouts and
            two junctions aside.
        least_junction_lanes: smallest number of through lanes per direction of an intersection's main road; two
            junctions included.
        another_lane: probability for such a main road of one lane more in each direction, beyond `junction_lanes` too.
        second_sides: probability for each of two junctions to be a four-way intersection, not a T junction.
        wide_turns: probability for an intersection that a turn may end on every lane of the road that it enters; else
            each lane that turns leads to one lane.
        lane_changes: probability for each direction of a street from an intersection to the border of the map that a
            lane opens behind the intersection, or closes before it, where there is room.
        change_distance: distance between the intersection and a change of lanes, or between the turning lanes and it.
        one_way, median, bike, parking: probability that a street is one-way, has a median, bike lanes, parking strips.
        mid_block_crossing: probability of a crossing on a street without intersection.
        signals: probability that an intersection has traffic lights.
        crossings: probability that an arm of an intersection has a crossing.
        driveways: mean number of driveways on 100 m of kerb, where there is room for them.
        driveway_width, driveway_depth: dimensions of a driveway; the depth is counted from the kerb.
        access_share: fraction of the driveways that are access roads, with a lane in and one out: the map cuts the
            lanes of the street there as at a junction, though its traffic passes. Drawn for each scene, uniform
            within min(access_share, 1 - access_share) of it.
        access_width: width of an access road.
        access_rounding: radius of the kerbs at the corners of an access road.
        cut_setback: how far from a stop line, or from the rounded corner of an access road, the map cuts lanes: each
            direction of a street draws from an exponential distribution, whose mean is drawn for each scene, uniform
            from 0 to twice this.
        car_parks: mean number of rows of parked vehicles behind the sidewalk on 100 m of kerb, where there is room.
        turn_restriction: probability that an arm must not turn left.
        sidewalk: distance of the walking line behind the kerb.
        building_setback: distance of buildings behind the kerb.
    """

    kinds: Annotated[tuple[tuple[SceneKind, PositiveOrZero], ...], SOME_WEIGHT] = (
        (SceneKind.ROAD, 0.16),
        (SceneKind.LANE_DROP, 0.06),
        (SceneKind.LANE_GAIN, 0.06),
        (SceneKind.ON_RAMP, 0.06),
        (SceneKind.EXIT_RAMP, 0.06),
        (SceneKind.T_JUNCTION, 0.20),
        (SceneKind.FOUR_WAY, 0.20),
        (SceneKind.TWO_JUNCTIONS, 0.14),
        (SceneKind.ROUNDABOUT, 0.06),
    )
    reach: Positive = 130.0
    ego_reach: Positive = 70.0
    vertex_spacing: Annotated[float, above_at_most(0, 5)] = 1.6
    lane_width: PositiveRange = (2.9, 3.8)
    single_lane_width: PositiveRange | None = None
    ring_lane_width: PositiveRange = (4.2, 5.2)
    bike_width: Range = (1.5, 1.9)
    parking_width: Range = (2.2, 2.5)
    gutter: Range = (0.25, 0.6)
    wide_median: Range = (5.0, 6.5)
    narrow_median: Range = (1.6, 2.6)
    urban_speed: PositiveRange = (8.3, 14.0)
    fast_speed: PositiveRange = (16.0, 25.0)
    ramp_speed: PositiveRange = (11.0, 16.0)
    comfortable_lateral_acceleration: Positive = 2.2
    bend_radius: Bends = (45.0, 200.0)
    fast_bend_radius: Bends = (180.0, 600.0)
    corner_radius: PositiveRange = (4.5, 9.0)
    crossing_width: Range = (2.6, 4.2)
    inner_marking: Markings = ((LineType.SOLID, 1.0),)
    outer_marking: Markings = ((LineType.SOLID, 1.0),)
    divider_marking: Markings = ((LineType.DASHED, 1.0),)
    kerb_marking: Markings | None = None
    solid_before_stop: PositiveOrZero = 25.0
    taper: PositiveRange = (18.0, 26.0)
    fast_taper: PositiveRange = (30.0, 45.0)
    pocket: Range = (38.0, 46.0)
    skew: PositiveOrZero = 25.0
    arm_offset: PositiveOrZero = 2.0
    junction_distance: Range = (65.0, 95.0)
    side_lean: PositiveOrZero = 10.0
    stagger: Range = (9.0, 60.0)
    junction_lanes: Count = 3
    least_junction_lanes: Count = 1
    another_lane: Fraction = 0.0
    second_sides: Fraction = 0.25
    wide_turns: Fraction = 0.0
    lane_changes: Fraction = 0.0
    change_distance: Annotated[tuple[Positive, Positive], ASCENDING] = (15.0, 70.0)
    one_way: Fraction = 0.2
    median: Fraction = 0.35
    bike: Fraction = 0.25
    parking: Fraction = 0.35
    mid_block_crossing: Fraction = 0.3
    signals: Fraction = 0.6
    crossings: Fraction = 0.8
    driveways: PositiveOrZero = 0.0
    driveway_width: Range = (3.0, 6.0)
    driveway_depth: Range = (8.5, 12.0)
    access_share: Fraction = 0.0
    access_width: Range = (5.0, 9.0)
    access_rounding: Range = (1.5, 6.0)
    cut_setback: PositiveOrZero = 0.0
    car_parks: PositiveOrZero = 0.0
    turn_restriction: Fraction = 0.12
    sidewalk: PositiveOrZero = 1.8
    building_setback: Range = (4.0, 10.0)

    def limits(self) -> Rules:
        """Junctions have room, lanes a number, and what stands in a driveway is off the road."""
        least, most = self.least_junction_lanes, self.junction_lanes
        yield "least_junction_lanes", least <= most, f"at most junction_lanes ({most})"
        near = self.junction_distance[0]
        yield (
            "junction_distance",
            near >= CLOSEST_JUNCTIONS,
            f"at least {CLOSEST_JUNCTIONS:g} m: intersections have room",
        )
        yield "ego_reach", self.ego_reach <= self.reach, f"at most reach ({self.reach:g})"
        widest = self.taper[1]
        yield "pocket", self.pocket[0] >= widest, f"at least the longest taper ({widest:g} m), which is a part of it"
        shallow = self.driveway_depth[0]
        yield "driveway_depth", shallow >= LEAST_DEPTH, f"at least {LEAST_DEPTH:g} m: vehicles stand off the road"

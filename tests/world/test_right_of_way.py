"""Rules at junctions: turning lanes, priorities, signals, traffic lights and signs."""

from __future__ import annotations

import math

from tests.world.road_networks import case_networks, crossings_of, heading, network
from tflane_jax.scene import LineType
from tflane_jax.world.roads.networks import RoadNetwork, SceneKind


def test_a_turning_lane_leads_only_to_turns():
    """A lane that forks off before a junction leads there by one connector, to a turn."""
    pockets = 0
    for net in (network(s, SceneKind.FOUR_WAY) for s in range(8)):
        segments = net.map.segments
        for segment in segments.values():
            if segment.is_intersection or len(segment.successors) != 2:
                continue
            lanes = [segments[j] for j in segment.successors]
            if not any(LineType.NONE in (s.left_type, s.right_type) and not s.is_intersection for s in lanes):
                continue
            ends = []
            for lane in lanes:
                while len(lane.successors) == 1 and not segments[lane.successors[0]].is_intersection:
                    lane = segments[lane.successors[0]]
                ends.append([segments[j] for j in lane.successors])
            if all(c.is_intersection for end in ends for c in end):
                turns = [
                    [abs(math.remainder(heading(c.centerline, 1) - heading(c.centerline, 0), 2 * math.pi)) for c in e]
                    for e in ends
                ]
                assert any(len(t) == 1 and t[0] > math.radians(30) for t in turns)
                pockets += 1
    assert pockets > 3


def test_priorities_name_existing_segments_and_have_no_circles():
    ruled = 0
    for net in case_networks():
        segments = net.map.segments
        assert set(net.yield_to) <= set(segments)
        assert set(net.speed_limit) == set(segments)
        assert all(2.0 < v < 40.0 for v in net.speed_limit.values())
        done: set[int] = set()

        def visit(i: int, path: tuple[int, ...], net: RoadNetwork = net, done: set[int] = done) -> None:
            assert i not in path
            if i not in done:
                for j in net.yield_to.get(i, ()):
                    visit(j, (*path, i))
                done.add(i)

        for i, others in net.yield_to.items():
            assert set(others) <= set(segments)
            visit(i, ())
            ruled += 1
    assert ruled > 50


def test_crossing_traffic_is_ruled_by_priority_or_by_signals():
    """Of two connectors that cross, one yields, or signals keep them apart."""
    pairs = 0
    for net in (network(s, k) for k in (SceneKind.FOUR_WAY, SceneKind.T_JUNCTION) for s in range(5)):
        connectors = [s for s in net.map.segments.values() if s.is_intersection]
        for k, a in enumerate(connectors):
            for b in connectors[:k]:
                if not crossings_of(a.centerline, b.centerline).any():
                    continue
                if a.vehicle and b.vehicle and abs(heading(a.centerline, 0) - heading(b.centerline, 0)) < 0.02:
                    continue  # two lanes of one approach
                yields = b.id in net.yield_to.get(a.id, ()) or a.id in net.yield_to.get(b.id, ())
                apart = net.signal_phase.get(a.id) != net.signal_phase.get(b.id)
                assert yields or apart
                pairs += 1
    assert pairs > 20


def test_lights_hang_over_the_lanes_that_lead_to_signalised_connectors():
    lights = 0
    for net in case_networks():
        governed = set()
        for element in net.map.elements:
            assert element.position.shape == (3,)
            assert element.lanes
            assert set(element.lanes) <= set(net.map.segments)
            assert (element.category, element.attribute) in {(1, 1), (1, 2)} | {(2, a) for a in range(4, 13)}
            if element.category == 1:
                lights += 1
                governed |= set(element.lanes)
                lane = net.map.segments[element.lanes[0]]
                assert math.cos(element.yaw - heading(lane.centerline, 1)) < -0.99
        for i, segment in net.map.segments.items():
            if segment.vehicle and not segment.is_intersection:
                signalised = any(j in net.signal_phase for j in segment.successors)
                assert signalised == (i in governed)
        # At the start some lights are green and others red.
        states = {e.attribute for e in net.map.elements if e.category == 1}
        assert not states or states == {1, 2}
    assert lights > 10

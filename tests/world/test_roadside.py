"""Roadside objects: kerbs, sidewalks, parked vehicles, buildings, crossings."""

from __future__ import annotations

import numpy as np
import pytest

from tests.world.road_networks import case_networks, crossings_of, inside_boxes
from tflane_jax.datasets.map_geometry import MapGeometry
from tflane_jax.geometry.polylines import arc_length, resample
from tflane_jax.geometry.rings import signed_area
from tflane_jax.scene import LineType


@pytest.mark.slow
def test_kerbs_never_cross_a_vehicle_lane():
    for net in case_networks():
        for segment in net.map.segments.values():
            for boundary in net.map.road_boundaries:
                assert not crossings_of(segment.centerline, boundary).any()
                if segment.vehicle and not segment.is_intersection:
                    assert not crossings_of(segment.left, boundary).any()
                    assert not crossings_of(segment.right, boundary).any()


def test_kerbs_do_not_cross_themselves_or_each_other():
    for net in case_networks():
        kerbs = net.map.road_boundaries
        for k, a in enumerate(kerbs):
            for b in kerbs[: k + 1]:
                assert not crossings_of(a, b).any()


def test_rings_of_a_vector_map_run_as_maptr_has_them():
    """Crossings clockwise and islands the other way, so that MapTR's loss needs one direction (`rings="one"`)."""
    islands = crossings = 0
    for net in case_networks():
        geometry = MapGeometry.of(
            crossings=[[ring] for ring in net.map.crossings], boundaries=list(net.map.road_boundaries)
        )
        lines = [geometry.boundaries.line(i) for i in range(len(geometry.boundaries.ends))]
        rings = [line for line in lines if np.array_equal(line[0], line[-1])]
        assert all(signed_area(ring) > 0.0 for ring in rings)
        islands += len(rings)
        crossings += len(geometry.polygon)
        assert all(signed_area(geometry.crossings.line(i)) < 0.0 for i in range(len(geometry.polygon)))
    assert islands > 0
    assert crossings > 0


def test_pedestrians_walk_behind_the_kerbs():
    for net in case_networks():
        for walk in net.sidewalks:
            assert walk.shape[1] == 2
            for segment in net.map.segments.values():
                assert not crossings_of(walk, segment.centerline).any()


def test_a_kerb_follows_every_road_edge():
    """Between the rightmost vehicle lane and the kerb lie at most a bike lane, a parking strip and the gutter."""
    edges = 0
    for net in case_networks():
        kerbs = np.concatenate([resample(b, int(arc_length(b)[-1]) + 2)[:, :2] for b in net.map.road_boundaries])
        lanes = [s for s in net.map.segments.values() if s.vehicle and not s.is_intersection]
        shared = {s.left.tobytes() for s in lanes}
        for segment in lanes:
            if segment.right_type == LineType.SOLID and segment.right.tobytes() not in shared:
                middle = segment.right[len(segment.right) // 2, :2]
                assert 0.2 < np.linalg.norm(kerbs - middle, axis=-1).min() < 5.2
                edges += 1
    assert edges > 200


def test_parked_vehicles_stand_outside_the_lanes_along_the_kerb():
    slots = 0
    for net in case_networks():
        lanes = [s for s in net.map.segments.values() if s.vehicle]
        points = np.concatenate([s.centerline[:, :2] for s in lanes] + [s.right[:, :2] for s in lanes])
        boxes = np.column_stack(
            [net.parking[:, :2], np.full(len(net.parking), 4.6), np.full(len(net.parking), 1.9), net.parking[:, 2]]
        )
        assert net.parking.shape[1] == 3
        assert not inside_boxes(boxes, points).any()
        slots += len(boxes)
    assert slots > 100


def test_buildings_stand_off_the_road():
    standing = 0
    for net in case_networks():
        boxes = net.map.buildings
        grown = boxes + np.array([0, 0, 4.0, 4.0, 0])
        on_road = np.concatenate(
            [line[:, :2] for s in net.map.segments.values() for line in (s.centerline, s.left, s.right)]
            + [resample(b, int(arc_length(b)[-1]) + 2)[:, :2] for b in net.map.road_boundaries]
        )
        assert boxes.shape[1:] == (5,)
        assert not inside_boxes(grown, on_road).any()
        standing += len(boxes)
    assert standing > 300


def test_crossings_are_closed_quadrilaterals_that_cross_lanes_with_a_walk_each():
    rings = 0
    for net in case_networks():
        assert len(net.walk_across) == len(net.map.crossings)
        for ring, walk in zip(net.map.crossings, net.walk_across, strict=True):
            assert ring.shape == (5, 3)
            np.testing.assert_array_equal(ring[0], ring[-1])
            assert walk.shape == (2, 2)
            lines = [s.centerline for s in net.map.segments.values() if s.vehicle]
            assert any(crossings_of(line, walk).any() for line in lines)
            rings += 1
    assert rings > 40

"""Scenes seen in a mirror: left-hand traffic, and recorded maps that change sides."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tests.shared import shared_path
from tests.world.lane_following import fractions_on_lanes
from tests.world.small_map import ON_MAP, crossroads
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.road_maps import find_maps
from tflane_jax.world.cameras.paint import YELLOW, paint_of
from tflane_jax.world.mirror import markers_beside, mirrored, mirrored_map, mirrored_road_map
from tflane_jax.world.presets import REAL_LIKE
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.roads.road_map import drives_on_left
from tflane_jax.world.roads.sd_map import SdMapConfig
from tflane_jax.world.simulate import Place, WorldConfig, simulate

SCENE = 4
WORLD = WorldConfig(duration_s=4.0, keyframes=2, markers=PlacementConfig(side="both"))


def assert_equal(a, b):
    """All fields of two dataclasses are equal; arrays by value, so that 0.0 is -0.0."""
    for field in fields(a):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if hasattr(one, "__dataclass_fields__"):
            assert_equal(one, other)
        elif isinstance(one, dict):
            assert one.keys() == other.keys()
            for key in one:
                assert_equal(one[key], other[key])
        elif isinstance(one, tuple) and one and hasattr(one[0], "__dataclass_fields__"):
            for x, y in zip(one, other, strict=True):
                assert_equal(x, y)
        elif isinstance(one, tuple):
            for x, y in zip(one, other, strict=True):
                np.testing.assert_array_equal(x, y)
        elif field.name == "buildings":  # turned round twice
            np.testing.assert_allclose(one, other, atol=1e-12)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


@pytest.fixture(scope="module")
def scene():
    return simulate(SCENE, WORLD)


def test_a_mirrored_world_has_the_mirror_images_of_the_same_scenes(scene):
    there = simulate(SCENE, replace(WORLD, mirrored=1.0))
    assert_equal(there, mirrored(scene))
    assert_equal(mirrored(there), scene)
    assert (drives_on_left(scene.map), drives_on_left(there.map)) == (False, True)


def test_the_fraction_of_mirrored_scenes():
    world = replace(WORLD, duration_s=2.2, keyframes=1, mirrored=0.3, traffic=replace(WORLD.traffic, warm_up_s=0.0))
    sides = [drives_on_left(simulate(scene, world).map) for scene in range(40)]
    assert 5 <= sum(sides) <= 20


def test_vehicles_drive_along_the_lanes_of_a_mirrored_scene():
    found = fractions_on_lanes(simulate(SCENE, replace(WORLD, mirrored=1.0)))
    assert len(found) >= 3
    assert found.min() > 0.9


def test_examples_are_mirror_images(scene):
    config = ExampleConfig(sd_map=SdMapConfig(survey=0.0))
    here, there = (make_example(log, 1, config) for log in (scene, mirrored(scene)))
    np.testing.assert_array_equal(here.lanes.valid, there.lanes.valid)
    np.testing.assert_allclose(here.lanes.points * [1, -1, 1], there.lanes.points, atol=1e-4)
    np.testing.assert_allclose(here.segments.left * [1, -1, 1], there.segments.right, atol=1e-4)
    np.testing.assert_array_equal(here.segments.left_type, there.segments.right_type)
    np.testing.assert_array_equal(here.lanes.successor, there.lanes.successor)
    np.testing.assert_allclose(here.lanes.visibility, there.lanes.visibility, atol=0.1)
    np.testing.assert_array_equal(here.areas.category, there.areas.category)
    ends = (np.sort(np.abs(one.areas.points[:, [0, -1]]), 1) for one in (here, there))  # edges run the other way
    np.testing.assert_allclose(*ends, atol=1e-3)
    for name in ("valid", "category"):
        np.testing.assert_array_equal(getattr(here.traffic_flow, name), getattr(there.traffic_flow, name))
    np.testing.assert_allclose(here.sd_map.points * [1, -1], there.sd_map.points, atol=1e-4)


def test_markers_stay_readable(scene):
    there = mirrored(scene).markers
    assert len(there.pose) > 0
    np.testing.assert_allclose(np.linalg.det(there.pose[:, :3, :3]), 1.0, atol=1e-9)
    np.testing.assert_array_equal(there.pose[:, :3, 2], scene.markers.pose[:, :3, 2] * [1, -1, 1])  # where it faces
    np.testing.assert_array_equal(there.pose[:, 2, 1], scene.markers.pose[:, 2, 1])  # what is up


def test_everything_on_the_ground_is_on_the_other_side(scene):
    here, there = scene.map, mirrored_map(scene.map)
    assert len(here.road_boundaries) * len(here.crossings) * len(here.elements) * len(here.buildings) > 0
    for name in ("road_boundaries", "crossings", "roads"):
        for one, other in zip(getattr(here, name), getattr(there, name), strict=True):
            other = other[::-1] if name == "road_boundaries" else other
            np.testing.assert_array_equal(one * [1, -1, 1], other, err_msg=name)
    for one, other in zip(here.elements, there.elements, strict=True):
        np.testing.assert_allclose([np.cos(one.yaw), -np.sin(one.yaw)], [np.cos(other.yaw), np.sin(other.yaw)])
    # The left side of a building is its front.
    fronts = [
        np.stack([x - 0.5 * width * np.sin(yaw), y + 0.5 * width * np.cos(yaw)], 1)
        for x, y, _, width, yaw in (buildings.T for buildings in (here.buildings, there.buildings))
    ]
    np.testing.assert_allclose(fronts[0] * [1, -1], fronts[1], atol=1e-9)


def test_the_line_between_directions_is_yellow_on_both_sides(scene):
    """The same lines are yellow: those beside oncoming lanes."""
    found = []
    for side, road_map in ((1, scene.map), (-1, mirrored_map(scene.map))):
        paint = paint_of(np.random.default_rng(1), road_map, paint_wear=0.0, log_seed=0)
        middle = paint.corners[(paint.colour == YELLOW).all(-1)].mean(1) * [1, side]
        found.append(middle[np.lexsort(middle.round(3).T)])
    assert len(found[0]) > 10
    np.testing.assert_allclose(*found, atol=1e-6)


def test_signs_of_left_turns_show_right_turns(scene):
    element = replace(scene.map.elements[0], attribute=5)
    (there,) = mirrored_map(replace(scene.map, elements=(element,))).elements
    assert there.attribute == 6
    assert there.position.tolist() == (element.position * [1, -1, 1]).tolist()
    every = [replace(element, attribute=i) for i in range(13)]
    swapped = [e.attribute for e in mirrored_map(replace(scene.map, elements=tuple(every))).elements]
    assert swapped == [0, 1, 2, 3, 4, 6, 5, 8, 7, 9, 10, 12, 11]


def test_a_map_of_left_hand_traffic_has_the_mirror_images_of_its_mirror_image():
    here, there = (Place(found, 50.0) for found in (crossroads(), mirrored_road_map(crossroads())))
    assert (drives_on_left(here.road_map.map), drives_on_left(there.road_map.map)) == (False, True)
    scene = simulate(3, ON_MAP, place=here)
    assert_equal(simulate(3, ON_MAP, place=there), mirrored(scene))
    # Its own mirror image drives on the right.
    assert_equal(simulate(3, replace(ON_MAP, mirrored=1.0), place=there), scene)


def test_virtual_markers_of_a_recorded_map_stand_on_the_side_of_its_traffic():
    here, there = crossroads().map, mirrored_road_map(crossroads()).map
    right, left = (markers_beside(found, 3, PlacementConfig()) for found in (here, there))
    assert len(right.pose) > 0
    np.testing.assert_array_equal(right.marker_id, left.marker_id)
    np.testing.assert_allclose(left.pose[:, :3, 3], right.pose[:, :3, 3] * [1, -1, 1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(left.pose[:, :3, :3]), 1.0, atol=1e-9)
    asked = []
    markers_beside(there, 3, PlacementConfig(site="clear"), lambda place, _: asked.append(place[1]) or 1.0)
    assert {round(y, 3) for y in left.pose[:, 1, 3]} <= {round(y, 3) for y in asked}


def test_without_oncoming_lanes_traffic_keeps_to_the_right():
    found = crossroads().map
    (first, *_), none = found.segments.items(), replace(found, segments={})
    assert not drives_on_left(none)
    assert not drives_on_left(replace(found, segments=dict([first])))


def test_sides_of_recorded_maps():
    left = {"scene-0061", "scene-0796", "scene-1077", "scene-1094", "scene-1100"}
    found = {one.name: drives_on_left(one.read().map) for one in find_maps(shared_path("data"))}
    assert {name for name, on_left in found.items() if on_left} == left
    assert len(found) == 9


def test_real_like_has_both_sides():
    assert 0.0 < REAL_LIKE.mirrored < 1.0

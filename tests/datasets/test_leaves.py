"""Examples as named arrays and back."""

from dataclasses import fields, is_dataclass

import jax
import numpy as np
import pytest

from tests.fakes import fake_example, fake_views
from tests.models.cases import make_bucket_example
from tflane_jax.datasets.leaves import PARTS, example_from_leaves, example_leaves
from tflane_jax.scene import Example, MapLines, MarkerObservations, SdMap, VehicleState


def full_example() -> Example:
    """An example with every part present."""
    markers = MarkerObservations(
        marker_id=np.arange(2),
        pose=np.zeros((2, 4, 4)),
        score=np.ones(2),
        residual=np.zeros(2),
        lanes=np.zeros((2, 3, 4, 3)),
        lane_valid=np.ones((2, 3), bool),
        successor=np.zeros((2, 3, 3), bool),
        valid=np.ones(2, bool),
    )
    sd_map = SdMap(points=np.ones((1, 5, 2)), category=np.zeros(1, int), valid=np.ones(1, bool))
    lines = MapLines.empty(2, 4)
    return fake_example().replace(markers=markers, sd_map=sd_map, cameras=fake_views(), map_lines=lines)


def test_every_container_of_an_example_is_known():
    example = full_example()
    containers = {f.name for f in fields(Example) if is_dataclass(getattr(example, f.name))}
    assert containers == set(PARTS)
    assert all(type(getattr(example, name)) is part for name, part in PARTS.items())


def with_vehicle(can_bus):
    """An example whose images come with what published weights know of the vehicle."""
    state = VehicleState(np.eye(4, dtype=np.float32), np.ones((4, 4), np.float32), can_bus)
    return full_example().replace(cameras=fake_views().replace(vehicle=state))


@pytest.mark.parametrize(
    "example",
    [
        full_example(),
        with_vehicle(np.arange(18.0)),
        with_vehicle(None),
        make_bucket_example(),
        fake_example(),
        fake_example().replace(bev=None),
    ],
)
def test_round_trip_gives_the_same_arrays(example):
    leaves = example_leaves(example)
    again = example_from_leaves(leaves)
    assert len(leaves) == len(jax.tree.leaves(example))
    assert jax.tree.structure(again) == jax.tree.structure(example)
    jax.tree.map(np.testing.assert_array_equal, again, example)


def test_every_leaf_is_an_array_of_numbers():
    """A container in a container would be one object, which no device takes."""
    leaves = example_leaves(with_vehicle(np.arange(18.0)))
    assert leaves["cameras.vehicle.can_bus"].shape == (18,)
    assert all(leaf.dtype.kind in "biuf" for leaf in leaves.values())


def test_names_say_where_an_array_belongs():
    leaves = example_leaves(fake_example())
    assert {"bev", "lanes.points", "traffic_flow.valid"} <= set(leaves)
    assert not any(name.startswith("markers") for name in leaves)

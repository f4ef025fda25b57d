"""Stacking of examples and its inverse; what `validate` finds."""

import re

import jax
import numpy as np
import pytest

from tests.models.cases import make_bucket_example, make_depth_example, make_example, make_line_example
from tests.models.test_padding import with_priors
from tests.shared import assert_same
from tflane_jax.scene import VehicleState, row_of, stack_examples


@pytest.mark.parametrize("on_device", [False, True])
def test_a_row_of_a_batch_is_the_example_as_arrays_on_the_host(on_device):
    examples = [make_example(seed) for seed in (0, 1)]
    batch = stack_examples(examples)
    for index, example in enumerate(examples):
        found = row_of(jax.device_put(batch) if on_device else batch, index)
        assert_same(found, example)
        assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(found))


def altered(example, path, value):
    """Return the example with another value in the field with this dotted name."""
    name, _, rest = path.partition(".")
    return example.replace(**{name: altered(getattr(example, name), rest, value) if rest else value})


@pytest.mark.parametrize(
    "example",
    [make_example(), make_line_example(), make_bucket_example(), make_depth_example(0), with_priors(make_example())],
)
def test_examples_that_fit_are_valid(example):
    example.validate()


@pytest.mark.parametrize(
    ("path", "shape"),
    [
        ("bev", (24, 40)),
        ("hidden", (24, 39)),
        ("traffic_flow.position", (9, 25, 2)),
        ("traffic_flow.valid", (9,)),
        ("markers.successor", (1, 2, 3)),
        ("sd_map.category", ()),
        ("lanes.points", (8, 3)),
        ("lanes.left", (8, 10, 3)),
        ("areas.valid", (2,)),
        ("traffic_elements.lane", (5, 3)),
        ("traffic_elements.segment", (5, 3)),
        ("cameras.camera_from_ego", (3, 3)),
        ("cameras.vehicle.can_bus", (17,)),
        ("map_lines.visibility", (2,)),
        ("previous_from_ego", (1, 4, 4)),
        ("has_previous", (1,)),
    ],
)
def test_the_field_of_a_wrong_shape_is_named(path, shape):
    example = with_priors(make_bucket_example()).replace(map_lines=make_line_example().map_lines)
    example = example.replace(
        bev=np.zeros((24, 40, 4), np.uint8),
        hidden=np.zeros((24, 40), bool),
        traffic_flow=make_example().traffic_flow,
        cameras=example.cameras.replace(vehicle=VehicleState(np.eye(4), np.eye(4), np.zeros(18))),
    )
    example.validate()
    wrong = altered(example, path, np.zeros(shape, bool))
    with pytest.raises(AssertionError, match=rf"^{path} (is of shape {re.escape(str(shape))}|has 5 rows), expected"):
        wrong.validate()


@pytest.mark.parametrize(
    ("path", "kind", "said"),
    [
        ("bev", np.float32, "is float32, expected uint8"),
        ("lanes.valid", np.uint8, "is uint8, expected bool"),
        ("lanes.points", np.int64, "is int64, expected float"),
        ("areas.category", np.float32, "is float32, expected int"),
        ("areas.category", np.uint8, None),
        ("lanes.points", np.float16, None),
    ],
)
def test_the_field_of_another_type_is_named(path, kind, said):
    """Regression: a mask of integers trained, and its evaluation failed; evidence of floats was divided by 255."""
    example = make_example()
    owner, _, name = path.rpartition(".")
    array = np.asarray(getattr(getattr(example, owner) if owner else example, name)).astype(kind)
    changed = altered(example, path, array)
    if said is None:
        changed.validate()
    else:
        with pytest.raises(AssertionError, match=rf"^{path} {said}$"):
            changed.validate()


def test_lengths_of_other_fields_are_told():
    lanes = make_example().lanes
    with pytest.raises(AssertionError, match=r"left is of shape \(8, 10, 3\), expected \(8, 11, 3\)"):
        lanes.replace(left=np.zeros((8, 10, 3))).validate()


def test_depth_without_its_mask_is_found():
    with pytest.raises(AssertionError, match=r"^cameras\.depth and depth_valid"):
        altered(make_depth_example(0), "cameras.depth_valid", None).validate()


def test_a_missing_field_is_named():
    with pytest.raises(AssertionError, match=r"^lanes is None"):
        make_example().replace(lanes=None).validate()

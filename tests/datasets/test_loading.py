"""Loading a dataset into memory: stacking, parts of examples, errors."""

import jax
import numpy as np
import pytest

from tests.fakes import FakeConfig, FakeDataset, UnevenDataset
from tflane_jax.datasets.cache import cached
from tflane_jax.datasets.loading import TRAINING_PARTS, keep, load_arrays
from tflane_jax.errors import UserError
from tflane_jax.scene import Example, stack_examples


@pytest.fixture(params=["made", "cached"])
def dataset(request, tmp_path):
    made = FakeDataset(FakeConfig(size=5))
    return made if request.param == "made" else cached(made, root=tmp_path, workers=1, progress=False)


def load(dataset, **options) -> Example:
    return load_arrays(dataset, progress=False, **options)


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)
    assert [leaf.dtype for leaf in jax.tree.leaves(a)] == [leaf.dtype for leaf in jax.tree.leaves(b)]


def test_arrays_are_the_examples_stacked(dataset):
    arrays = load(dataset)
    assert len(arrays.has_previous) == 5
    assert_same(arrays, stack_examples([FakeDataset(FakeConfig()).example(i) for i in range(5)]))


def test_parts_that_are_not_asked_for_are_dropped(dataset):
    arrays = load(dataset, parts=("lanes",))
    assert arrays.bev is arrays.hidden is arrays.traffic_flow is arrays.traffic_elements is None
    assert arrays.segments.points.shape == (5, 0, 2, 3)
    assert arrays.areas.valid.shape == (5, 0)
    assert arrays.has_previous.shape == (5,)
    np.testing.assert_array_equal(arrays.lanes.valid, load(dataset).lanes.valid)
    assert_same(arrays, keep(load(dataset), ("lanes",)))


def test_training_keeps_what_a_model_sees_and_the_lanes(dataset):
    arrays = keep(load(dataset), TRAINING_PARTS)
    assert_same(arrays, load(dataset, parts=TRAINING_PARTS))
    assert arrays.bev is not None
    assert arrays.traffic_flow is not None
    assert arrays.lanes.points.shape[1] > 0
    assert arrays.hidden is None
    for index in range(5):
        jax.tree.map(lambda leaf, i=index: leaf[i], arrays).validate()


def test_an_unknown_part_is_named(dataset):
    with pytest.raises(ValueError, match="no field of Example: lane"):
        load(dataset, parts=("lane",))


def test_an_empty_dataset_and_uneven_examples_are_refused():
    with pytest.raises(UserError, match="no examples"):
        load(FakeDataset(FakeConfig(size=0)))
    with pytest.raises(ValueError, match="bev is"):
        load(UnevenDataset(FakeConfig()))

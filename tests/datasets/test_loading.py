"""Loading a dataset into memory: stacking, parts of examples, errors."""

import pickle

import jax
import numpy as np
import pytest

from tests.fakes import BrokenDataset, FakeConfig, FakeDataset, UnevenDataset
from tflane_jax.datasets.batches import batches
from tflane_jax.datasets.cache import cached
from tflane_jax.datasets.loading import TRAINING_PARTS, keep, load_arrays, load_or_stream
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
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


@pytest.mark.parametrize("process", [0, 1])
def test_the_first_process_shows_that_it_loads_and_each_that_it_builds(process, tmp_path, monkeypatch, capsys):
    """Regression: all showed the loading. A cache is built by one process, which need not be the first."""
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(jax, "process_index", lambda: process)
    load_arrays(FakeDataset(FakeConfig(size=5)))
    cached(FakeDataset(FakeConfig(size=5)), root=tmp_path, workers=1)
    shown = capsys.readouterr().err
    assert ("loading fake: 100%" in shown) == (process == 0)
    assert "building fake: 100%" in shown


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


def test_memory_and_disk_give_the_same_batches(dataset):
    parts = ("lanes", "bev")
    kept, read, chosen = (
        load_or_stream(dataset, False, parts, StreamingConfig(where=where)) for where in ("memory", "disk", "auto")
    )
    assert isinstance(read, Streamed)
    assert not isinstance(kept, Streamed)
    assert_same(kept, chosen)
    for one, other in zip(*(batches(data, (3,), range(4), 2) for data in (kept, read)), strict=True):
        assert_same(one, other)


def test_cached_examples_are_read_by_part_and_opened_by_other_processes(tmp_path):
    whole = cached(FakeDataset(FakeConfig(size=5)), root=tmp_path, workers=1, progress=False)
    few = whole.only(("lanes", "has_previous"))
    assert few.example(3).bev is None
    assert whole.example(3).bev is not None
    assert few.scene(3) == few.info(3).scene
    sent = pickle.dumps(few)
    assert len(sent) < 1000  # not the arrays
    assert_same(pickle.loads(sent).example(3), few.example(3))
    next(tmp_path.glob("fake-*/lanes.points.npy")).unlink()
    with pytest.raises(UserError, match=r"changed while they were used .*lanes\.points\.npy"):
        pickle.loads(sent)


def test_corrupt_examples_are_not_streamed(tmp_path):
    whole = cached(FakeDataset(FakeConfig(size=5)), root=tmp_path, workers=1, progress=False)
    path = next(tmp_path.glob("fake-*/lanes.points.npy"))
    path.write_bytes(path.read_bytes()[:-1] + b"\x55")
    with pytest.raises(UserError, match=r"lanes\.points\.npy is corrupt"):
        load_or_stream(whole, False, ("lanes",), StreamingConfig(where="disk"))
    load_or_stream(whole, False, ("bev",), StreamingConfig(where="disk"))  # reads other files


def test_an_unknown_part_is_named(dataset):
    with pytest.raises(ValueError, match="no field of Example: lane"):
        load(dataset, parts=("lane",))


def test_an_empty_dataset_and_uneven_examples_are_refused():
    with pytest.raises(UserError, match="no examples"):
        load(FakeDataset(FakeConfig(size=0)))
    with pytest.raises(UserError, match="no examples"):
        load_or_stream(FakeDataset(FakeConfig(size=0)), False, ("lanes",), StreamingConfig(where="disk"))
    with pytest.raises(UserError, match="bev is"):
        load(UnevenDataset(FakeConfig()))


class Changed(FakeDataset):
    """A dataset with another example at one place."""

    place = 2

    def changed(self, example: Example) -> Example:
        return example.replace(traffic_flow=None)

    def example(self, index: int) -> Example:
        example = super().example(index)
        return self.changed(example) if index == self.place else example


class Converted(Changed):
    def changed(self, example: Example) -> Example:
        return example.replace(bev=np.asarray(example.bev, np.float32) / 255.0)


class Misfit(Changed):
    place = 0

    def changed(self, example: Example) -> Example:
        return example.replace(lanes=example.lanes.replace(successor=np.zeros((3, 3), bool)))


class AbsentAtFirst(Changed):
    place = 0


class IntegerMask(Misfit):
    def changed(self, example: Example) -> Example:
        return example.replace(lanes=example.lanes.replace(valid=np.asarray(example.lanes.valid, np.uint8)))


class NoNumber(Changed):
    def changed(self, example: Example) -> Example:
        points = np.array(example.lanes.points)
        points[np.flatnonzero(example.lanes.valid)[0], 1, 2] = np.nan
        return example.replace(lanes=example.lanes.replace(points=points))


class OnAMap(Changed):
    def changed(self, example: Example) -> Example:
        lanes = example.lanes
        return example.replace(lanes=lanes.replace(points=np.asarray(lanes.points) + np.float32(345_678.0)))


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Changed, r"traffic_flow\.\w+ is absent in example 2 and \w+ of shape .* in example 0"),
        (AbsentAtFirst, r"traffic_flow\.\w+ is \w+ of shape .* in example 1 and absent in example 0"),
        (Converted, "bev is float32 of shape .* in example 2 and uint8 of shape"),
        (IntegerMask, r"in example 0, lanes\.valid is uint8, expected bool"),
        (NoNumber, r"lanes of example 2 have a point that is not finite"),
        (OnAMap, r"lanes of example 2 reach 346 km from the vehicle: their points must be in its own frame in metres"),
        (Misfit, r"in example 0, lanes\.successor is of shape \(3, 3\), expected"),
    ],
)
def test_examples_that_do_not_stack_are_named(kind, said):
    """Regression: an absent part was memory that nobody had written, another type was converted."""
    dataset = kind(FakeConfig(size=5))
    with pytest.raises(UserError, match=said):
        load(dataset)

    def stream_all():
        streamed = load_or_stream(dataset, False, TRAINING_PARTS, StreamingConfig(where="disk"))
        assert isinstance(streamed, Streamed)
        for index in range(len(dataset)):
            streamed.example(index)

    with pytest.raises(UserError, match=said):
        stream_all()


@pytest.mark.parametrize("workers", [None, StreamingConfig(threads=1)])
def test_an_example_that_cannot_be_made_is_named(workers):
    with pytest.raises(RuntimeError, match=r"broken\n\(raised by example 2 of fake\)"):
        load(BrokenDataset(FakeConfig(4)), workers=workers)

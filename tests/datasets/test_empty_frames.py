"""Training without frames that have no lanes."""

import jax
import numpy as np
import pytest

from tests.fakes import FakeConfig, FakeDataset, empty_example, fake_example
from tflane_jax.datasets.batches import batches
from tflane_jax.datasets.empty_frames import has_truth, without_empty
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.scene import LineClass, MapLines, stack_examples


class Gaps(FakeDataset):
    """Every third example has nothing valid."""

    def example(self, index):
        return empty_example() if index % 3 == 0 else super().example(index)


class Empty(FakeDataset):
    def example(self, index):
        return empty_example()


def test_only_the_named_parts_count_and_of_areas_only_crossings():
    example = fake_example()
    assert has_truth(example, ["lanes"])
    assert not has_truth(example, ["segments"])
    assert not has_truth(example, ["segments", "map_lines"])
    assert has_truth(example, ["segments", "areas"])
    example.areas.category[:] = 2
    assert not has_truth(example, ["segments", "areas"])


def test_lines_of_classes_that_are_not_learned_do_not_count():
    lines = MapLines.empty(2, 3)
    lines.valid[0], lines.category[0] = True, LineClass.CENTERLINE
    example = fake_example().replace(map_lines=lines)
    assert has_truth(example, ["map_lines"])
    assert has_truth(example, ["map_lines"], 4)
    assert not has_truth(example, ["map_lines"], 3)
    with pytest.raises(UserError, match="empty_frames=keep"):
        without_empty(stack_examples([example]), ["map_lines"], 3)


def test_examples_in_memory_are_selected_and_clips_need_one_frame():
    arrays = stack_examples([Gaps(FakeConfig(6)).example(i) for i in range(6)])
    kept = without_empty(arrays, ["lanes"])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[[1, 2, 4, 5]]), kept, arrays)
    clips = jax.tree.map(lambda leaf: leaf.reshape(3, 2, *leaf.shape[1:]), arrays)
    assert without_empty(clips, ["lanes"]) is clips
    with pytest.raises(UserError, match="empty_frames=keep"):
        without_empty(arrays, ["segments"])


def test_a_stream_draws_another_example_and_depends_on_seed_and_step_alone():
    def drawn(threads, steps):
        data = Streamed(Gaps(FakeConfig(9)), StreamingConfig(threads=threads, ahead=4))
        return [batch[0] for batch in batches(without_empty(data, ["lanes"]), [3], steps, 4)]

    whole = drawn(2, range(6))
    assert all(np.asarray(batch.lanes.valid).any(-1).all() for batch in whole)
    for one, other in zip(whole[4:], drawn(0, range(4, 6)), strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_stream_of_nothing_is_an_error():
    data = without_empty(Streamed(Empty(FakeConfig(3)), StreamingConfig(threads=0)), ["lanes"])
    with pytest.raises(UserError, match="none has any lanes"):
        next(batches(data, [0], range(1), 2))

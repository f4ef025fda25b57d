"""Counts of the contents of a dataset."""

import numpy as np

from tests.fakes import empty_example, fake_example
from tflane_jax.plots.summary import dataset_summary
from tflane_jax.scene import LineClass, MapLines, stack_examples


def summary(*examples) -> dict:
    return {row["quantity"]: row for row in dataset_summary(stack_examples(list(examples)))}


def test_quantities_are_counted_over_the_examples():
    full = fake_example(1)
    full.lanes.valid[:] = True
    rows = summary(fake_example(0), full)
    # Five slots for lanes: two used in the first example, all in the second; visibility is 0.25, 1, 0, 0, 0.
    assert rows["lanes"] == {
        "quantity": "lanes",
        "mean": 3.5,
        "least": 2,
        "most": 5,
        "capacity": 5,
        "full": 0.5,
    }
    assert rows["- out of sight"]["mean"] == (1 + 4) / 2
    assert rows["- fraction in line of sight"]["mean"] == np.mean([1.25 / 2, 1.25 / 5])
    assert rows["- topology links"]["most"] == 1
    assert rows["- crossings"]["mean"] == 1
    assert rows["road users"]["most"] == 2
    assert rows["- frames of each"]["mean"] == 4
    assert rows["- fraction of boxes not seen"]["mean"] == 1 / 8
    assert rows["fraction of ground out of sight"]["mean"] == 15 / 200


def test_padding_changes_nothing():
    assert summary(fake_example(0)) == summary(fake_example(0, padding=np.nan))


def test_examples_without_a_quantity_do_not_count_in_its_mean():
    rows = summary(fake_example(0), empty_example())
    assert rows["- fraction in line of sight"]["mean"] == 1.25 / 2
    assert rows["lanes"]["least"] == 0
    assert summary(empty_example())["- frames of each"]["mean"] is None


def test_quantities_that_a_dataset_lacks_have_no_row():
    bare = fake_example().replace(hidden=None, traffic_flow=None, traffic_elements=None)
    assert not {"road users", "fraction of ground out of sight", "traffic lights and signs"} & set(summary(bare))


def test_lines_of_a_map_are_counted_by_class():
    lines = MapLines.empty(4, 5)
    lines.category[:3], lines.valid[:3] = [LineClass.DIVIDER, LineClass.DIVIDER, LineClass.BOUNDARY], True
    lines.visibility[:] = 0.2, 1.0, 1.0, 0.0
    rows = summary(fake_example().replace(map_lines=lines))
    assert (rows["map lines"]["mean"], rows["map lines"]["capacity"]) == (3, 4)
    assert [rows[f"- {name}"]["mean"] for name in ("divider", "crossing", "boundary", "centerline")] == [2, 0, 1, 0]
    assert rows["- lines out of sight"]["mean"] == 1
    assert "map lines" not in summary(fake_example())

"""The benchmarks' own arithmetic; no time is ever asserted."""

import numpy as np

from benchmarks.timing import compile_jax, interleave, markdown_table, summarise


def test_ratio_is_taken_round_by_round():
    times = {"a": np.array([1.0, 10.0, 1.0]), "b": np.array([2.0, 20.0, 4.0])}
    rows = summarise(times, "a")
    assert rows["a"]["ratio"] == 1.0
    assert rows["b"]["ratio"] == 2.0
    assert rows["b"]["rounds"] == 3


def test_every_program_runs_in_every_round():
    calls = {"a": 0, "b": 0}

    def program(name):
        calls[name] += 1

    times = interleave({name: lambda name=name: program(name) for name in calls}, seconds=0.0, least_rounds=4)
    assert {len(values) for values in times.values()} == {4}
    assert min(calls.values()) >= 4


def test_compiled_program_sees_its_arguments():
    entry = compile_jax(lambda x, y: x @ y, np.eye(3, dtype=np.float32), np.full((3, 3), 2.0, np.float32))
    np.testing.assert_array_equal(entry.program(), np.full((3, 3), 2.0))
    assert entry.seconds > 0


def test_table_is_aligned():
    lines = markdown_table(["name", "ms"], [["a", "1.0"], ["longer", "12.0"]]).splitlines()
    assert len({len(line) for line in lines}) == 1

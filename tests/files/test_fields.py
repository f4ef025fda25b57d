"""Entries of JSON files that are parsed only in part; names, numbers and sizes that no reader believes."""

import json

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.files.fields import (
    file_within,
    fractions,
    is_name,
    is_whole,
    load_json,
    load_members,
    member,
    numbers,
    scores,
    truth_values,
    whole_number,
)

RECORD = {"a": [1, {"b": "}"}], "pose": {"x": 1.5}, "é": None, "long": "z"}


@pytest.mark.parametrize("indent", [None, 2, "\t"])
@pytest.mark.parametrize("names", [(), ("a",), ("pose", "a"), ("long",), ("none",), ("none", "a")])
def test_entries_are_those_of_the_whole_file(tmp_path, names, indent):
    path = tmp_path / "record.json"
    path.write_text(json.dumps(RECORD, indent=indent), encoding="utf-8")
    assert load_members(path, names) == {name: RECORD[name] for name in names if name in RECORD}


def told(read):
    """Return what is read, or the text of the error."""
    try:
        return read()
    except UserError as error:
        return str(error)


@pytest.mark.parametrize("text", ["", "{", "[1]", "null", "{}", '{"a" 1}', '{"a": 1 "b": 2}', "{1: 2}", "x"])
def test_what_is_no_object_with_the_entry_is_told_as_by_reading_all(tmp_path, text):
    path = tmp_path / "record.json"
    path.write_text(text)
    assert told(lambda: load_members(path, ("pose",))) == told(lambda: load_json(path))


def test_nothing_is_parsed_after_the_last_entry(tmp_path):
    path = tmp_path / "record.json"
    path.write_text(json.dumps(RECORD)[:-20] + "here is the fault")
    assert load_members(path, ("pose", "a")) == {"a": RECORD["a"], "pose": RECORD["pose"]}
    with pytest.raises(UserError, match="no JSON file"):
        load_members(path, ("long",))


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.jpg", "a/../../b.jpg", "a\0.jpg", "\ud800.jpg", None, 7])
def test_a_name_that_leads_out_of_the_folder_is_refused(tmp_path, name):
    assert file_within(tmp_path, "a/b.jpg", "x") == tmp_path / "a" / "b.jpg"
    with pytest.raises(
        UserError, match=r"^here(:.* is not within the folder| is .*, expected the name of a file)"
    ) as error:
        file_within(tmp_path, name, "here")
    str(error.value).encode()


HUGE = 10**5000  # Python refuses to write it


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda: whole_number(HUGE, 0, 5, "x"), "x is an integer of many digits, expected a whole number from 0 to 5"),
        (lambda: whole_number([HUGE], 0, 5, "x"), "x is a value of type list, expected a whole number from 0 to 5"),
        (lambda: member({HUGE: 1}, "a", "x"), "x lacks the entry 'a' (it has an integer of many digits)"),
        (lambda: member({(HUGE,): 1}, "a", "x"), "x lacks the entry 'a' (it has a value of type tuple)"),
    ],
)
def test_huge_integers_of_pickles_are_named(read, message):
    assert told(read) == message


@pytest.mark.parametrize(
    "value", [np.timedelta64(1, "Y"), np.timedelta64("NaT"), np.array([1.0, np.timedelta64(1, "s")], object)]
)
def test_durations_are_no_numbers(value):
    """Regression: numpy's durations are of its whole numbers' type, so that a year was the number 1."""
    with pytest.raises(UserError, match=r"^here (is of type timedelta64|holds a value)"):
        numbers(value, value.shape, "here")
    assert not is_name(value)
    assert not is_whole(value)
    assert is_name(np.int64(3))


@pytest.mark.parametrize("row", [np.array([True, False]), [np.array(True), 0.0], [True, 0.0]])
def test_truth_values_among_numbers_are_found_in_arrays_too(row):
    """Regression: an array of truth values within a list of numbers became zeros and ones."""
    with pytest.raises(UserError, match=r"^here holds a truth value"):
        numbers([row, np.array([0.5, 2.0])], (2, 2), "here")
    with pytest.raises(UserError, match=r"^here holds a truth value"):
        scores([0.5, np.array(True)], "here")


def doubled(value, times):
    """Return lists in lists that hold a value 2^times times, in memory only once."""
    for _ in range(times):
        value = [value, value]
    return value


def cycle():
    one = []
    one.append(one)
    return one


ROWS = [[0.0] * 10_000] * 10_000


@pytest.mark.parametrize(
    ("read", "value"),
    [
        (numbers, doubled(1.0, 26)),
        (numbers, [0.0, doubled([0.0] * 100_000, 10)]),
        (numbers, [np.zeros(100_000)] * 1000),
        (numbers, cycle()),
        *((read, ROWS) for read in (numbers, truth_values, fractions)),
    ],
    ids=["doubled", "behind a number", "arrays", "cycle", *("rows" for _ in range(3))],
)
def test_lists_that_stand_for_too_many_numbers_are_refused(read, value):
    with pytest.raises(UserError, match=r"^x holds more than 10000000 numbers, or lists nested more than 32 deep"):
        read(value, (None, None), "x")

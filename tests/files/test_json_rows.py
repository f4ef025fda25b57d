"""Lists of rows in JSON files, one row after another."""

import json

import pytest

from tflane_jax.errors import UserError
from tflane_jax.files.json_rows import json_rows


@pytest.mark.parametrize("indent", [None, 0, 2])
@pytest.mark.parametrize("rows", [[], [1], [{"a": "]"}, {"b": [1, {"c": '\\"'}]}, None, "x,"]])
def test_rows_are_those_of_the_json_module(tmp_path, rows, indent):
    path = tmp_path / "rows.json"
    path.write_text(" \n" + json.dumps(rows, indent=indent) + "\n ")
    assert list(json_rows(path)) == rows


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1}', "no JSON list: it starts with"),
        (b"", "no JSON list"),
        (b'[1,\n{"a": }]', "Expecting value in line 2"),
        (b"[1,\n2", "expected ',' or ']' in line 2; is the file cut off"),
        (b"[1,", "no JSON file"),
        (b"[1 2]", "expected ',' or ']' in line 1"),
        (b"[1] 2", "something follows the list"),
        (b"[\xff]", "not text"),
        (b"[" * 100_000, "nested too deep"),
        (b"[" + b"1" * 5000 + b"]", "no JSON file that can be read: Exceeds the limit"),
    ],
)
def test_what_is_no_list_is_named(tmp_path, content, message):
    path = tmp_path / "rows.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=message) as error:
        list(json_rows(path))
    assert str(path) in str(error.value)


def test_a_byte_order_mark_is_no_row(tmp_path):
    """Programs on Windows write one."""
    path = tmp_path / "rows.json"
    path.write_text("[1]", encoding="utf-8-sig")
    assert list(json_rows(path)) == [1]


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"cannot read .*none\.json"):
        list(json_rows(tmp_path / "none.json"))

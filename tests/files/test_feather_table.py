"""Damaged feather files are refused by name."""

import pytest

from tflane_jax.errors import UserError
from tflane_jax.files import feather_table
from tflane_jax.files.feather_table import read_columns

pyarrow = pytest.importorskip("pyarrow")
feather = pytest.importorskip("pyarrow.feather")


@pytest.mark.parametrize("kind", ["string", "large_string", "dictionary"])
def test_a_long_text_is_refused(tmp_path, kind):
    """Each of 20,000 texts would take as much memory as the longest, 7 GB in all."""
    path = tmp_path / "annotations.feather"
    column = pyarrow.array(["a"] * 20_000 + ["b" * 100_000])
    column = column.dictionary_encode() if kind == "dictionary" else column.cast(kind)
    feather.write_feather(pyarrow.table({"track_uuid": column}), path)
    with pytest.raises(UserError, match="column track_uuid holds a text of 100000 characters"):
        read_columns(path, {"track_uuid": "text"})
    feather.write_feather(pyarrow.table({"track_uuid": column[:0]}), path)
    assert read_columns(path, {"track_uuid": "text"})["track_uuid"].shape == (0,)


def test_more_rows_than_a_log_has_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "annotations.feather"
    feather.write_feather(pyarrow.table({"length_m": [1.0] * 11}), path)
    assert len(read_columns(path, {"length_m": "number"})["length_m"]) == 11
    monkeypatch.setattr(feather_table, "_MOST_ROWS", 10)
    with pytest.raises(UserError, match=r"annotations\.feather has 11 rows: it is no file of one log"):
        read_columns(path, {"length_m": "number"})
    monkeypatch.setattr(feather_table, "_MOST_BYTES", 100)
    with pytest.raises(UserError, match=r"annotations\.feather has 0 MiB: it is no file of one log"):
        read_columns(path, {"length_m": "number"})


@pytest.mark.parametrize("kind", ["text", "dictionary"])
def test_one_flipped_bit_of_a_text_is_refused(tmp_path, kind):
    path = tmp_path / "annotations.feather"
    text = pyarrow.array(["TRUCK", "BUS", "TRUCK"])
    column = text.dictionary_encode() if kind == "dictionary" else text
    feather.write_feather(pyarrow.table({"category": column}), path, compression="uncompressed")
    assert read_columns(path, {"category": "text"})["category"].tolist() == ["TRUCK", "BUS", "TRUCK"]
    content = bytearray(path.read_bytes())
    content[content.index(b"TRUCK")] ^= 0x80  # no UTF-8 any more
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"annotations\.feather is not a readable feather file"):
        read_columns(path, {"category": "text"})

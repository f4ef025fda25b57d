"""Damaged feather files are refused by name."""

import pytest

from tflane_jax.errors import UserError
from tflane_jax.files.feather_table import read_columns

pyarrow = pytest.importorskip("pyarrow")
feather = pytest.importorskip("pyarrow.feather")


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

"""Damaged checkpoints and other files give errors that name them."""

import collections
import contextlib
import pickle
import zipfile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.convert.torch_files import (
    GRID,
    assert_state,
    of,
    storage,
    tensor,
    write_legacy,
    write_zip,
)
from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.errors import UserError


def test_damaged_files_are_named(tmp_path):
    state = {"a": of(GRID), "b": of(GRID[0])}
    good = {write: write(tmp_path / "good", state).read_bytes() for write in (write_zip, write_legacy)}
    for data in good.values():
        for end in (1, 10, 50, len(data) // 2, len(data) - 100, len(data) - 1):
            (tmp_path / "w.pth").write_bytes(data[:end])
            with pytest.raises(UserError, match=r"w\.pth"):
                read_state_dict(tmp_path / "w.pth")
    flipped = bytearray(good[write_zip])
    flipped[flipped.index(GRID.tobytes()) + 3] ^= 1
    (tmp_path / "w.pth").write_bytes(flipped)
    with pytest.raises(UserError, match=r"w\.pth: a: data/0 does not agree with its checksum"):
        read_state_dict(tmp_path / "w.pth")


@settings(max_examples=150)
@given(st.integers(0, 10**6), st.integers(1, 255), st.sampled_from([write_zip, write_legacy]))
def test_a_flipped_byte_never_escapes(tmp_path_factory, place, change, write):
    folder = tmp_path_factory.mktemp("flip")
    state = {"state_dict": collections.OrderedDict(a=of(GRID), b=tensor(storage(GRID), (6, 4), (1, 6)))}
    data = bytearray(write(folder / "w.pth", state).read_bytes())
    data[place % len(data)] ^= change
    (folder / "w.pth").write_bytes(data)
    # A changed byte may have no effect, or change a name or a number; anything else must be a UserError.
    with contextlib.suppress(UserError):
        got = read_state_dict(folder / "w.pth")
        assert all(array.size <= GRID.size for array in got.values())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid",
            r"a pointer of Git LFS in place of the file. Fetch the file: git lfs pull",
        ),
        (
            b"\x40\x00\x00\x00\x00\x00\x00\x00" + b'{"a": 1}'.ljust(64),
            "a file of safetensors, which is not read. Load it",
        ),
        (b"\x89HDF\r\n\x1a\n" + bytes(64), "a file of HDF5"),
        (b"\x93NUMPY\x01\x00" + bytes(64), "a file of one array"),
        (b"\x08\x08\x12\x07pytorch" + bytes(64), "a file of ONNX"),
        (b"<!DOCTYPE html>\n<html>", r"begins with '<!DOCTYPE html>'.*Download it again"),
        (b"\x1f\x8b\x08\x00", "packed file. Unpack it"),
        (bytes(257) + b"ustar", "packed file. Unpack it"),
        (b"PK\x03\x04", "no PyTorch checkpoint, or it is damaged"),
        (b"\x89PNG\r\n\x1a\n", "no PyTorch checkpoint, or it is damaged"),
        (pickle.dumps(5, 2), "no tensors by name, only a int"),
        (pickle.dumps({"a": GRID}) + pickle.dumps({"a": GRID}), "goes on after its content: was it written twice"),
    ],
)
def test_other_files_are_named(tmp_path, content, message):
    (tmp_path / "w.pth").write_bytes(content)
    with pytest.raises(UserError, match=rf"w\.pth.*{message}"):
        read_state_dict(tmp_path / "w.pth")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(UserError, match=r"cannot read .*nowhere\.pth: No such file"):
        read_state_dict(tmp_path / "nowhere.pth")
    with pytest.raises(UserError, match=r"cannot read .*: Is a directory"):
        read_state_dict(tmp_path)


def test_zip_files_that_are_not_pytorchs(tmp_path):
    path, state = tmp_path / "w.pth", {"a": of(GRID)}
    cases = [
        ({"compression": zipfile.ZIP_DEFLATED}, "is compressed or encrypted. Pack it again"),
        ({"leave_out": ("data.pkl",)}, r"none of PyTorch's \(it has no data\.pkl\)"),
        ({"leave_out": ("data/0",)}, "storage 'data/0' is missing"),
        ({"byteorder": "middle"}, "unknown byte order 'middle'"),
    ]
    for options, message in cases:
        with pytest.raises(UserError, match=message):
            read_state_dict(write_zip(path, state, **options))
    data = bytearray(write_zip(path, state).read_bytes())
    # The flag of encryption, in the directory at the end.
    data[data.rindex(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(UserError, match="is compressed or encrypted"):
        read_state_dict(path)
    write_zip(path, state)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/constants.pkl", b"")
    with pytest.raises(UserError, match=r"a TorchScript program\. Save its weights"):
        read_state_dict(path)
    assert_state(read_state_dict(write_zip(path, state, byteorder="")), {"a": GRID})
    assert_state(read_state_dict(write_zip(path, state, protocol=4)), {"a": GRID})


def test_an_unknown_version_is_named(tmp_path):
    with pytest.raises(UserError, match="version 1002 of PyTorch's format is unknown"):
        read_state_dict(write_legacy(tmp_path / "w.pkl", {"a": of(GRID)}, version=1002))

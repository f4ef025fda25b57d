"""Arrays of .npz files: what is read, and that a small file cannot ask for much memory."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest
from numpy.lib import format as npy

from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.datasets.nuscenes_scene_files import read_scene_file
from tflane_jax.errors import UserError
from tflane_jax.files.npz import read_npz
from tflane_jax.scoring.plain import read_predictions

EIGHT_GB = 2**30  # float64 numbers


def header(count):
    stream = io.BytesIO()
    npy.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (count,)})
    return stream.getvalue()


def write(path, compression, **claims):
    """Write an array of a few bytes whose header claims 8 GB; `claims` are written to the archive's list."""
    content = header(EIGHT_GB)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("points.npy", content + bytes(64))
        for name in claims:
            setattr(archive.filelist[0], name, len(content) + 8 * EIGHT_GB)
    return path


CLAIMS = {
    "header alone": (zipfile.ZIP_STORED, {}),
    "header of a packed array": (zipfile.ZIP_DEFLATED, {}),
    "list of a packed array": (zipfile.ZIP_DEFLATED, {"file_size": 0}),
    "list of an array": (zipfile.ZIP_STORED, {"file_size": 0, "compress_size": 0}),
    "list of an array, packed": (zipfile.ZIP_DEFLATED, {"file_size": 0, "compress_size": 0}),
}


@pytest.mark.parametrize("read", [read_npz, read_predictions, read_scene_file, read_state_dict])
@pytest.mark.parametrize("claim", CLAIMS)
def test_a_small_file_that_claims_gigabytes_is_refused_before_they_are_taken(tmp_path, claim, read):
    compression, claims = CLAIMS[claim]
    path = write(tmp_path / "small.npz", compression, **claims)
    assert path.stat().st_size < 1000
    tracemalloc.start()
    try:
        with pytest.raises(UserError, match=r"small.npz is no .*claim"):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("shape", "kind"), [((1, 40_000_000, 0, 3), "<f4"), ((10**12,), "<U0"), ((10**12,), [])])
def test_an_array_of_no_bytes_claims_no_length(tmp_path, shape, kind):
    """Regression: arrays that are as long as its lanes took gigabytes."""
    stream = io.BytesIO()
    npy.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(tmp_path / "small.npz", "w") as archive:
        archive.writestr("points.npy", stream.getvalue())
    with pytest.raises(UserError, match=r"claims .* places in \d+ bytes"):
        read_npz(tmp_path / "small.npz")


def test_more_than_16_gib_are_refused_even_where_the_file_could_hold_them(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", a=np.zeros(100), b=np.zeros(100))
    monkeypatch.setattr("tflane_jax.files.npz._MOST_MEMORY", 1500)
    with pytest.raises(UserError, match=r"its arrays claim 1.9e\+03 bytes"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_that_numpy_wrote(tmp_path, save):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "zeros": np.zeros(10**6),  # packs as densely as anything
        "texts": np.array(["x", "yy"]),
        "one": np.array(3),
        "none": np.zeros((0, 4), np.int16),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
    }
    save(tmp_path / "a.npz", **arrays)
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("notes.txt", "no array")
    found = read_npz(tmp_path / "a.npz")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def test_what_is_no_file_of_plain_arrays_is_named(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(UserError, match=r"cannot read .*a\.npz: No such file"):
        read_npz(path)
    np.savez(path, a=np.arange(1000))
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[500] ^= 1
    np.savez(path, a=np.array([{}], object))
    for damaged in (b"", b"text", whole[:200], whole[: len(whole) // 2], bytes(flipped), path.read_bytes()):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"a\.npz is no \.npz file of plain arrays, or it is damaged"):
            read_npz(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("a.npy", header(0))
    with pytest.raises(UserError, match=r"a\.npy is compressed in a way that numpy does not write"):
        read_npz(path)

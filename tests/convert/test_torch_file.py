"""PyTorch's checkpoints are read as arrays."""

import argparse
import collections
import io
import pickle

import ml_dtypes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.convert.torch_files import (
    GRID,
    Call,
    Storage,
    assert_state,
    both_formats,
    named,
    of,
    storage,
    tensor,
    write_legacy,
    write_zip,
)
from tflane_jax.convert.torch_file import read_checkpoint, read_state_dict
from tflane_jax.errors import UserError

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("kind", "dtype", "returned"),
    [
        ("FloatStorage", np.float32, np.float32),
        ("DoubleStorage", np.float64, np.float64),
        ("HalfStorage", np.float16, np.float32),
        ("BFloat16Storage", ml_dtypes.bfloat16, np.float32),
        ("CharStorage", np.int8, np.int8),
        ("ByteStorage", np.uint8, np.uint8),
        ("ShortStorage", np.int16, np.int16),
        ("IntStorage", np.int32, np.int32),
        ("LongStorage", np.int64, np.int64),
        ("BoolStorage", np.bool_, np.bool_),
        ("ComplexFloatStorage", np.complex64, np.complex64),
        ("ComplexDoubleStorage", np.complex128, np.complex128),
    ],
    ids=str,
)
@pytest.mark.parametrize("write", [write_zip, write_legacy, "big"])
def test_every_element_type(tmp_path, kind, dtype, returned, write):
    values = (RNG.standard_normal((3, 5)) * 9).astype(dtype)
    if dtype == np.complex64:
        values += 1j
    state = {"a": of(values, kind), "b": tensor(storage(values, kind), (5, 3), (1, 5))}
    if write == "big":
        part = np.dtype(dtype).itemsize // (2 if np.dtype(dtype).kind == "c" else 1)
        swapped = np.frombuffer(values.tobytes(), f"u{part}").byteswap()
        path = write_zip(tmp_path / "w.pth", {"a": tensor(storage(swapped, kind), (3, 5))}, byteorder="big")
        assert_state(read_state_dict(path), {"a": values.astype(returned)})
    else:
        expected = {"a": values.astype(returned), "b": values.T.astype(returned)}
        assert_state(read_state_dict(write(tmp_path / "w.pth", state)), expected)


@both_formats
def test_types_named_beside_the_storage(tmp_path, write):
    values = np.array([0.5, -448, 3], ml_dtypes.float8_e4m3fn)
    whole = np.array([1, 2, 2**32 - 1], np.uint32)

    def untyped(array, name):
        raw = storage(array.view(np.uint8), "UntypedStorage", module="torch.storage")
        rest = (False, {}, named("torch", name))
        return tensor(raw, array.shape, rebuild="_rebuild_tensor_v3", rest=rest)

    state = {"eight": untyped(values, "float8_e4m3fn"), "whole": untyped(whole, "uint32")}
    got = read_state_dict(write(tmp_path / "w.pt", state))
    assert_state(got, {"eight": values.astype(np.float32), "whole": whole})


@both_formats
def test_views_of_a_shared_storage(tmp_path, write):
    grid = storage(GRID)
    state = collections.OrderedDict(
        whole=tensor(grid, (4, 6)),
        transposed=tensor(grid, (6, 4), (1, 6)),
        window=tensor(grid, (2, 3), (6, 2), 6),
        scalar=tensor(grid, (), (), 23),
        repeated=tensor(grid, (3, 4), (0, 6), 1),
        empty=tensor(grid, (0, 6)),
        nothing=of(np.zeros((2, 0))),
    )
    expected = {
        "whole": GRID,
        "transposed": GRID.T,
        "window": GRID[1:3, ::2][:, :3],
        "scalar": GRID[3, 5],
        "repeated": np.broadcast_to(GRID[:, 1], (3, 4)),
        "empty": GRID[:0],
        "nothing": np.zeros((2, 0), np.float32),
    }
    expected = {name: np.asarray(value) for name, value in expected.items()}
    assert_state(read_state_dict(write(tmp_path / "w.pth", state)), expected)


def test_a_storage_that_is_part_of_another(tmp_path):
    root = Storage(GRID.tobytes(), key="7")
    part = Storage(GRID.tobytes(), key="7", view=("9", 6, 12))
    got = read_state_dict(write_legacy(tmp_path / "w.pkl", {"a": tensor(root, (4, 6)), "b": tensor(part, (2, 6))}))
    assert_state(got, {"a": GRID, "b": GRID[1:3]})
    beyond = {"a": tensor(Storage(GRID.tobytes(), view=("9", 6, 12)), (3, 6))}
    with pytest.raises(UserError, match="a: reaches beyond its storage"):
        read_state_dict(write_legacy(tmp_path / "w.pkl", beyond))


@settings(max_examples=40)
@given(st.data())
def test_any_view_inside_its_storage_is_numpys_and_any_other_is_refused(tmp_path_factory, data):
    small = st.integers(0, 5)
    shape = data.draw(st.lists(small, max_size=3))
    strides = data.draw(st.lists(small, min_size=len(shape), max_size=len(shape)))
    offset, size = data.draw(small), data.draw(st.integers(0, 30))
    values = np.arange(size, dtype=np.int64)
    path = tmp_path_factory.mktemp("view") / "w.pth"
    write_zip(path, {"a": tensor(storage(values, "LongStorage"), shape, strides, offset)})
    # Element by element, as the definition of strides says.
    places = np.asarray([offset + np.dot(i, strides) for i in np.ndindex(*shape)], int)
    if places.size and places.max() >= size:
        with pytest.raises(UserError, match="a: reaches beyond its storage"):
            read_state_dict(path)
    else:
        np.testing.assert_array_equal(read_state_dict(path)["a"], values[places].reshape(shape))


@both_formats
def test_wrapped_tensors_are_read(tmp_path, write):
    one = of(GRID)
    utils, tag = "torch._utils", {"tag": 1}
    wrapped = Call(named(utils, "_rebuild_parameter"), one, True, collections.OrderedDict())
    with_state = Call(named(utils, "_rebuild_parameter_with_state"), one, True, {}, tag)
    arguments = (storage(GRID), 0, (4, 6), (6, 1), False, {})
    with_type = Call(
        named("torch._tensor", "_rebuild_from_type_v2"),
        named(utils, "_rebuild_tensor_v2"),
        named("torch", "Tensor"),
        arguments,
        tag,
    )
    signs = tensor(storage(GRID), (4, 6), rest=(False, {}, {"neg": True}))
    old = tensor(storage(GRID), (4, 6), rebuild="_rebuild_tensor", rest=())
    state = collections.OrderedDict(a=wrapped, b=with_state, c=with_type, d=signs, e=old)
    state._metadata = {"": {"version": 1}}
    assert_state(
        read_state_dict(write(tmp_path / "w.pth", state)), dict.fromkeys("abc", GRID) | {"d": -GRID, "e": GRID}
    )


@both_formats
def test_training_checkpoints(tmp_path, write):
    moments = {"exp_avg": of(GRID), "step": of(np.float32(3))}
    checkpoint = {
        "epoch": 12,
        "best": np.float64(0.5),
        "args": argparse.Namespace(lr=1e-4),
        "size": Call(named("torch", "Size"), (2, 3)),
        "device": Call(named("torch", "device"), "cuda", 0),
        "scheduler": {"milestones": collections.Counter([3]), "history": collections.defaultdict(list, {1: [2]})},
        "optimizer": {"state": {0: moments}, "param_groups": [{"lr": 0.1, "params": [0]}], "moments": moments},
        "state_dict": collections.OrderedDict({"module.a": of(GRID), "iterations": 7, "module.b": of(GRID[0])}),
    }
    path = write(tmp_path / "w.tar", checkpoint)
    found = read_checkpoint(path)
    assert_state(found.tensors, {"module.a": GRID, "module.b": GRID[0]})
    assert (found.entry, found.others) == ("state_dict", {"iterations": "a value of type int"})
    assert list(read_state_dict(path, "optimizer/moments")) == ["exp_avg", "step"]
    assert read_checkpoint(path, "optimizer").entry == "optimizer/moments"
    with pytest.raises(UserError, match=r"no entry ema; the file holds epoch, best, args"):
        read_state_dict(path, "ema")
    with pytest.raises(UserError, match=r"no tensors by name in scheduler, only milestones, history"):
        read_state_dict(path, "scheduler")


def test_weights_are_found_under_known_names(tmp_path):
    weights = {"a": of(GRID)}
    for tree, entry in [
        (weights, ""),
        ({"model": weights, "step": of(np.float32(1))}, "model"),
        ({"model": {"state_dict": weights}}, "model/state_dict"),
        ({"whatever": weights}, "whatever"),
        ({"model": weights, "ema": dict(weights)}, "model"),
    ]:
        found = read_checkpoint(write_zip(tmp_path / "w.pth", tree))
        assert (found.entry, list(found.tensors)) == (entry, ["a"])
        assert found.alternatives == (("ema",) if "ema" in tree else ())
    path = write_zip(tmp_path / "w.pth", {"depth": {"b": of(GRID)}, "pose": weights})
    with pytest.raises(UserError, match=r"w\.pth: several sets of tensors.* --entry\), one of: depth, pose"):
        read_state_dict(path)
    assert list(read_state_dict(path, "pose")) == ["a"]
    for nothing, described in [
        ([of(GRID)], "a list"),
        (of(GRID), "a Tensor"),
        ({"epoch": 1}, "epoch"),
        ({}, "nothing"),
    ]:
        with pytest.raises(UserError, match=f"no tensors by name, only {described}"):
            read_state_dict(write_zip(tmp_path / "w.pth", nothing))


def test_a_file_that_contains_itself_terminates(tmp_path):
    tree = {"state_dict": {}, "a": {"b": {}}}
    tree["state_dict"]["model"] = tree["a"]["b"]["c"] = tree
    with pytest.raises(UserError, match="no tensors by name"):
        read_state_dict(write_zip(tmp_path / "w.pth", tree))


def test_arrays_in_npz_and_plain_pickles(tmp_path):
    arrays = {"a": GRID, "b": np.array(3), "names": np.array(["x"])}
    np.savez(tmp_path / "w.npz", **arrays)
    np.savez_compressed(tmp_path / "small.npz", **arrays)
    (tmp_path / "w.pkl").write_bytes(pickle.dumps({"model": arrays, "author": "x"}))
    for name in ("w.npz", "small.npz", "w.pkl"):
        found = read_checkpoint(tmp_path / name)
        assert_state(found.tensors, {"a": GRID, "b": np.array(3)})
        assert found.others == {"names": "text"}
    np.savez(tmp_path / "objects.npz", a=np.array([None]))
    with pytest.raises(UserError, match=r"objects\.npz: a holds Python objects, which are not read"):
        read_state_dict(tmp_path / "objects.npz")


@both_formats
def test_pytorch_reads_the_files_of_these_tests(tmp_path, write):
    torch = pytest.importorskip("torch", reason="needs PyTorch to read the files made for these tests")
    state = collections.OrderedDict(a=of(GRID), b=tensor(storage(GRID, "LongStorage", size=12), (3, 2), (2, 1), 5))
    path = write(tmp_path / "w.pth", {"epoch": 3, "state_dict": state})
    loaded = torch.load(path, weights_only=True)["state_dict"]
    assert_state(read_state_dict(path), {name: value.numpy() for name, value in loaded.items()})


def test_files_of_pytorch_itself(tmp_path):
    torch = pytest.importorskip("torch", reason="needs PyTorch to write real files")
    net = torch.nn.Sequential(torch.nn.Conv2d(2, 3, 1), torch.nn.BatchNorm2d(3))
    base = torch.arange(24.0).reshape(4, 6)
    state = net.state_dict() | {
        "transposed": base.T,
        "row": base[2],
        "strided": base[1:3, ::2],
        "expanded": base[:1].expand(3, 6),
        "parameter": torch.nn.Parameter(base),
        "scalar": torch.tensor(3),
        "empty": base[4:],
        "conjugate": torch.tensor([1 + 2j]).conj(),
        "negative": torch.tensor([1 + 2j]).conj().imag,
    }
    state |= {
        name: base.to(getattr(torch, name)) for name in ("float16", "bfloat16", "int16", "bool", "float64", "uint8")
    }
    state |= {name: base.to(getattr(torch, name)) for name in ("uint16", "float8_e5m2")}
    narrow = (torch.float16, torch.bfloat16, torch.float8_e5m2)
    expected = {
        name: (t.float() if t.dtype in narrow else t.resolve_conj().resolve_neg()).detach().numpy()
        for name, t in state.items()
    }
    for zipped in (True, False):
        file = io.BytesIO()
        torch.save({"epoch": 1, "state_dict": state}, file, _use_new_zipfile_serialization=zipped)
        (tmp_path / "w.pth").write_bytes(file.getvalue())
        assert_state(read_state_dict(tmp_path / "w.pth"), expected)

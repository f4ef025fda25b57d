"""PyTorch's checkpoints come out as arrays, whatever else a file asks for is refused, and nothing in it is run."""

import argparse
import collections
import contextlib
import importlib
import io
import os
import pickle
import struct
import subprocess
import types
import zipfile

import ml_dtypes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.convert.torch_files import Call, Storage, named, of, storage, tensor, write_legacy, write_zip
from tflane_jax.convert.torch_file import read_checkpoint, read_state_dict
from tflane_jax.convert.torch_pickle import ALLOWED
from tflane_jax.errors import UserError
from tflane_jax.files.plain_pickle import Sealed

RNG = np.random.default_rng(0)
GRID = np.arange(24, dtype=np.float32).reshape(4, 6)
both_formats = pytest.mark.parametrize("write", [write_zip, write_legacy])


def assert_state(got, expected):
    assert list(got) == list(expected)
    for name, value in expected.items():
        assert (got[name].dtype, got[name].shape) == (value.dtype, value.shape), name
        np.testing.assert_array_equal(got[name], value, err_msg=name)


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


@settings(max_examples=40, deadline=None)
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
def test_what_wraps_a_tensor(tmp_path, write):
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
    assert (found.entry, found.others) == ("state_dict", ("iterations",))
    assert list(read_state_dict(path, "optimizer/moments")) == ["exp_avg", "step"]
    assert read_checkpoint(path, "optimizer").entry == "optimizer/moments"
    with pytest.raises(UserError, match=r"no entry ema; the file holds epoch, best, args"):
        read_state_dict(path, "ema")
    with pytest.raises(UserError, match=r"no tensors by name in scheduler, only milestones, history"):
        read_state_dict(path, "scheduler")


def test_where_weights_stand(tmp_path):
    weights = {"a": of(GRID)}
    for tree, entry in [
        (weights, ""),
        ({"model": weights, "step": of(np.float32(1))}, "model"),
        ({"model": {"state_dict": weights}}, "model/state_dict"),
        ({"whatever": weights}, "whatever"),
        ({"model": weights, "ema": weights}, "model"),
    ]:
        found = read_checkpoint(write_zip(tmp_path / "w.pth", tree))
        assert (found.entry, list(found.tensors)) == (entry, ["a"])
    path = write_zip(tmp_path / "w.pth", {"depth": {"b": of(GRID)}, "pose": weights})
    with pytest.raises(UserError, match=r"w\.pth: several sets of tensors.* `entry`, one of: depth, pose"):
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


def test_a_file_that_holds_itself_ends(tmp_path):
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
        assert found.others == ("names",)
    np.savez(tmp_path / "objects.npz", a=np.array([None]))
    with pytest.raises(UserError, match=r"objects\.npz is no PyTorch checkpoint.*Object arrays"):
        read_state_dict(tmp_path / "objects.npz")


CLAIMS = {
    "offset": ({"shape": (4, 6), "offset": 1}, "reaches beyond its storage"),
    "stride": ({"shape": (4, 6), "strides": (7, 1)}, "reaches beyond its storage"),
    "negative stride": ({"shape": (4,), "strides": (-1,), "offset": 3}, "impossible sizes"),
    "negative size": ({"shape": (-4, -6), "strides": (6, 1)}, "impossible sizes"),
    "negative offset": ({"shape": (2,), "offset": -8}, "impossible sizes"),
    "ranks": ({"shape": (4, 6), "strides": (1,)}, "impossible sizes"),
    "many axes": ({"shape": (1,) * 65}, "impossible sizes"),
    "fraction": ({"shape": (2.0,), "strides": (1,)}, "impossible sizes"),
    "text": ({"shape": ("2",), "strides": (1,)}, "impossible sizes"),
    "huge": ({"shape": (2**31, 2**31), "strides": (0, 0)}, "more than the file can hold"),
    "beyond 64 bits": ({"shape": (2**70,), "strides": (0,)}, "impossible sizes"),
}


@both_formats
@pytest.mark.parametrize("claim", CLAIMS)
def test_a_tensor_cannot_claim_what_is_not_there(tmp_path, write, claim):
    options, message = CLAIMS[claim]
    path = write(tmp_path / "w.pth", {"fine": of(GRID), "a.weight": tensor(storage(GRID), **options)})
    with pytest.raises(UserError, match=rf"w\.pth: a\.weight: .*{message}"):
        read_state_dict(path)


def test_many_tensors_made_of_one_element_are_refused(tmp_path):
    state = {f"w{i}": tensor(storage(GRID), (2**12, 2**10), (0, 0)) for i in range(5)}
    with pytest.raises(UserError, match=r"w4: has 4194304 elements, more than the file can hold"):
        read_state_dict(write_zip(tmp_path / "w.pth", state))


@both_formats
def test_a_storage_cannot_claim_what_is_not_there(tmp_path, write):
    path = write(tmp_path / "w.pth", {"a": tensor(storage(GRID, size=10**12), (10**7,))})
    with pytest.raises(UserError, match=r"a: has a storage that is cut short"):
        read_state_dict(path)


def test_sorts_of_tensors_that_are_not_read(tmp_path):
    utils = "torch._utils"
    layout = Call(named("torch.serialization", "_get_layout"), "torch.sparse_coo")
    sparse = Call(named(utils, "_rebuild_sparse_tensor"), layout, (of(GRID), of(GRID), (4, 6)))
    scheme = (named("torch", "per_tensor_affine"), 0.1, 0)
    quantised = Call(
        named(utils, "_rebuild_qtensor"), Storage(b"1234", "QInt8Storage"), 0, (4,), (1,), scheme, False, {}
    )
    half = tensor(
        Storage(b"12345678", "UntypedStorage", module="torch.storage"),
        (2,),
        rebuild="_rebuild_tensor_v3",
        rest=(False, {}, named("torch", "complex32")),
    )
    for odd, message in [
        (sparse, "a sparse"),
        (quantised, "a quantised"),
        (half, "has elements of type 'complex32'"),
    ]:
        state = {"fine": {"a": of(GRID)}, "odd": {"b": odd}}
        for write in (write_zip, write_legacy):
            path = write(tmp_path / "w.pth", state)
            with pytest.raises(UserError, match=rf"odd/b: {message}.* Save it as a dense tensor"):
                read_state_dict(path, "odd")
            assert_state(read_state_dict(path, "fine"), {"a": GRID})


EVIL = {
    "os.system": (Call(os.system, "touch SHOULD_NOT_EXIST"), "system"),
    "eval": (Call(eval, "open('SHOULD_NOT_EXIST', 'w')"), "eval"),
    "getattr": (Call(getattr, "x", "upper"), "getattr"),
    "import": (Call(__import__, "os"), "__import__"),
    "popen": (Call(subprocess.Popen, ["touch", "SHOULD_NOT_EXIST"]), "Popen"),
    "numpy.load": (Call(np.load, "x.npy"), "load"),
    "nested load": (Call(pickle.loads, pickle.dumps(Call(os.system, "touch SHOULD_NOT_EXIST"))), "loads"),
    "module": (Call(named("torch.nn.modules.linear", "Linear")), "torch.nn.modules.linear.Linear"),
}


@pytest.mark.parametrize("evil", EVIL)
@pytest.mark.parametrize("where", ["value", "key", "argument", "state", "function"])
@both_formats
def test_anything_else_is_refused_and_not_run(tmp_path, monkeypatch, write, evil, where):
    monkeypatch.chdir(tmp_path)
    thing, name = EVIL[evil]
    weights = collections.OrderedDict(a=of(GRID))
    if where == "value":
        weights["b"] = thing
    elif where == "key":
        weights[thing] = 1
    elif where == "argument":
        weights["b"] = tensor(storage(GRID), (4, 6), rest=(thing, {}))
    elif where == "state":
        weights._metadata = thing
    else:
        rebuild = named("torch._tensor", "_rebuild_from_type_v2")
        weights["b"] = Call(rebuild, thing.reduced[0], named("torch", "Tensor"), thing.reduced[1], {})
    write(tmp_path / "w.pth", {"state_dict": weights})
    with pytest.raises(UserError, match=rf"w\.pth is refused: it names .*{name}.*save its weights alone"):
        read_state_dict(tmp_path / "w.pth")
    assert os.listdir(tmp_path) == ["w.pth"]


WRITTEN_IN_C = (set, frozenset, complex, dict, list, collections.OrderedDict, types.SimpleNamespace)


def global_pickle(module, name, rest=b""):
    """Return a pickle of one name, and of what is done with it."""
    return b"\x80\x02c" + f"{module}\n{name}\n".encode() + rest + b"."


def test_only_the_listed_names_are_reachable(tmp_path):
    path = tmp_path / "w.pkl"
    modules = [
        *("builtins", "os", "sys", "posix", "subprocess", "importlib", "pickle", "copyreg", "operator", "functools"),
        *("types", "ctypes", "collections", "numpy", "_codecs", "argparse"),
    ]
    for module in modules:
        for name in sorted(dir(importlib.import_module(module))):
            if (module, name) not in ALLOWED:
                path.write_bytes(global_pickle(module, name))
                with pytest.raises(UserError, match="is refused: it names"):
                    read_state_dict(path)
    # Dotted names, which newer pickles may ask for, must not lead on from a listed one.
    for module, name in ALLOWED:
        texts = (pickle.SHORT_BINUNICODE + bytes([len(t)]) + t.encode() for t in (module, f"{name}.__class__"))
        path.write_bytes(b"\x80\x04" + b"".join(texts) + b"\x93.")
        with pytest.raises(UserError, match="is refused: it names"):
            read_state_dict(path)


def test_what_is_listed_runs_nothing_and_cannot_be_changed(tmp_path):
    """A pickle may set attributes of what it names: of `x`, `__call__` and `function` here."""
    names = (b"x", b"__call__", b"function", b"__init__")
    attributes = b"}(" + b"".join(b"U" + bytes([len(n)]) + n + b"U\x04evil" for n in names) + b"u"
    for (module, name), value in ALLOWED.items():
        assert isinstance(value, (str, Sealed)) or value in WRITTEN_IN_C, (module, name)
        before = dict(vars(value)) if isinstance(value, type) else value
        for state in (attributes, b"N" + attributes + b"\x86"):
            (tmp_path / "w.pkl").write_bytes(global_pickle(module, name, state + b"b"))
            with pytest.raises(UserError, match="damaged"):
                read_state_dict(tmp_path / "w.pkl")
        assert before == (dict(vars(value)) if isinstance(value, type) else value)


def test_instructions_that_reach_around_the_list_are_refused(tmp_path):
    path = tmp_path / "w.pkl"
    path.write_bytes(b"\x80\x02\x82\x01.")
    with pytest.raises(UserError, match=r"refused.*extension registry"):
        read_state_dict(path)
    # The unpickler would make room for two thousand million objects.
    path.write_bytes(b"\x80\x02}r" + struct.pack("<I", 2**31) + b".")
    with pytest.raises(UserError, match="numbers its objects"):
        read_state_dict(path)


def test_other_objects_outside_the_file_are_refused(tmp_path):
    (tmp_path / "w.pkl").write_bytes(b"\x80\x02U\x05filesQ.")
    with pytest.raises(UserError, match=r"refused.*an object outside the file"):
        read_state_dict(tmp_path / "w.pkl")


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


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 255), st.sampled_from([write_zip, write_legacy]))
def test_a_flipped_byte_never_escapes(tmp_path_factory, place, change, write):
    folder = tmp_path_factory.mktemp("flip")
    state = {"state_dict": collections.OrderedDict(a=of(GRID), b=tensor(storage(GRID), (6, 4), (1, 6)))}
    data = bytearray(write(folder / "w.pth", state).read_bytes())
    data[place % len(data)] ^= change
    (folder / "w.pth").write_bytes(data)
    # Some bytes do not matter, and some change a name or a number; nothing else may come of any.
    with contextlib.suppress(UserError):
        got = read_state_dict(folder / "w.pth")
        assert all(array.size <= GRID.size for array in got.values())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid",
            r"begins with 'version https://git-lfs.*Download it again",
        ),
        (b"<!DOCTYPE html>\n<html>", r"begins with '<!DOCTYPE html>'.*Download it again"),
        (b"\x1f\x8b\x08\x00", "packed file. Unpack it"),
        (bytes(257) + b"ustar", "packed file. Unpack it"),
        (b"PK\x03\x04", "no PyTorch checkpoint, or it is damaged"),
        (b"\x89PNG\r\n\x1a\n", "no PyTorch checkpoint, or it is damaged"),
        (pickle.dumps(5, 2), "no tensors by name, only a int"),
    ],
)
def test_other_files_are_named(tmp_path, content, message):
    (tmp_path / "w.pth").write_bytes(content)
    with pytest.raises(UserError, match=rf"w\.pth.*{message}"):
        read_state_dict(tmp_path / "w.pth")


def test_files_that_are_not_there(tmp_path):
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

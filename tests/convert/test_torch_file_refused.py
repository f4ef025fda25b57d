"""Anything in a checkpoint but tensors is refused and not executed."""

import collections
import importlib
import os
import pickle
import struct
import subprocess
import types

import numpy as np
import pytest

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
from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.convert.torch_pickle import ALLOWED
from tflane_jax.errors import UserError
from tflane_jax.files.plain_pickle import Sealed

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
def test_a_tensor_beyond_its_storage_is_refused(tmp_path, write, claim):
    options, message = CLAIMS[claim]
    path = write(tmp_path / "w.pth", {"fine": of(GRID), "a.weight": tensor(storage(GRID), **options)})
    with pytest.raises(UserError, match=rf"w\.pth: a\.weight: .*{message}"):
        read_state_dict(path)


def test_many_tensors_made_of_one_element_are_refused(tmp_path):
    state = {f"w{i}": tensor(storage(GRID), (2**12, 2**10), (0, 0)) for i in range(5)}
    with pytest.raises(UserError, match=r"w4: has 4194304 elements, more than the file can hold"):
        read_state_dict(write_zip(tmp_path / "w.pth", state))


@both_formats
def test_a_storage_beyond_the_file_is_refused(tmp_path, write):
    path = write(tmp_path / "w.pth", {"a": tensor(storage(GRID, size=10**12), (10**7,))})
    with pytest.raises(UserError, match=r"a: has a storage that is cut short"):
        read_state_dict(path)


def test_unsupported_tensor_types_are_refused(tmp_path):
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
    """Return a pickle of one global name, followed by instructions that use it."""
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


def test_listed_names_run_nothing_and_cannot_be_changed(tmp_path):
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


def test_instructions_that_bypass_the_list_are_refused(tmp_path):
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

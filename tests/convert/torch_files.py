"""Checkpoint files as PyTorch writes them, made without PyTorch: real pickles in which stand-ins carry its names."""

import io
import pickle
import sys
import types
import zipfile
from dataclasses import dataclass, field
from unittest import mock

import numpy as np
import pytest

_FUNCTIONS = {
    "torch._utils": (
        "_rebuild_tensor",
        "_rebuild_tensor_v2",
        "_rebuild_tensor_v3",
        "_rebuild_parameter",
        "_rebuild_parameter_with_state",
        "_rebuild_sparse_tensor",
        "_rebuild_qtensor",
    ),
    "torch._tensor": ("_rebuild_from_type_v2",),
    "torch.serialization": ("_get_layout",),
}
_CLASSES = {
    "torch": (
        "FloatStorage",
        "DoubleStorage",
        "HalfStorage",
        "BFloat16Storage",
        "CharStorage",
        "ByteStorage",
        "ShortStorage",
        "IntStorage",
        "LongStorage",
        "BoolStorage",
        "ComplexFloatStorage",
        "ComplexDoubleStorage",
        "QInt8Storage",
        "Tensor",
        "Size",
        "device",
        "float32",
        "uint16",
        "uint32",
        "float8_e4m3fn",
        "complex32",
        "per_tensor_affine",
    ),
    "torch.storage": ("UntypedStorage",),
    "torch.nn.parameter": ("Parameter",),
    "torch.nn.modules.linear": ("Linear",),
}


def _stand_ins():
    modules = {}
    for names, make in ((_FUNCTIONS, lambda name: lambda *_: None), (_CLASSES, lambda name: type(name, (), {}))):
        for module, members in names.items():
            holder = modules.setdefault(module, types.ModuleType(module))
            for name in members:
                made = make(name)
                made.__module__, made.__qualname__, made.__name__ = module, name, name
                setattr(holder, name, made)
    return modules


_MODULES = _stand_ins()


def named(module, name):
    """Return the stand-in that is pickled under PyTorch's name."""
    return getattr(_MODULES[module], name)


class Call:
    """Pickled as a call of a function on arguments, with a state to be set on the result."""

    def __init__(self, function, *arguments, state=None):
        self.reduced = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self):
        return self.reduced


@dataclass(eq=False)
class Storage:
    """Raw elements, pickled as an id; `size` is what the id claims, `view` what older files add."""

    data: bytes
    kind: str = "FloatStorage"
    size: int | None = None
    key: str = ""
    module: str = "torch"
    view: tuple | None = None
    item: int = field(default=0)

    def __post_init__(self):
        sizes = {
            "Float": 4,
            "Double": 8,
            "Half": 2,
            "BFloat16": 2,
            "Short": 2,
            "Int": 4,
            "Long": 8,
            "ComplexFloat": 8,
            "ComplexDouble": 16,
        }
        self.item = sizes.get(self.kind.removesuffix("Storage"), 1)
        self.size = len(self.data) // self.item if self.size is None else self.size


def storage(array, kind="FloatStorage", **options):
    """Return a storage of an array's elements."""
    return Storage(np.ascontiguousarray(array).tobytes(), kind, **options)


def tensor(stored, shape, strides=None, offset=0, *, rebuild="_rebuild_tensor_v2", rest=(False, {})):
    """Return what PyTorch pickles for a view of a storage."""
    if strides is None:
        strides = tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape)))
    return Call(named("torch._utils", rebuild), stored, offset, tuple(shape), tuple(strides), *rest)


def of(array, kind="FloatStorage"):
    """Return what PyTorch pickles for a contiguous tensor."""
    return tensor(storage(array, kind), np.shape(array))


class _Pickler(pickle.Pickler):
    def __init__(self, file, protocol, *, views):
        super().__init__(file, protocol)
        self.storages, self.views = {}, views

    def persistent_id(self, obj):
        if not isinstance(obj, Storage):
            return None
        obj.key = obj.key or str(len(self.storages))
        self.storages.setdefault(obj.key, obj)
        pid = ("storage", named(obj.module, obj.kind), obj.key, "cpu", obj.size)
        return (*pid, obj.view) if self.views else pid


def pickled(obj, *, protocol=2, views=False):
    """Return the pickle of an object and the storages that it names, by key."""
    file = io.BytesIO()
    pickler = _Pickler(file, protocol, views=views)
    with mock.patch.dict(sys.modules, _MODULES):
        pickler.dump(obj)
    return file.getvalue(), pickler.storages


def write_zip(path, obj, *, byteorder="little", compression=zipfile.ZIP_STORED, leave_out=(), protocol=2):
    """Write the format of PyTorch >= 1.6."""
    data, storages = pickled(obj, protocol=protocol)
    parts = {"data.pkl": data, "version": b"3\n"}
    parts |= {"byteorder": byteorder.encode()} if byteorder else {}
    parts |= {f"data/{key}": stored.data for key, stored in storages.items()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in parts.items():
            if name not in leave_out:
                archive.writestr(f"archive/{name}", content)
    return path


def write_legacy(path, obj, *, version=1001):
    """Write the format before PyTorch 1.6."""
    data, storages = pickled(obj, views=True)
    machine = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
    head = b"".join(pickle.dumps(part, 2) for part in (0x1950A86A20F9469CFC6C, version, machine))
    raw = b"".join((len(s.data) // s.item).to_bytes(8, "little") + s.data for s in storages.values())
    path.write_bytes(head + data + pickle.dumps(list(storages), 2) + raw)
    return path


GRID = np.arange(24, dtype=np.float32).reshape(4, 6)
both_formats = pytest.mark.parametrize("write", [write_zip, write_legacy])


def assert_state(got, expected):
    assert list(got) == list(expected)
    for name, value in expected.items():
        assert (got[name].dtype, got[name].shape) == (value.dtype, value.shape), name
        np.testing.assert_array_equal(got[name], value, err_msg=name)

"""Unpickling of PyTorch's tensors and storages to records, and conversion of these to arrays.

Nothing of PyTorch is imported or run: every name in a checkpoint is mapped to a record or a constant of this file.
"""

from __future__ import annotations

import math
import reprlib
import sys
import types
from collections.abc import Callable
from typing import IO, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from tflane_jax.files.plain_pickle import PLAIN, Refused, RestrictedUnpickler, Sealed

# Upper limit of offsets, sizes and strides.
_LARGEST = 2**48


class Damaged(Exception):
    """A file or tensor is damaged or unsupported; the message names the reason."""


class Storage(NamedTuple):
    """A storage of tensors: `size` elements of type `kind`, from element `start` of the file's storage `key`."""

    key: str
    kind: str
    start: int
    size: int


class Tensor(NamedTuple):
    """A view of a storage; offset and strides in elements. `kind` None: that of the storage."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    kind: str | None = None
    conjugate: bool = False
    negative: bool = False


class Unreadable(NamedTuple):
    """A tensor of an unsupported sort."""

    what: str


class Kind(NamedTuple):
    """An element type: as stored, and as returned (None: unsupported)."""

    stored: np.dtype
    returned: np.dtype | None


def _kinds(names: str, returned: str | None = "") -> dict[str, Kind]:
    return {
        name: Kind(np.dtype(getattr(jnp, name)), returned if returned is None else np.dtype(returned or name))
        for name in names.split()
    }


KINDS: dict[str, Kind] = {
    **_kinds("float32 float64 int8 int16 int32 int64 uint8 uint16 uint32 uint64 complex64 complex128"),
    # float32 represents narrow floats exactly.
    **_kinds("float16 bfloat16 float8_e4m3fn float8_e5m2 float8_e4m3fnuz float8_e5m2fnuz float8_e8m0fnu", "float32"),
    "bool": Kind(np.dtype(np.uint8), np.dtype(bool)),
    "bytes without a type": Kind(np.dtype(np.uint8), np.dtype(np.uint8)),
    "complex32": Kind(np.dtype((np.void, 4)), None),
    **{
        name: Kind(np.dtype((np.void, size)), None)
        for name, size in (("qint8", 1), ("quint8", 1), ("qint32", 4), ("quint4x2", 1), ("quint2x4", 1))
    },
}


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *rest: Any) -> Tensor:
    """Replace `_rebuild_tensor` and `_rebuild_tensor_v2` (requires_grad, backward_hooks, metadata)."""
    return _view(storage, offset, shape, strides, None, rest[2] if len(rest) > 2 else None)


def _typed_tensor(
    storage: Any, offset: Any, shape: Any, strides: Any, grad: Any, hooks: Any, kind: Any, metadata: Any = None
) -> Tensor:
    """Replace `_rebuild_tensor_v3`."""
    return _view(storage, offset, shape, strides, kind, metadata)


def _view(storage: Any, offset: Any, shape: Any, strides: Any, kind: str | None, metadata: Any) -> Tensor:
    if not isinstance(storage, Storage):
        raise Damaged("a tensor has no storage")
    metadata = dict(metadata or {})
    signs = bool(metadata.pop("conj", False)), bool(metadata.pop("neg", False))
    if metadata:
        raise Damaged(f"a tensor has metadata of an unknown sort, {reprlib.repr(metadata)}")
    return Tensor(storage, offset, tuple(shape), tuple(strides), kind, *signs)


def _first(value: Any, *rest: Any) -> Any:
    """Replace wrappers of a tensor: `_rebuild_parameter(_with_state)`."""
    return value


def _with_attributes(function: Any, kind: Any, arguments: Any, *state: Any) -> Any:
    """Replace `_rebuild_from_type_v2`, which adds attributes to a tensor."""
    if not isinstance(function, Sealed) or kind not in ("Tensor", "Parameter"):
        raise Refused(f"a tensor of type {reprlib.repr(kind)}")
    return function(*arguments)


def _unreadable(what: str) -> Sealed:
    return Sealed(lambda *_: Unreadable(what))


_STORAGES = {
    "Float": "float32",
    "Double": "float64",
    "Half": "float16",
    "BFloat16": "bfloat16",
    "Char": "int8",
    "Byte": "uint8",
    "Short": "int16",
    "Int": "int32",
    "Long": "int64",
    "Bool": "bool",
    "ComplexFloat": "complex64",
    "ComplexDouble": "complex128",
    "ComplexHalf": "complex32",
    "QInt8": "qint8",
    "QUInt8": "quint8",
    "QInt32": "qint32",
    "QUInt4x2": "quint4x2",
    "QUInt2x4": "quint2x4",
}
_REBUILD = {
    "_rebuild_tensor": Sealed(_tensor),
    "_rebuild_tensor_v2": Sealed(_tensor),
    "_rebuild_tensor_v3": Sealed(_typed_tensor),
    "_rebuild_parameter": Sealed(_first),
    "_rebuild_parameter_with_state": Sealed(_first),
    "_rebuild_sparse_tensor": _unreadable("a sparse tensor"),
    "_rebuild_sparse_csr_tensor": _unreadable("a sparse tensor"),
    "_rebuild_nested_tensor": _unreadable("a nested tensor"),
    "_rebuild_qtensor": _unreadable("a quantised tensor"),
    "_rebuild_meta_tensor_no_storage": _unreadable("a tensor without content (device meta)"),
}
_SCHEMES = (
    "per_tensor_affine",
    "per_channel_affine",
    "per_tensor_symmetric",
    "per_channel_symmetric",
    "per_channel_affine_float_qparams",
)
ALLOWED = {
    **PLAIN,
    **{("torch", f"{name}Storage"): kind for name, kind in _STORAGES.items()},
    **{("torch.storage", name): "bytes without a type" for name in ("UntypedStorage", "_UntypedStorage")},
    **{("torch._utils", name): value for name, value in _REBUILD.items()},
    **{("torch", name): name for name in (*KINDS, *_SCHEMES, "Tensor")},
    ("torch.nn.parameter", "Parameter"): "Parameter",
    ("torch._tensor", "_rebuild_from_type_v2"): Sealed(_with_attributes),
    ("torch.serialization", "_get_layout"): Sealed(_first),
    ("torch", "device"): Sealed(lambda *_: "device"),
    ("torch", "Size"): Sealed(_first),
    # Training scripts save these beside the weights.
    ("argparse", "Namespace"): types.SimpleNamespace,
    ("collections", "defaultdict"): Sealed(lambda *_: {}),
    ("collections", "Counter"): Sealed(lambda *_: {}),
    **{(module, "dict"): dict for module in ("builtins", "__builtin__")},
    **{(module, "list"): list for module in ("builtins", "__builtin__")},
}


class TorchUnpickler(RestrictedUnpickler):
    """Unpickles the object of a checkpoint.

    Attributes:
        storages: the file's storages that the object refers to, by key.
    """

    def __init__(self, file: IO[bytes]) -> None:
        """Start at the file's present position."""
        super().__init__(file, ALLOWED, encoding="latin1")
        self.storages: dict[str, Storage] = {}

    def persistent_load(self, pid: Any) -> Storage:
        """Return the storage of an id ("storage", type, key, device, size[, view, in older files])."""
        match pid:
            case ("storage", str(kind), str(key), _, int(size), *view) if kind in KINDS:
                self.storages[key] = Storage(key, kind, 0, size)
            case _:
                return super().persistent_load(pid)
        match view:
            case [] | [None]:
                return self.storages[key]
            case [(_, int(start), int(size))]:
                return Storage(key, kind, start, size)
        raise Damaged("a storage is part of another in an unknown way")


def to_array(tensor: Tensor | Unreadable, read: Callable[[str], bytes], byteorder: str, most: int) -> np.ndarray:
    """Return a tensor's elements.

    Args:
        tensor: record of the tensor.
        read: returns the bytes of a storage by its key.
        byteorder: "little" or "big", that of the file.
        most: largest number of elements; strides of 0 would repeat elements without limit.

    Raises:
        Damaged: the tensor is of an unsupported sort, too large, or its elements are missing.
    """
    remedy = "Save it as a dense tensor of floats in PyTorch"
    if isinstance(tensor, Unreadable):
        raise Damaged(f"{tensor.what}. {remedy}")
    storage, offset, shape, strides, kind = tensor[:5]
    stored, returned = KINDS.get(kind or storage.kind, (np.dtype("V1"), None))
    if returned is None:
        raise Damaged(f"has elements of type {reprlib.repr(kind or storage.kind)}. {remedy}")
    numbers = (offset, *shape, *strides, storage.start, storage.size)
    if not all(isinstance(n, int) and 0 <= n < _LARGEST for n in numbers) or not len(shape) == len(strides) <= 64:
        raise Damaged("has impossible sizes, offset or strides")
    if (count := math.prod(shape)) == 0:
        return np.zeros(shape, returned)
    if count > most:
        raise Damaged(f"has {count} elements, more than the file can hold")
    unit = KINDS[storage.kind].stored.itemsize
    elements = storage.size * unit // stored.itemsize
    if offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True)) >= elements:
        raise Damaged("reaches beyond its storage")
    data = read(storage.key)
    if len(data) < (storage.start + storage.size) * unit:
        raise Damaged("has a storage that is cut short")
    # Swap the bytes of real and imaginary parts separately.
    size = stored.itemsize
    part = np.dtype(f"u{size // 2 if stored.kind == 'c' else size}")
    flat = np.frombuffer(data, part, elements * size // part.itemsize, storage.start * unit)
    if byteorder != sys.byteorder:
        flat = flat.byteswap()
    array = np.ndarray(shape, stored, flat, offset * size, [step * size for step in strides])
    array = array.astype(returned, order="C")
    if tensor.conjugate:
        array = array.conj()
    return -array if tensor.negative else array

"""Pickles of plain data, read without running anything that they name.

A pickle is a program: loading an untrusted one with `pickle.load` lets it do whatever it wants. Here only containers,
numbers, strings and numpy arrays come out; a file that asks for anything else is refused before it gets it.
`convert.torch_file` adds to these what PyTorch's checkpoints are made of.
"""

from __future__ import annotations

import collections
import io
import pickle
import reprlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np

from tflane_jax.errors import UserError


def load_plain_pickle(path: Path) -> Any:
    """Return what a pickle file of plain data holds.

    Raises:
        UserError: there is no such file, it is no pickle or cut short, or it names anything but containers, numbers,
            strings and numpy arrays.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    try:
        return RestrictedUnpickler(io.BytesIO(data), PLAIN).load()
    except Refused as error:
        raise UserError(
            f"{path} is refused: it is a pickle that names {error}, and only containers, numbers, strings and numpy "
            "arrays are read. Save the data as such (torch tensors with .numpy())"
        ) from None
    # A damaged file may ask for any operation on any operands.
    except Exception as error:
        raise UserError(f"{path} is no pickle file, or it is damaged ({type(error).__name__}: {error})") from None


class Refused(Exception):
    """The name of something that the data does not need."""


class Sealed(NamedTuple):
    """A function that a pickle may call and cannot change.

    A pickle may set attributes of whatever it holds, and functions and classes written in Python would keep them.
    """

    function: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*arguments)


class RestrictedUnpickler(pickle.Unpickler):
    """An unpickler that knows a few names.

    Attributes:
        allowed: what each (module, name) stands for: classes written in C, `Sealed` functions, plain values.
    """

    def __init__(self, file: IO[bytes], allowed: Mapping[tuple[str, str], Any], *, encoding: str = "ASCII") -> None:
        """Read from `file`; `encoding` is that of strings from Python 2."""
        super().__init__(file, encoding=encoding)
        self.allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a name; raise `Refused` for one that is not allowed."""
        try:
            return self.allowed[module, name]
        except KeyError:
            raise Refused(ascii(f"{module}.{name}")[1:-1][:120]) from None

    def persistent_load(self, pid: Any) -> Any:
        """Refuse objects outside the file."""
        raise Refused(f"an object outside the file ({reprlib.repr(pid)})")


def _array(kind: type, shape: Any, code: Any) -> np.ndarray:
    """Make the empty array that the file then fills; `shape` and `code` are placeholders there, and not believed."""
    if kind != _NDARRAY:
        raise Refused(f"an array of type {reprlib.repr(kind)}")
    return np.ndarray.__new__(np.ndarray, (0,), "b")


def _bytes(text: str | bytes = b"", encoding: str = "latin1") -> bytes:
    """Return bytes as the older protocols write them; a number, which asks for so many zeros, is refused."""
    if not isinstance(text, (str, bytes)) or encoding.replace("-", "") != "latin1":
        raise Refused(f"bytes made of {reprlib.repr(text)} by {reprlib.repr(encoding)}")
    return text.encode("latin1") if isinstance(text, str) else text


def _bytearray(text: str | bytes = b"", encoding: str = "latin1") -> bytearray:
    return bytearray(_bytes(text, encoding))


def _dtype(code: str, align: bool = False, copy: bool = True) -> np.dtype:
    """Return a type of its own, which the file then completes."""
    return np.dtype(code, align=bool(align), copy=True)


def _scalar(dtype: np.dtype, data: bytes = b"") -> Any:
    return np.frombuffer(data, dtype, 1)[0]


def _from_buffer(buffer: Any, dtype: np.dtype, shape: tuple[int, ...], order: Literal["C", "F"]) -> np.ndarray:
    """Return an array that protocol 5 keeps inside the file."""
    return np.frombuffer(buffer, dtype).reshape(shape, order=order)


# Stands for the class, which called with a shape would take as much memory.
_NDARRAY = "numpy.ndarray"
_NUMPY: dict[str, dict[str, Callable[..., Any]]] = {
    "multiarray": {"_reconstruct": _array, "scalar": _scalar},
    "numeric": {"_frombuffer": _from_buffer},
}
_BUILTINS = {
    "set": set,
    "frozenset": frozenset,
    "complex": complex,
    "bytes": Sealed(_bytes),
    "bytearray": Sealed(_bytearray),
}
PLAIN: Mapping[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): Sealed(_dtype),
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("_codecs", "encode"): Sealed(_bytes),
    # Python 2 and 3, numpy 1 and 2 keep the same things in different places.
    **{(module, name): value for module in ("builtins", "__builtin__") for name, value in _BUILTINS.items()},
    **{
        (f"numpy.{core}.{module}", name): Sealed(value)
        for core in ("core", "_core")
        for module, names in _NUMPY.items()
        for name, value in names.items()
    },
}
"""What plain data may name."""

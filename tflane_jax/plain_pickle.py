"""Pickles of plain data, read without running anything that they name.

A pickle is a program: loading an untrusted one with `pickle.load` lets it do whatever it wants. Here only containers,
numbers, strings and numpy arrays come out; a file that asks for anything else is refused before it gets it.
"""

from __future__ import annotations

import collections
import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

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
        return _Unpickler(io.BytesIO(data)).load()
    except _Refused as error:
        raise UserError(
            f"{path} is refused: it is a pickle that names {error}, and only containers, numbers, strings and numpy "
            "arrays are read. Save the data as such (torch tensors with .numpy())"
        ) from None
    # A damaged file may ask for any operation on any operands.
    except Exception as error:
        raise UserError(f"{path} is no pickle file, or it is damaged ({type(error).__name__}: {error})") from None


class _Refused(Exception):
    """The name of something that plain data does not need."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _PLAIN[module, name]
        except KeyError:
            raise _Refused(f"{module}.{name}") from None

    def persistent_load(self, pid: Any) -> Any:
        raise _Refused(f"an object outside the file ({pid!r:.80})")


def _array(kind: type, shape: Any, code: Any) -> np.ndarray:
    """Make the empty array that the file then fills; `shape` and `code` are placeholders there, and not believed."""
    if kind is not np.ndarray:
        raise _Refused(f"an array of type {kind!r:.80}")
    return np.ndarray.__new__(np.ndarray, (0,), "b")


def _bytes(text: str | bytes = b"", encoding: str = "latin1") -> bytes:
    """Return bytes as the older protocols write them; a number, which asks for so many zeros, is refused."""
    if not isinstance(text, (str, bytes)) or encoding.replace("-", "") != "latin1":
        raise _Refused(f"bytes made of {text!r:.40} by {encoding!r:.40}")
    return text.encode("latin1") if isinstance(text, str) else text


def _bytearray(text: str | bytes = b"", encoding: str = "latin1") -> bytearray:
    return bytearray(_bytes(text, encoding))


def _scalar(dtype: np.dtype, data: bytes = b"") -> Any:
    return np.frombuffer(data, dtype, 1)[0]


def _from_buffer(buffer: Any, dtype: np.dtype, shape: tuple[int, ...], order: Literal["C", "F"]) -> np.ndarray:
    """Return an array that protocol 5 keeps inside the file."""
    return np.frombuffer(buffer, dtype).reshape(shape, order=order)


_NUMPY: dict[str, dict[str, Any]] = {
    "multiarray": {"_reconstruct": _array, "scalar": _scalar},
    "numeric": {"_frombuffer": _from_buffer},
}
_BUILTINS = {"set": set, "frozenset": frozenset, "complex": complex, "bytes": _bytes, "bytearray": _bytearray}
_PLAIN: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("_codecs", "encode"): _bytes,
    # Python 2 and 3, numpy 1 and 2 keep the same things in different places.
    **{(module, name): value for module in ("builtins", "__builtin__") for name, value in _BUILTINS.items()},
    **{(f"numpy.{core}.{module}", name): value
       for core in ("core", "_core") for module, names in _NUMPY.items() for name, value in names.items()},
}  # fmt: skip

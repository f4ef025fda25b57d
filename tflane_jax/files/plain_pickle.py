"""Pickles of plain data, read without running code from the file.

`pickle.load` runs whatever functions an untrusted file names. This reader allows containers, numbers, strings and numpy
arrays, and refuses a file that names anything else before it is called. `convert.torch_file` also allows the parts of
PyTorch's checkpoints.
"""

from __future__ import annotations

import collections
import io
import math
import pickle
import pickletools
import re
import reprlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.npz import check_places

# Truth values, numbers, strings, objects, dates and records.
_CODE = re.compile(r"[<>=|]?(\?|[biufcSUOMmV]\d{0,6})")

_PUTS, _GETS = ("PUT", "BINPUT", "LONG_BINPUT"), ("GET", "BINGET", "LONG_BINGET")
_TUPLES = ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "FROZENSET")  # what can be in a key, with other such in it
_CONSTANTS = frozenset(
    code.name
    for code in pickletools.opcodes
    if not code.stack_before and len(code.stack_after) == 1 and code.name not in (*_GETS, "MARK")
)
_MOST_REPEATED, _PER_INSTRUCTION = 10**6, 100
"""Objects in tuples that a file may name again: in all, and for each of its instructions."""


def load_plain_pickle(path: Path) -> Any:
    """Return the content of a pickle file of plain data.

    Raises:
        UserError: the file does not exist, is no pickle, is truncated, names anything but containers, numbers, strings
            and numpy arrays, or does not end with its object: a file that was appended to holds several.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    stream = io.BytesIO(data)
    try:
        content = RestrictedUnpickler(stream, PLAIN).load()
    except Refused as error:
        raise UserError(
            f"{path} is refused: it is a pickle that names {error}, and only containers, numbers, strings and numpy "
            "arrays are read. Save the data as such (torch tensors with .numpy())"
        ) from None
    # A damaged file may ask for any operation on any operands.
    except Exception as error:
        raise UserError(f"{path} is no pickle file, or it is damaged ({type(error).__name__}: {error})") from None
    if rest := len(data) - stream.tell():
        raise UserError(f"{path} goes on for {rest} bytes after its content: was it written twice? Write it afresh")
    return content


class Refused(Exception):
    """A pickle names something that is not allowed; the message is the name."""


class Sealed(NamedTuple):
    """A function that a pickle may call but not change.

    A pickle can set attributes of the objects that it names. A plain Python function or class would keep them.
    """

    function: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*arguments)


class RestrictedUnpickler(pickle.Unpickler):
    """An unpickler that resolves only the allowed names.

    Attributes:
        allowed: values by (module, name): classes written in C, `Sealed` functions, plain values.
    """

    def __init__(self, file: IO[bytes], allowed: Mapping[tuple[str, str], Any], *, encoding: str = "ASCII") -> None:
        """Read from `file`, from its present position; `encoding` is that of strings from Python 2."""
        _check_instructions(file)
        super().__init__(file, encoding=encoding)
        self.allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        """Return the value of a name; raise `Refused` for one that is not allowed."""
        try:
            return self.allowed[module, name]
        except KeyError:
            raise Refused(ascii(f"{module}.{name}")[1:-1][:120]) from None

    def persistent_load(self, pid: Any) -> Any:
        """Refuse objects outside the file."""
        raise Refused(f"an object outside the file ({reprlib.repr(pid)})")


def _check_instructions(file: IO[bytes]) -> None:
    """Refuse opcodes that bypass `find_class`, or that make the unpickler compute or allocate memory without data.

    Its table of objects grows to the largest number that the file gives one. A tuple may hold another one twice, that
    one a third, and so on: as a key of a mapping, fifty of them would take years to hash. Reading the instructions
    first takes several times as long as loading them.
    """
    start, sizes = file.tell(), _TupleSizes()
    for count, (instruction, argument, _) in enumerate(pickletools.genops(file)):
        if instruction.name in ("EXT1", "EXT2", "EXT4"):
            raise Refused("Python's extension registry")
        if instruction.name in _PUTS and int(argument or 0) > count:
            raise pickle.UnpicklingError("it numbers its objects in an unknown way")
        sizes.follow(instruction, argument)
        if sizes.repeated > max(_MOST_REPEATED, _PER_INSTRUCTION * count):
            raise pickle.UnpicklingError("its tuples or sets hold each other too many times")
    file.seek(start)


class _TupleSizes:
    """The unpickler's stack, with the number of objects in each tuple in place of the tuple, and 0 for all else.

    Attributes:
        repeated: sum of the sizes of tuples that the file names again: no key takes longer to hash.
    """

    def __init__(self) -> None:
        self.repeated = 0
        self._stack: list[int] = []
        self._marks: list[int] = []
        self._memo: dict[int, int] = {}

    def follow(self, instruction: Any, argument: Any) -> None:
        """Follow an instruction; one that asks for more than there is will end the loading."""
        name, stack = instruction.name, self._stack
        if name in _CONSTANTS:
            stack.append(0)
        elif name == "MARK":
            self._marks.append(len(stack))
        elif name in _GETS or name == "DUP":
            size = self._top() if name == "DUP" else self._memo.get(int(argument), 0)
            self.repeated += size
            stack.append(size)
        elif name in _PUTS or name == "MEMOIZE":
            self._memo[len(self._memo) if name == "MEMOIZE" else int(argument)] = self._top()
        else:
            before, first = instruction.stack_before, len(stack)
            if pickletools.markobject in before:  # all from the mark on, and what comes before it
                first = self._marks.pop() if self._marks else 0
                before = before[: before.index(pickletools.markobject)]
            first = max(first - len(before), 0)
            size = len(stack) - first + sum(stack[first:]) if name in _TUPLES else 0
            stack[first:] = [size] * len(instruction.stack_after)

    def _top(self) -> int:
        return self._stack[-1] if self._stack else 0


class _Type:
    """A type of numpy, as a file names and then completes it.

    A file could complete a `np.dtype` so that numpy reads outside the data, or takes numbers for addresses of objects:
    numpy does not check the state that a pickle gives it. Records lose their fields here and dates their unit. No
    reader expects either, and each still sees from the type that it got one.
    """

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or _CODE.fullmatch(code) is None:
            raise Refused(f"numpy data of the type {reprlib.repr(code)}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        match state:
            # Version, order of bytes, form of an element, names and form of fields, size; then alignment and flags.
            case (int(), "<" | ">" | "=" | "|" as order, None, names, fields, int(size), *_):
                known = size in (-1, self.dtype.itemsize) and (self.dtype.kind == "V" or names is fields is None)
            case _:
                known, order = False, "|"
        if not known:
            raise pickle.UnpicklingError("numpy data have an unknown form")
        self.dtype = self.dtype.newbyteorder("=" if order == "|" else order)


class _FilledArray(np.ndarray):
    """An array that the file fills once it exists."""

    def __repr__(self) -> str:
        return repr(self.view(np.ndarray))

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.view(np.ndarray).__reduce_ex__(protocol)

    def __setstate__(self, state: Any) -> None:
        match state:
            case (*version, tuple(shape), _Type() as kind, bool() | int() as by_column, data) if version in ([], [1]):
                data = data.encode("latin1") if isinstance(data, str) else data
                if isinstance(data, list) != kind.dtype.hasobject:
                    raise pickle.UnpicklingError("an array and its content have different types")
                if isinstance(data, list) and len(data) != math.prod(shape):
                    raise pickle.UnpicklingError(f"an array of shape {shape} has {len(data)} elements")
                check_places(shape, len(data) if isinstance(data, (bytes, list)) else 0)
                form: Any = bool(by_column)  # its stub asks for numpy's own, which it refuses
                super().__setstate__((1, shape, kind.dtype, form, data))
            case _:
                raise pickle.UnpicklingError("an array has an unknown form")


_FilledArray.__name__ = "ndarray"  # what messages name it


def _array(kind: type, shape: Any, code: Any) -> np.ndarray:
    """Return the empty array that the file then fills; `shape` and `code` of the file are placeholders, so ignored."""
    if kind != _NDARRAY:
        raise Refused(f"an array of type {reprlib.repr(kind)}")
    return _FilledArray.__new__(_FilledArray, (0,), "b")


def _bytes(text: str | bytes = b"", encoding: str = "latin1") -> bytes:
    """Return bytes as the older protocols write them; a number, which would allocate as many zeros, is refused."""
    if not isinstance(text, (str, bytes)) or encoding.replace("-", "") != "latin1":
        raise Refused(f"bytes made of {reprlib.repr(text)} by {reprlib.repr(encoding)}")
    return text.encode("latin1") if isinstance(text, str) else text


def _bytearray(text: str | bytes = b"", encoding: str = "latin1") -> bytearray:
    return bytearray(_bytes(text, encoding))


def _scalar(kind: _Type, data: bytes = b"") -> Any:
    return np.frombuffer(data, _plain(kind), 1)[0]


def _from_buffer(buffer: Any, kind: _Type, shape: tuple[int, ...], order: Literal["C", "F"]) -> np.ndarray:
    """Return an array stored inside the file, as by protocol 5."""
    check_places(shape, len(buffer))
    return np.frombuffer(buffer, _plain(kind)).reshape(shape, order=order)


def _plain(kind: _Type) -> np.dtype:
    """Return the type of elements that bytes may be read as."""
    if kind.dtype.hasobject:
        raise Refused("objects stored as bytes")
    return kind.dtype


def _frozenset(members: Any = ()) -> frozenset[Any]:
    """Return a set, as older pickles make it: from a list, whose content `_TupleSizes` does not follow."""
    members = list(members)
    if any(isinstance(one, tuple | frozenset) for one in members):
        raise pickle.UnpicklingError("its sets hold tuples or sets")
    return frozenset(members)


# Not the class itself: a file could call it with a shape of any size.
_NDARRAY = "numpy.ndarray"
_NUMPY: dict[str, dict[str, Callable[..., Any]]] = {
    "multiarray": {"_reconstruct": _array, "scalar": _scalar},
    "numeric": {"_frombuffer": _from_buffer},
}
_BUILTINS = {
    "set": set,
    "frozenset": Sealed(_frozenset),
    "complex": complex,
    "bytes": Sealed(_bytes),
    "bytearray": Sealed(_bytearray),
}
PLAIN: Mapping[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): Sealed(_Type),
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("_codecs", "encode"): Sealed(_bytes),
    # Python 2 and 3, numpy 1 and 2 have them in different modules.
    **{(module, name): value for module in ("builtins", "__builtin__") for name, value in _BUILTINS.items()},
    **{
        (f"numpy.{core}.{module}", name): Sealed(value)
        for core in ("core", "_core")
        for module, names in _NUMPY.items()
        for name, value in names.items()
    },
}
"""Names allowed in plain data."""

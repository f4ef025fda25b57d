"""Reads PyTorch checkpoints without PyTorch, and without executing code from them.

Formats: zip (PyTorch >= 1.6: pickled object, one raw file per storage), its predecessor (pickles, then raw storages),
plain pickles of arrays, and `.npz`. The format is detected from the content, not from the suffix.
"""

from __future__ import annotations

import functools
import io
import reprlib
import zipfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from tflane_jax.convert.renaming import without_wrappers
from tflane_jax.convert.torch_pickle import KINDS, Damaged, Tensor, TorchUnpickler, Unreadable, to_array
from tflane_jax.errors import UserError
from tflane_jax.files.npz import HoldsObjects, npz_arrays
from tflane_jax.files.plain_pickle import Refused

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
# Entries where training programs keep the weights, the most likely first.
_WEIGHTS = ("state_dict", "model_state_dict", "model", "net", "network", "module", "weights", "params")


# Tensors may share storages and repeat elements (stride 0). A file may have at most
# _MOST_REPEATED + _MOST_SHARED * (its bytes) elements in total, so that a small file cannot exhaust memory.
_MOST_SHARED = 8
_MOST_REPEATED = 2**24


@dataclass(frozen=True)
class Checkpoint:
    """Content of a checkpoint file.

    Attributes:
        tensors: by name, in the order of the file; floats of fewer than 32 bits as float32.
        entry: path of the tensors in the file, such as "state_dict"; "" is the top level.
        others: what the names beside the tensors hold that are not tensors: counters, settings.
        alternatives: where no entry was asked for, paths of other sets with tensors of the same names, such as an
            average of the weights.
    """

    tensors: dict[str, np.ndarray]
    entry: str
    others: dict[str, str]
    alternatives: tuple[str, ...]

    def passed_over(self) -> list[dict[str, str]]:
        """Return rows of a conversion's table that name the alternatives."""
        return [
            {"tensor": "-", "shape": "-", "becomes": f"not read: {name} has tensors of the same names (--entry {name})"}
            for name in self.alternatives
        ]


def read_state_dict(path: Path, entry: str | None = None) -> dict[str, np.ndarray]:
    """Return the tensors of a checkpoint by name; see `read_checkpoint`."""
    return read_checkpoint(path, entry).tensors


def read_checkpoint(path: Path, entry: str | None = None) -> Checkpoint:
    """Return the tensors of a checkpoint (.npz, .pth, .pt, .pkl, .tar) by name.

    Args:
        path: the file.
        entry: path of the weights in the file, such as "ema/state_dict"; None: found if it is unambiguous.

    Raises:
        UserError: the file is missing, damaged or no checkpoint; it refers to anything but tensors and plain data; it
            has several sets of tensors and no `entry` is given; or a tensor is quantised or sparse.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            return _state_dict(_contents(file), entry, size=path.stat().st_size)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from None
    except Refused as error:
        raise UserError(
            f"{path} is refused: it names {error}, and only tensors and plain data are read, since anything else may "
            "run code. If you trust the file, save its weights alone in PyTorch: torch.save(model.state_dict(), ...)"
        ) from None
    except (Damaged, UserError) as error:
        raise UserError(f"{path}: {error}") from None
    # Unpickling a damaged file can raise any exception.
    except Exception as error:
        raise UserError(
            f"{path} is no PyTorch checkpoint, or it is damaged{_opening(path)} ({type(error).__name__}: "
            f"{ascii(str(error))[1:-1][:120]}). Download it again"
        ) from None


class _Contents(NamedTuple):
    """The unpickled object of a file, and its storages.

    Attributes:
        tree: plain data and `Tensor` records.
        read: returns the bytes of a storage by its key.
        byteorder: of the storages, "little" or "big".
    """

    tree: Any
    read: Callable[[str], bytes]
    byteorder: str


def _contents(file: IO[bytes]) -> _Contents:
    start = file.read(512)
    file.seek(0)
    if not start:
        raise Damaged("the file is empty. Download it again")
    if start[:2] == b"\x1f\x8b" or start[257:262] == b"ustar":
        raise Damaged("a packed file. Unpack it (tar xf, gunzip) and give the file inside")
    if start.startswith(b"version https://git-lfs"):
        raise Damaged("a pointer of Git LFS in place of the file. Fetch the file: git lfs pull")
    if (kind := _other_format(start)) is not None:
        raise Damaged(f"a file of {kind}, which is not read. Load it in Python and save the tensors by name as .npz")
    if not start.startswith(b"PK"):
        return _legacy_contents(file)
    archive = zipfile.ZipFile(file)
    names = archive.namelist()
    if any(name.endswith(".npy") for name in names):
        try:
            return _Contents(npz_arrays(file), _nothing, "little")
        except HoldsObjects as error:
            raise Damaged(f"{error}, which are not read, expected numbers. Save the file without them") from None
    objects = [name for name in names if name.split("/", 1)[-1] == "data.pkl"]
    if len(objects) != 1:
        raise Damaged("a zip file, but none of PyTorch's (it has no data.pkl) or of numpy's (no .npy)")
    root = objects[0].removesuffix("data.pkl")
    if f"{root}constants.pkl" in names:
        raise Damaged("a TorchScript program. Save its weights in PyTorch: torch.save(module.state_dict(), ...)")
    return _zip_contents(archive, root)


def _other_format(start: bytes) -> str | None:
    """Return the name of the well-known format that a file's first bytes show, of those that are not read here."""
    if start[8:9] == b"{" and int.from_bytes(start[:8], "little") < 1 << 32:
        return "safetensors"
    if start.startswith(b"\x89HDF"):
        return "HDF5 (Keras)"
    if start.startswith(b"\x93NUMPY"):
        return "one array (.npy)"
    # ONNX is a protocol buffer: field 1 is the version, and the name of the program that wrote it follows as field 2.
    return "ONNX" if start[:1] == b"\x08" and start[2:3] == b"\x12" else None


def _nothing(key: str) -> bytes:
    raise Damaged(f"storage {ascii(key)[:40]} is missing")


def _zip_contents(archive: zipfile.ZipFile, root: str) -> _Contents:
    parts = {info.filename: info for info in archive.infolist()}

    def read(name: str) -> bytes:
        info = parts.get(root + name)
        if info is None:
            return _nothing(name)
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
            raise Damaged(f"{ascii(name)[1:-1][:40]} is compressed or encrypted. Pack it again: unzip, then zip -0 -r")
        try:
            return archive.read(info)
        except zipfile.BadZipFile:
            raise Damaged(
                f"{ascii(name)[1:-1][:40]} does not agree with its checksum. Download the file again; if it was "
                "written without checksums (set_crc32_options(False)), save it again with them"
            ) from None

    byteorder = read("byteorder").decode() if f"{root}byteorder" in parts else "little"
    if byteorder not in ("little", "big"):
        raise Damaged(f"unknown byte order {ascii(byteorder)[:40]}")
    tree = TorchUnpickler(io.BytesIO(read("data.pkl"))).load()
    return _Contents(tree, functools.cache(lambda key: read(f"data/{key}")), byteorder)


def _legacy_contents(file: IO[bytes]) -> _Contents:
    """Read the format before PyTorch 1.6: magic number, version, machine, object, keys, then the storages."""
    tree = TorchUnpickler(file).load()
    if not isinstance(tree, int) or tree != _LEGACY_MAGIC:
        if file.read(1):
            raise Damaged("the file goes on after its content: was it written twice? Save it again")
        return _Contents(tree, _nothing, "little")
    if (version := TorchUnpickler(file).load()) != 1001:
        raise Damaged(f"version {reprlib.repr(version)} of PyTorch's format is unknown")
    TorchUnpickler(file).load()
    unpickler = TorchUnpickler(file)
    tree = unpickler.load()
    keys = TorchUnpickler(file).load()
    place, end = file.tell(), file.seek(0, 2)
    places: dict[str, tuple[int, int]] = {}
    for key in keys:
        file.seek(place)
        size = int.from_bytes(file.read(8), "little") * KINDS[unpickler.storages[key].kind].stored.itemsize
        places[key] = place + 8, size
        place += 8 + size
        if place > end:
            raise Damaged("the file is cut short. Download it again")

    @functools.cache
    def read(key: str) -> bytes:
        if key not in places:
            return _nothing(key)
        start, size = places[key]
        file.seek(start)
        return file.read(size)

    return _Contents(tree, read, "little")


def _state_dict(contents: _Contents, entry: str | None, size: int) -> Checkpoint:
    tree, place = contents.tree, ()
    if entry:
        tree, place = _descend(tree, tuple(entry.split("/")))
    found = _find(tree, place, set())
    if len(found) != 1:
        if not found:
            raise UserError(f"no tensors by name{_within(entry)}, only {_described(tree)}. Save model.state_dict()")
        listed = ", ".join(sorted(map(_shown, found))[:10])
        raise UserError(
            f"several sets of tensors{_within(entry)}. Say which is meant (tflane convert --entry), one of: {listed}"
        )
    (place,) = found
    named, _ = _descend(contents.tree, place)
    tensors, others = {}, {}
    most = _MOST_REPEATED + _MOST_SHARED * size
    for name, value in dict.items(named):
        if not isinstance(name, str) or not _is_tensor(value):
            others[str(name) if isinstance(name, (str, int)) else type(name).__name__] = _held(value)
        elif isinstance(value, np.ndarray):
            tensors[name] = value
        else:
            try:
                tensors[name] = to_array(value, contents.read, contents.byteorder, most)
            except Damaged as error:
                raise Damaged(f"{_shown((*place, name))}: {error}") from None
            most -= tensors[name].size
    alternatives = () if entry else _alternatives(contents.tree, place, tensors)
    return Checkpoint(tensors, "/".join(place), others, alternatives)


def _alternatives(tree: Any, chosen: tuple[str, ...], names: Collection[str]) -> tuple[str, ...]:
    """Return the paths of all dicts but the chosen one in which tensors have some of its names."""
    known = {without_wrappers(name) for name in names}
    places = [place for place in _places(tree, (), set()) if place != chosen]
    named = {place: _descend(tree, place)[0] for place in places}
    return tuple(
        _shown(place)
        for place, inside in named.items()
        if any(isinstance(name, str) and without_wrappers(name) in known for name in dict.keys(inside))
    )


def _places(tree: Any, place: tuple[str, ...], seen: set[int]) -> Iterator[tuple[str, ...]]:
    """Yield the paths of all dicts that hold tensors."""
    if not isinstance(tree, dict) or id(tree) in seen:
        return
    seen.add(id(tree))
    if any(isinstance(name, str) and _is_tensor(value) for name, value in dict.items(tree)):
        yield place
    for name, value in dict.items(tree):
        if isinstance(name, str):
            yield from _places(value, (*place, name), seen)


def _find(tree: Any, place: tuple[str, ...], seen: set[int]) -> list[tuple[str, ...]]:
    """Return the paths of dicts that hold tensors; an entry of `_WEIGHTS` takes precedence over all others."""
    # Pickled dicts may contain themselves.
    if not isinstance(tree, dict) or id(tree) in seen:
        return []
    seen.add(id(tree))
    inner = {name: value for name, value in dict.items(tree) if isinstance(name, str) and isinstance(value, dict)}
    for name in _WEIGHTS:
        if name in inner and (found := _find(inner[name], (*place, name), seen)):
            return found
    if any(isinstance(name, str) and _is_tensor(value) for name, value in dict.items(tree)):
        return [place]
    return [where for name, value in inner.items() for where in _find(value, (*place, name), seen)]


def _descend(tree: Any, place: tuple[str, ...]) -> tuple[Any, tuple[str, ...]]:
    """Return the entry at a path, and the path."""
    for i, name in enumerate(place):
        if not isinstance(tree, dict) or not dict.__contains__(tree, name):
            where = _shown(place[:i]) or "the file"
            raise UserError(f"no entry {_shown(place[: i + 1])}; {where} holds {_described(tree)}")
        tree = dict.__getitem__(tree, name)
    return tree, place


def _is_tensor(value: Any) -> bool:
    return isinstance(value, (Tensor, Unreadable)) or (isinstance(value, np.ndarray) and value.dtype.kind in "biufc")


_NO_NUMBERS = {"U": "text", "S": "text", "M": "dates", "m": "durations", "O": "Python objects", "V": "records"}
"""What numpy's arrays hold, by the kind of their elements."""


def _held(value: Any) -> str:
    """Return what an entry that is no tensor holds, for messages."""
    if isinstance(value, np.ndarray):
        return _NO_NUMBERS.get(value.dtype.kind, str(value.dtype))
    return "text" if isinstance(value, (str, bytes)) else f"a value of type {type(value).__name__}"


def _described(tree: Any) -> str:
    if not isinstance(tree, dict):
        return f"a {type(tree).__name__}"
    return ", ".join(_shown((str(name),)) for name in list(tree)[:10] if isinstance(name, (str, int))) or "nothing"


def _shown(place: tuple[str, ...]) -> str:
    return ascii("/".join(place))[1:-1][:100]


def _within(entry: str | None) -> str:
    return f" in {_shown((entry,))}" if entry else ""


def _opening(path: Path) -> str:
    """Return the first line of a text file: a failed download may be an error page or a Git LFS pointer."""
    try:
        with path.open("rb") as file:
            line = (file.read(60).decode("ascii").splitlines() or [""])[0]
    except (OSError, UnicodeDecodeError):
        return ""
    return f"; it begins with {line!r}" if line.isprintable() else ""

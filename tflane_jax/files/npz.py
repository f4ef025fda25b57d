"""Arrays in .npz files: of files from elsewhere nothing is unpickled, and sizes are checked before memory is taken."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import replacing

# Bytes of memory that a file's arrays may take: 200 frames of 10,000 lanes of 200 points are 10 GB.
_MOST_MEMORY = 2**34
# Bytes that one byte may hold by the compression of the archive; numpy writes these two. Deflate's limit: zlib's
# technical details.
_MOST_HELD = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}


# Places along the axes of an array that holds nothing: 10,000 frames of 100 lanes are a million.
_MOST_PLACES = 10**7


class HoldsObjects(ValueError):
    """An array holds Python objects, which only unpickling would read; the message names the array."""


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of a file by name; `names` are those to read: missing ones are left out, None reads all.

    Raises UserError for a file that is missing, damaged or no .npz.
    """
    try:
        with path.open("rb") as stream:
            return npz_arrays(stream, names)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from None
    # A damaged archive may raise any error of zipfile, zlib, numpy or the parser of its headers.
    except Exception as error:
        raise UserError(f"{path} is no .npz file of plain arrays, or it is damaged ({error})") from None


def npz_arrays(stream: IO[bytes], names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an open file by name, see `read_npz`; members of the archive that are no .npy are left out.

    Raises ValueError for sizes that the file cannot hold; any exception of zipfile, zlib or numpy for damage.
    """
    size = stream.seek(0, 2)
    if not zipfile.is_zipfile(stream):
        raise ValueError("no archive")
    with zipfile.ZipFile(stream) as archive:
        parts = [part for part in archive.infolist() if part.filename.endswith(".npy")]
        _check_sizes(parts, size)
        by_name = {part.filename.removesuffix(".npy"): part for part in parts}
        wanted = {name: part for name, part in by_name.items() if names is None or name in names}
        for part in wanted.values():
            _check_header(archive, part)
        arrays = {}
        for name, part in wanted.items():
            with archive.open(part) as content:
                arrays[name] = npy.read_array(content, allow_pickle=False)
        return arrays


def _check_sizes(parts: list[zipfile.ZipInfo], size: int) -> None:
    """Raise ValueError if the archive's list claims more bytes than a file of `size` bytes can hold."""
    if len({part.filename for part in parts}) < len(parts):
        raise ValueError("an array is there twice")
    if sum(part.compress_size for part in parts) > size:
        raise ValueError(f"its arrays claim more than the {size} bytes of the file")
    for part in parts:
        if (most := _MOST_HELD.get(part.compress_type)) is None:
            raise ValueError(f"{part.filename} is compressed in a way that numpy does not write")
        if part.file_size > most * part.compress_size:
            raise ValueError(f"{part.filename} claims {part.file_size:.2g} bytes, packed in {part.compress_size}")
    if (needed := sum(part.file_size for part in parts)) > _MOST_MEMORY:
        raise ValueError(f"its arrays claim {needed:.2g} bytes")


def check_places(shape: Sequence[int], size: int) -> None:
    """Raise ValueError if an array of few bytes, or none, claims so many places that arrays beside it fill the memory.

    Args:
        shape: with a 0 in it, or of elements without size, it may claim any length in `size` bytes.
        size: of the array in the file, bytes.
    """
    if (places := math.prod(max(length, 1) for length in shape)) > max(_MOST_PLACES, size):
        raise ValueError(f"an array of shape {tuple(shape)} claims {places:.2g} places in {size} bytes")


def _check_header(archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> None:
    """Raise ValueError if the header of an array claims objects, or another size than the archive has for it."""
    with archive.open(part) as content:
        version = npy.read_magic(content)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read(content)
        if dtype.hasobject:
            raise HoldsObjects(f"{part.filename.removesuffix('.npy')} holds Python objects")
        claimed = math.prod(shape) * dtype.itemsize
        if claimed != part.file_size - content.tell():
            has = f"but the file has {part.file_size - content.tell()} for it"
            raise ValueError(f"{part.filename} claims {claimed:.2g} bytes, {has}")
        check_places(shape, part.file_size)


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name, compressed, whole or not at all."""
    # An open file, because numpy would append .npz to the temporary name.
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]

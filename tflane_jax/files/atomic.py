"""Write files and folders whole or not at all.

The content is written under a hidden temporary name beside its destination and then renamed. A reader sees the old
content or the new one, never a part. A killed process leaves the destination as it was, and at most a file or folder
named `.<name>.<process>-<random>.tmp`, behind which a writer may put a suffix of its own. Processes of several machines
or containers, whose numbers may be equal, never share such a name. What was renamed survives a power failure: the
content is flushed to the device before, the folder after.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files.wording import no_utf8

_TEMPORARY = re.compile(r"\..+\.\d+-[\da-f]+\.tmp(\.\w+)?")
_FULL = (errno.ENOSPC, errno.EDQUOT)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


@contextlib.contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block ends without an error.

    The block creates a file or a folder at the temporary path. A file replaces a file, a folder replaces a folder; the
    parents of `path` are created. After an error the temporary content is deleted and `path` is as it was.

    The temporary name ends in `.tmp`, because `Path.glob("*.json")` finds hidden files too. Writers that choose a
    format by the suffix need to be told the format, or write to this name with their suffix behind it.

    Two renames replace a folder. A process killed between them leaves the old folder under its temporary name.

    Raises:
        UserError: an OSError occurred in the block or in renaming, or `path` has no name (`.`, `/`). The message has
            `path`, the cause and the remedy.
        ValueError: the block wrote nothing.
    """
    path = Path(path)
    _check_name(path)
    temporary = _temporary(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if not os.path.lexists(temporary):
            raise ValueError(f"nothing was written to {temporary}, so {path} cannot be replaced")
        rename_flushed(temporary, path)
    except OSError as error:
        raise UserError(_message(path, temporary, error)) from error
    finally:
        _delete(temporary)


def delete_older(folder: Path, *names: str) -> None:
    """Delete files of an earlier result, if they are there, so that none is left beside those of a new one.

    Raises UserError where one cannot be deleted.
    """
    for path in (folder / name for name in names):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            cause = error.strerror or str(error)
            raise UserError(f"cannot delete {path}: {cause}; it belongs to an earlier result") from error


def write_bytes(path: Path | str, content: bytes | bytearray) -> Path:
    """Write a file whole or not at all and return its path; raises UserError as `replacing` does."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def write_text(path: Path | str, text: str) -> Path:
    """Write a UTF-8 text file whole or not at all and return its path; raises UserError as `replacing` does."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def write_json(path: Path | str, content: Any, *, indent: int | None = 1, allow_nan: bool = True) -> Path:
    """Write a JSON file, ended by a newline, whole or not at all, and return its path.

    Args:
        path: of the file.
        content: what `json.dumps` takes.
        indent: spaces for each level; None writes one line.
        allow_nan: write NaN and infinity as the words that Python reads, though JSON has no such numbers.

    Raises:
        UserError: as `replacing` does.
        TypeError, ValueError: `content` is not JSON. The file is then as it was.
    """
    return write_text(path, json.dumps(content, indent=indent, allow_nan=allow_nan) + "\n")


def flush(path: Path) -> None:
    """Return when a file, or a folder with all its content, is on the device; raises OSError like writing."""
    for folder, _, names in os.walk(path):
        for name in (*names, "."):
            _flush_one(Path(folder) / name)
    if not path.is_dir():
        _flush_one(path)


def rename_flushed(written: Path, path: Path) -> None:
    """Rename a file or folder, in the place of one of that name; a power failure leaves the whole of either there.

    After an OSError, what was there is there again.
    """
    flush(written)
    if written.is_dir() and path.is_dir():
        _replace_folder(written, path)
    else:
        os.replace(written, path)
    _flush_one(path.parent)


def _flush_one(path: Path) -> None:
    if path.is_dir() and os.name != "posix":  # elsewhere, folders cannot be opened
        return
    handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)  # Windows flushes what it may write
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_writable(path: Path | str) -> None:
    """Raise UserError if a file cannot be written there, as far as can be told beforehand; nothing is created."""
    path = Path(path)
    _check_name(path)
    if os.path.isdir(path):
        raise UserError(f"cannot write {path}: it is a folder; choose another path")
    _check_place(path, _temporary(path), _absolute(path).parents)


def check_folder(folder: Path | str) -> None:
    """Raise UserError if files cannot be written into a folder, which need not exist, as `check_writable` does."""
    folder = Path(folder)
    _check_place(folder, folder, ((place := _absolute(folder)), *place.parents))


def _absolute(path: Path) -> Path:
    try:
        return path.absolute()
    except FileNotFoundError:
        raise UserError(
            f"cannot write {path}: the working directory is not there any more; change to another, or give an absolute "
            "path"
        ) from None


def _check_place(path: Path, probe: Path, above: Sequence[Path]) -> None:
    """Raise UserError if `path` cannot be a name, or the first of the folders `above` it that exists not be used."""
    try:
        str(path.absolute()).encode()
        os.lstat(probe)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except UnicodeEncodeError:  # libraries and JSON take no other names
        raise UserError(f"cannot write {str(path)!a}: {no_utf8(path, 'choose another path')}") from None
    except OSError as error:  # such as a name that is too long
        raise UserError(_message(path, probe, error)) from None
    found = next(folder for folder in above if os.path.lexists(folder))
    if not os.path.isdir(found):
        raise UserError(f"cannot write {path}: {found} is no folder; choose another path")
    if not os.access(found, os.W_OK | os.X_OK):
        raise UserError(f"cannot write {path}: no right to write in {found}; choose another path")


def check_replaces(outputs: Mapping[Path, Path], inputs: Iterable[Path]) -> None:
    """Raise UserError if a file to write would replace one to read.

    Args:
        outputs: for each file to write, the file that it is made from.
        inputs: all files to read.
    """
    read = {path.resolve() for path in inputs}
    for path, source in outputs.items():
        if path.resolve() in read:
            raise UserError(
                f"{path} is one of the files to read, and what is made from {source} would replace it: choose another "
                "folder with --out"
            )


def check_stem(stem: Path | str) -> None:
    """Raise UserError if STEM.md and STEM.json cannot be written, as far as can be told beforehand."""
    stem = Path(stem)
    _check_name(stem)
    for suffix in (".md", ".json"):
        check_writable(stem.with_name(stem.name + suffix))


def _check_name(path: Path) -> None:
    if path.name in ("", ".."):
        raise UserError(f"cannot write {path}: it names no file, only a folder; add a name")


def is_temporary(path: Path | str) -> bool:
    """Return whether the name is one that `replacing` gives, also with a further suffix: a killed process left it."""
    return _TEMPORARY.fullmatch(Path(path).name) is not None


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")


def _replace_folder(new: Path, path: Path) -> None:
    old = _temporary(path)
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    _delete(old)


def _delete(path: Path) -> None:
    """Delete a file or folder if it exists; an error here must not hide the one that brought us here."""
    with contextlib.suppress(OSError):
        if os.path.isdir(path) and not os.path.islink(path):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _message(path: Path, temporary: Path, error: OSError) -> str:
    cause = error.strerror or str(error) or type(error).__name__
    if error.filename and Path(os.fsdecode(error.filename)) not in (path, temporary):
        cause += f" ({os.fsdecode(error.filename)})"
    if error.errno in _FULL:
        remedy = "free space there or choose another path"
    elif error.errno in _FORBIDDEN:
        remedy = "give yourself the right to write there or choose another path"
    else:
        remedy = "check the path or choose another one"
    return f"cannot write {path}: {cause}; {remedy}"

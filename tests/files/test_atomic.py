"""Atomic writing: old or new content, never a part, whatever interrupts it."""

import errno
import glob
import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import threading

import pytest

from tflane_jax.errors import UserError
from tflane_jax.files import atomic
from tflane_jax.files.atomic import (
    check_stem,
    delete_older,
    is_temporary,
    replacing,
    write_bytes,
    write_json,
    write_text,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("write", "content", "expected"),
    [
        (write_text, "ä\n", "ä\n".encode()),
        (write_text, "", b""),
        (write_bytes, b"\x00\xff", b"\x00\xff"),
        (write_json, {"a": [1]}, b'{\n "a": [\n  1\n ]\n}\n'),
    ],
)
@pytest.mark.parametrize("before", [None, b"old"])
def test_writes_and_replaces(tmp_path, write, content, expected, before):
    path = tmp_path / "deep" / "file.json"
    if before is not None:
        path.parent.mkdir()
        path.write_bytes(before)
    assert write(path, content) == path
    assert path.read_bytes() == expected
    assert names(path.parent) == ["file.json"]


def test_json_takes_one_line_and_refuses_what_is_no_json(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": [1, 2]}, indent=None)
    assert path.read_text() == '{"a": [1, 2]}\n'
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, [math.nan], allow_nan=False)
    with pytest.raises(TypeError):
        write_json(path, {1j})
    assert json.loads(path.read_text()) == {"a": [1, 2]}
    write_json(path, [math.nan])
    assert path.read_text() == "[\n NaN\n]\n"
    assert names(tmp_path) == ["a.json"]


def test_a_folder_replaces_a_folder_and_not_a_file(tmp_path):
    path = tmp_path / "folder"
    for content in ("first", "second"):
        with replacing(path) as temporary:
            temporary.mkdir()
            (temporary / content).write_text(content)
        assert names(path) == [content]
        assert names(tmp_path) == ["folder"]
    with pytest.raises(UserError, match=r"cannot write .*folder: Is a directory"):
        write_text(path, "a file")
    write_text(tmp_path / "file", "kept")
    with pytest.raises(UserError, match=r"cannot write .*file: Not a directory"), replacing(tmp_path / "file") as new:
        new.mkdir()
    assert names(path) == ["second"]
    assert (tmp_path / "file").read_text() == "kept"
    assert names(tmp_path) == ["file", "folder"]


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("no"), OSError(errno.ENOSPC, "No space left")])
def test_an_error_in_the_block_leaves_the_old_content_alone(tmp_path, kind, error):
    path = tmp_path / "x"
    if kind == "folder":
        path.mkdir()
    target = path / "inside" if kind == "folder" else path
    target.write_text("old")

    def interrupted():
        with replacing(path) as temporary:
            if kind == "folder":
                temporary.mkdir()
            (temporary / "inside" if kind == "folder" else temporary).write_text("half of the ne")
            raise error

    with pytest.raises(UserError if isinstance(error, OSError) else type(error)):
        interrupted()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["x"]


@pytest.mark.parametrize("failing", [1, 2])
def test_a_folder_that_cannot_be_renamed_leaves_the_old_one(tmp_path, monkeypatch, failing):
    write_text(tmp_path / "x" / "inside", "old")
    calls, rename = [], os.replace

    def replace(source, destination):
        calls.append(source)
        if len(calls) == failing:
            raise OSError(errno.ENOSPC, "No space left on device")
        rename(source, destination)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(UserError, match="No space left on device"), replacing(tmp_path / "x") as temporary:
        temporary.mkdir()
    assert (tmp_path / "x" / "inside").read_text() == "old"
    assert names(tmp_path) == ["x"]


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "free space there"),
        (errno.EDQUOT, "free space there"),
        (errno.EROFS, "the right to write there"),
        (errno.EACCES, "the right to write there"),
        (errno.EIO, "check the path"),
    ],
)
def test_the_message_names_path_cause_and_remedy(tmp_path, number, remedy):
    path = tmp_path / "a.json"
    with pytest.raises(UserError) as caught, replacing(path):
        raise OSError(number, os.strerror(number))
    assert str(caught.value).startswith(f"cannot write {path}: {os.strerror(number)}; ")
    assert remedy in str(caught.value)


def test_the_message_names_another_file_that_failed(tmp_path):
    with (
        pytest.raises(UserError, match=r"cannot write .*copy: No such file or directory \(.*original\)"),
        replacing(tmp_path / "copy") as temporary,
    ):
        temporary.write_bytes((tmp_path / "original").read_bytes())
    assert names(tmp_path) == []


def test_a_file_in_the_way_of_the_folder_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write .*a\.json: File exists \(.*file\); check"):
        write_text(tmp_path / "file" / "a.json", "x")
    assert names(tmp_path) == ["file"]


def test_a_block_that_writes_nothing_is_an_error_of_the_program(tmp_path):
    (tmp_path / "x").write_text("old")
    with pytest.raises(ValueError, match="nothing was written"), replacing(tmp_path / "x"):
        pass
    assert (tmp_path / "x").read_text() == "old"


def test_temporary_names_are_unique_and_hidden_from_globs(tmp_path):
    path = tmp_path / "a.json"
    with replacing(path) as first, replacing(path) as second:
        assert first != second
        for temporary in (first, second):
            temporary.write_text("x")
            assert temporary.parent == tmp_path
            assert str(os.getpid()) in temporary.name
            assert is_temporary(temporary)
        assert list(tmp_path.glob("*.json")) == []
        assert glob.glob(str(tmp_path / "*")) == []
    assert names(tmp_path) == ["a.json"]
    assert not any(map(is_temporary, ("a.json", ".a.json", ".tmp", "a.12-3.tmp", ".gitignore")))


def test_processes_of_two_machines_with_one_number_have_names_of_their_own(tmp_path):
    def name_in_a_new_process():
        spec = importlib.util.spec_from_file_location("fresh", atomic.__file__)
        fresh = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(fresh)
        with fresh.replacing(tmp_path / "a.json") as temporary:
            temporary.touch()
        return temporary.name

    assert name_in_a_new_process() != name_in_a_new_process()


@pytest.mark.parametrize("before", ["old", None])
def test_a_killed_process_leaves_the_old_content(tmp_path, before):
    path = tmp_path / "a.json"
    if before:
        path.write_text(before)
    code = (
        "import os, signal\nfrom tflane_jax.files.atomic import replacing\n"
        f"with replacing({str(path)!r}) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code])
    assert done.returncode == -signal.SIGKILL
    left = [other for other in tmp_path.iterdir() if other != path]
    assert len(left) == 1
    assert is_temporary(left[0])
    assert (path.read_text() if before else path.exists()) == (before or False)
    write_text(path, "new")
    assert path.read_text() == "new"


def test_writers_side_by_side_never_mix(tmp_path):
    path, contents = tmp_path / "a.txt", [letter * 50_000 for letter in "abcd"]
    write_text(path, contents[0])

    def write(text):
        for _ in range(20):
            write_text(path, text)

    threads = [threading.Thread(target=write, args=(text,)) for text in contents]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert path.read_text() in contents
    for thread in threads:
        thread.join()
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("path", [".", "/", "", ".."])
def test_a_path_without_a_name_is_told(path):
    for write in (check_stem, lambda path: write_text(path, "x")):
        with pytest.raises(UserError, match="it names no file, only a folder; add a name"):
            write(path)


def test_a_name_that_is_too_long_is_told(tmp_path):
    for write in (check_stem, lambda path: write_text(path, "x")):
        with pytest.raises(UserError, match=r"a(\.md)?: File name too long; check the path"):
            write(tmp_path / ("a" * 300))
    assert names(tmp_path) == []


def test_the_files_of_a_stem_are_checked_before_they_are_made(tmp_path):
    check_stem(tmp_path / "deep" / "table")
    assert names(tmp_path) == []
    (tmp_path / "table.json").mkdir()
    with pytest.raises(UserError, match=r"cannot write .*table\.json: it is a folder"):
        check_stem(tmp_path / "table")


def test_files_of_an_earlier_result_are_deleted(tmp_path):
    for name in ("old.png", "other.png"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    delete_older(tmp_path, "old.png", "none.png")
    assert names(tmp_path) == ["folder", "other.png"]
    with pytest.raises(UserError, match=r"cannot delete .*folder: .*; it belongs to an earlier result"):
        delete_older(tmp_path, "folder")

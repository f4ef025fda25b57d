"""The folder of a run: its files, and the lock that only one process at a time can hold.

config.json, config.txt   resolved configuration, as JSON and as text
provenance.json           git hash, versions, device, cores, threads and command of every start; if it was damaged,
                          the damaged one is provenance.damaged.json
metrics.jsonl             records; tensorboard/ holds the same numbers
checkpoints/              see training.checkpoint
curves.png, pictures/     drawn at every evaluation
evaluations/              tables of `tflane eval`
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from tflane_jax.config_io import first_difference
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_writable, is_temporary, write_json, write_text
from tflane_jax.files.fields import load_json
from tflane_jax.files.locks import take
from tflane_jax.migrations import value_at
from tflane_jax.processes import agreed, from_first
from tflane_jax.progress import write
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.provenance import add_provenance

Start = Literal["new", "resume", "overwrite"]
CurrentForm = Callable[[dict[str, Any]], tuple[dict[str, Any], list[str]]]
"""Saved configuration (JSON) -> the same in the form of this version, and notices for the user."""
_COPY = 'A copy is the entry "config" of checkpoints/step_.../manifest.json: write it there, or start with --overwrite'
_FREE = {"training": ("shard_state",), "evaluation": ("batch_size", "pictures")}
_STEP = re.compile("step_0*[1-9][0-9]*")  # not step 0, which a conversion that was killed leaves
_WORKERS = ("threads", "ahead", "processes")  # of `StreamingConfig`
_FILES = (
    "config.json",
    "config.txt",
    "provenance.json",
    "provenance.damaged.json",
    "metrics.jsonl",
    "metrics.jsonl.tmp",
    "curves.png",
    "run.lock",
)
_FOLDERS = ("tensorboard", "checkpoints", "pictures", "evaluations")
_CONTENT = (*_FILES, *_FOLDERS)


def read_config(folder: Path) -> dict[str, Any]:
    """Return the resolved configuration of a run as saved (JSON); raises UserError if the folder holds no run."""
    path = folder / "config.json"
    if not path.exists():
        copied = any(map(_STEP.fullmatch, _names(folder / "checkpoints")))
        raise UserError(f"{folder} holds no run (it has no config.json)" + (f". {_COPY}" if copied else ""))
    try:
        content = load_json(path)
    except UserError as error:
        raise UserError(f"{error}. {_COPY}") from error
    if not isinstance(content, dict):
        raise UserError(f"{path} is damaged: it holds no configuration. {_COPY}")
    return content


def fixed(config: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration (JSON) without what a resumed run may change.

    That is where the devices hold its state, the workers that load examples, and what an evaluation needs of memory and
    draws: neither batches nor scores depend on these.
    """
    config = without_workers(config)
    for part, names in _FREE.items():
        if isinstance(settings := config.get(part), dict):
            config[part] = {name: value for name, value in settings.items() if name not in names}
    return config


def without_workers(config: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration (JSON) without what each process of a training may choose: the workers that load."""
    config = dict(config)
    if isinstance(loading := value_at(config, "data.loading"), dict):
        others = {name: value for name, value in loading.items() if name not in _WORKERS}
        config |= {"data": config["data"] | {"loading": others}}
    return config


def check_unchanged(folder: Path, resolved: dict[str, Any], current_form: CurrentForm | None = None) -> list[str]:
    """Return the notices of `current_form` for a run that is to be resumed with a configuration (JSON).

    Raises UserError if config.json or the latest checkpoint has another one: the file may have been edited since.
    """

    def difference(saved: dict[str, Any]) -> str:
        return first_difference(fixed(with_same_origin(saved, resolved, folder)), fixed(resolved))

    saved, notices = read_config(folder), []
    if current_form is not None:
        saved, notices = current_form(saved)
    if found := difference(saved):
        raise UserError(
            f"{folder} was started with another configuration ({found}): resume it as it is, or start another run from "
            "its weights (training.init_from)"
        )
    checkpoints = Checkpoints(folder / "checkpoints")
    for step in checkpoints.steps()[-1:]:
        trained = checkpoints.manifest(step).config
        try:
            trained = trained if current_form is None else current_form(trained)[0]
        except UserError as error:
            raise UserError(f"{checkpoints.path(step)} is damaged: {error}; delete that folder") from error
        if found := difference(trained):
            raise UserError(
                f"{folder / 'config.json'} was changed ({found}) since step {step}: restore it from the entry "
                f'"config" of {checkpoints.path(step)}/manifest.json, or start another run from this one '
                "(training.init_from)"
            )
    return notices


def agree_on_data(data: Mapping[str, Any]) -> None:
    """Raise UserError, in all processes, where one has another number of "examples" or other files than the first."""
    first = from_first(lambda: dict(data))
    with agreed():
        if data != first:
            found = f"{data['examples']} training examples, the first process {first['examples']}"
            if data["examples"] == first["examples"]:
                found = "other scenes or maps to train on than the first process"
            raise UserError(f"it has {found}: give all processes the same data")


def check_same_data(folder: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise UserError if a run was trained on another number of "examples", or on files with another "content"."""
    change = ""
    if before["examples"] != now["examples"]:
        change = f"was trained on {before['examples']} examples, and the training data have {now['examples']} now"
    elif before["content"] and before["content"] != now["content"]:  # "" where an earlier version knew none
        change = "was trained on other scenes or maps: the files of its training data have changed since"
    with agreed():
        if change:
            raise UserError(
                f"{folder} {change}: restore them, or start another run (from this one: training.init_from)"
            )


def unused_changes(folder: Path, used: dict[str, Any], current_form: CurrentForm) -> list[str]:
    """Return a notice if config.json is not the configuration (JSON) of the run's checkpoints, which is used."""
    try:
        saved, _ = current_form(read_config(folder))
    except UserError:  # only the checkpoints are needed
        return []
    difference = first_difference(fixed(with_same_origin(saved, used, folder)), fixed(used))
    if not difference:
        return []
    return [
        f"{folder / 'config.json'} was changed ({difference}): the configuration of the checkpoints counts. For other "
        "settings, train from the run (training.init_from)"
    ]


def with_same_origin(saved: dict[str, Any], resolved: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a saved configuration (JSON) with `training.init_from` as `resolved` has it, where both mean one run.

    They mean one run if both lie beside `folder` under the same name; paths may differ, because folders of runs are
    moved between machines.
    """
    old, new = (config.get("training", {}).get("init_from") for config in (saved, resolved))
    if not isinstance(old, str) or not isinstance(new, str) or Path(old).name != Path(new).name:
        return saved
    if Path(new).parent.resolve() != folder.parent.resolve():
        return saved
    return saved | {"training": saved["training"] | {"init_from": new}}


@contextlib.contextmanager
def claimed(folder: Path, start: Start) -> Iterator[None]:
    """Prepare the folder and lock it for this process inside the block.

    Args:
        folder: of the run.
        start: "new" refuses a folder that holds a run, "overwrite" replaces it (see `begin`), "resume" requires a run.

    Raises:
        UserError: the folder does not fit `start`, another process trains into it, or it cannot be written.
    """
    check_start(folder, start)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(folder / "run.lock", "a")  # noqa: SIM115 (held open while the run lasts)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror or error}") from error
    with lock:
        _lock(lock.fileno(), folder)
        yield


def begin(folder: Path, start: Start, config: dict[str, Any], text: str, **started_from: Any) -> list[str]:
    """Write the first files of a run into a claimed folder, and return notices about the code that trains it.

    Only here "overwrite" deletes the run that was there: whatever fails before leaves it whole.

    Args:
        folder: of the run.
        start: as for `claimed`.
        config, text: resolved configuration, as JSON and as text.
        started_from: see `provenance.add_provenance`.
    """
    if start == "overwrite":
        for name in reversed(_CONTENT):  # config.json last: until then the folder holds a run to overwrite
            _delete(folder / name)
    notices = add_provenance(folder, **started_from)
    write_text(folder / "config.txt", text)
    write_json(folder / "config.json", config)  # last: from here on the folder holds a run
    return notices


def check_start(folder: Path, start: Start) -> None:
    """Raise UserError where `claimed` would, as far as can be told beforehand; nothing is written."""
    check_writable(folder / "run.lock")
    holds_run = (folder / "config.json").is_file()
    if is_locked(folder):
        raise _in_use(folder)
    if start != "overwrite":
        _check_kinds(folder)
    if start == "new" and holds_run:
        raise UserError(
            f"{folder} already holds a run: continue it with --resume, replace it with --overwrite, "
            "or choose another folder with --out"
        )
    if start == "new" and (left := sorted(filter(_STEP.fullmatch, _names(folder / "checkpoints")))):
        raise UserError(
            f"{folder} holds checkpoints ({left[-1]}), but not the config.json of their run: delete the "
            "folder, choose another one with --out, or let `tflane train` replace them with --overwrite"
        )
    if start == "resume" and not holds_run:
        raise UserError(f"{folder} holds no run to resume: leave --resume out to start one")
    if start == "overwrite" and (links := [folder / name for name in _CONTENT if (folder / name).is_symlink()]):
        raise UserError(
            f"{links[0]} is a link, and what it points to is not deleted: remove the link, or choose another folder "
            "with --out"
        )
    # A process killed while it wrote the first file leaves a temporary one: still no foreign file.
    if not holds_run and (other := {name for name in _names(folder) if not is_temporary(name)} - set(_CONTENT)):
        raise UserError(f"{folder} is not empty ({min(other)}) and holds no run: choose another folder with --out")


def _check_kinds(folder: Path) -> None:
    """Raise UserError for a folder in the place of a run's file, or the reverse."""
    for name in _CONTENT:
        path, is_folder = folder / name, name in _FOLDERS
        if os.path.lexists(path) and not (path.is_dir() if is_folder else path.is_file()):
            what = "no folder, as a run has" if is_folder else "no file, as a run has"
            raise UserError(f"{path} is {what} under that name: restore it or move it away, or use --overwrite")


def is_part_of_run(path: Path) -> bool:
    """Return whether a file exists that is a run's own, and no table or picture made from the run."""
    if not path.exists():
        return False
    path = path.resolve()
    folder = next((folder for folder in path.parents if (folder / "checkpoints").is_dir()), None)
    return folder is not None and path.relative_to(folder).parts[0] in set(_CONTENT) - {"pictures", "evaluations"}


def _names(folder: Path) -> list[str]:
    try:
        return [p.name for p in folder.iterdir()] if folder.is_dir() else []
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror or error}") from error


def _lock(file: int, folder: Path) -> None:
    def without_locks(reason: str) -> None:
        write(f"{folder}: this file system has no locks ({reason}): see to it that one process trains there")

    if not take(file, tell=without_locks):
        raise _in_use(folder)


def _in_use(folder: Path) -> UserError:
    return UserError(f"another process is training into {folder}: wait for it or choose another folder")


def is_locked(folder: Path) -> bool:
    """Return whether a process trains into the folder: another one, or this one."""
    try:
        with open(folder / "run.lock") as lock:
            return not take(lock, shared=True)
    except OSError:  # a folder without a lock
        return False


def _delete(path: Path) -> None:
    try:
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "run.lock":
            path.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(
            f"cannot delete {error.filename or path}: {error.strerror or error}; the run in {path.parent} cannot be "
            "replaced: delete it, or choose another folder with --out"
        ) from error

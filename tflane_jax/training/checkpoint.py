"""Checkpoints: complete or absent, verified by checksums, self-contained.

A checkpoint is a folder, `step_00001000/`. `state/` holds the training state as an orbax tree of plain arrays.
`manifest.json` holds the step, its metrics, the loop's progress, the run's resolved configuration, and the checksum of
every file of the state. The folder is written under another name and then renamed. Nothing is ever unpickled.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import time
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from flax import serialization
from flax.traverse_util import unflatten_dict

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import is_temporary, rename_flushed
from tflane_jax.training.array_files import first_line, flat, load_arrays, save_arrays, system_error
from tflane_jax.training.manifest import VERSION, Manifest, wrong_entry
from tflane_jax.training.state import TrainState, state_from, tree_of

# In `Manifest.progress`, where versions that do not know it leave it alone: the checksum of the configuration.
_CONFIG_SUM = "config_sum"
Which = int | Literal["last", "best"]

# What content raises that is not what was written: wrong values, missing files, other kinds of files.
_DAMAGE = (
    *(ValueError, TypeError, LookupError, AttributeError, RecursionError),
    *(FileNotFoundError, IsADirectoryError, NotADirectoryError),
)
_REMEDIES = {
    errno.EACCES: "give yourself the right to read it",
    errno.EPERM: "give yourself the right to read it",
    errno.EMFILE: "allow more open files (ulimit -n)",
    errno.ENFILE: "allow more open files (ulimit -n)",
}


class _DamagedError(UserError):
    """The content of a checkpoint is not what was written."""


class Checkpoints:
    """The checkpoints of a run: the last few, and the best by one metric.

    Args:
        folder: where they are; created when the first one is saved.
        keep: how many of the latest to keep.
        best_metric: name in `Manifest.metrics`, higher is better.
    """

    def __init__(self, folder: Path, *, keep: int = 2, best_metric: str = ""):
        self.folder, self._keep, self._best_metric = folder, keep, best_metric

    def steps(self) -> list[int]:
        """Return the steps of all checkpoints, ascending."""
        try:
            names = [p.name for p in self.folder.iterdir()] if self.folder.is_dir() else []
        except OSError as error:
            raise UserError(f"cannot read {self.folder}: {error.strerror or error}") from error
        return sorted(int(found[1]) for name in names if (found := re.fullmatch(r"step_(\d{8,})", name)))

    def path(self, step: int) -> Path:
        """Return the folder of the checkpoint of that step."""
        return self.folder / f"step_{step:08d}"

    def best_step(self) -> int | None:
        """Return the step with the highest best metric (the earliest of equals), None if none was evaluated."""
        scores = [(self._score(step), -step) for step in self.steps()]
        found = [(score, negative) for score, negative in scores if score is not None and np.isfinite(score)]
        return -max(found)[1] if found else None

    def _score(self, step: int) -> float | None:
        try:
            return self.manifest(step).metrics.get(self._best_metric)
        except UserError:
            if self.path(step).exists():
                raise
            return None  # the training dropped it since it was listed

    def save(self, state: TrainState, manifest: Manifest) -> Path:
        """Write a checkpoint and drop those that need not be kept.

        A checkpoint of the same step is replaced, unless it was evaluated: its metrics may make it the best one, and
        the state after a step is always the same.
        """
        place = self.path(manifest.step)
        if place.exists() and self._is_evaluated(manifest.step):
            return place
        writing = self.folder / f".writing-{os.getpid()}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for stale in self.folder.iterdir():  # left by a process that was killed: unfinished, dropped or replaced
                if stale.name.startswith(".writing-") or is_temporary(stale):
                    shutil.rmtree(stale, ignore_errors=True)
            save_arrays(writing / "state", _plain(state))
            content = asdict(manifest) | {"files": _checksums(writing)}
            content["progress"] = {**manifest.progress, _CONFIG_SUM: _sum_of(manifest.config)}
            (writing / "manifest.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
            if not place.is_dir():
                place.unlink(missing_ok=True)  # a file is no checkpoint
            rename_flushed(writing, place)
            self._drop_old()
        except OSError as error:
            _remove_unfinished(writing)
            raise UserError(
                f"cannot write checkpoint {place}: {error.strerror or error}; make room or give the right to write "
                "there, and go on from the checkpoint before with --resume"
            ) from error
        return place

    def manifest(self, step: int) -> Manifest:
        """Return the description of a checkpoint; raises UserError if it is damaged or cannot be read."""
        try:
            content = json.loads((self.path(step) / "manifest.json").read_text(encoding="utf-8"))
        except Exception as error:
            raise self._unreadable(step, error, "manifest.json: ") from error
        version = content.get("version") if isinstance(content, dict) else None
        if type(version) is int and version != VERSION:
            raise UserError(f"checkpoint {self.path(step)} has layout version {version}, this program reads {VERSION}")
        if wrong := wrong_entry(content, step):
            raise self._damaged(step, f"manifest.json: {wrong} is not what was written")
        return Manifest(**content)

    def find(self, which: Which) -> int:
        """Return the step of a checkpoint; raises UserError, with a list of those that exist, if there is none."""
        steps = self.steps()
        if not steps and not (run := self.folder.parent).joinpath("config.json").exists():
            inside = [str(path.parent) for path in sorted(run.glob("*/config.json"))[:3]]
            hint = f"; did you mean {' or '.join(inside)}?" if inside else ""
            raise UserError(
                f"{run} is no run folder: it has no config.json, and {self.folder} holds no checkpoint{hint}"
            )
        if not steps:
            raise UserError(
                f"{self.folder} holds no checkpoint: the run ended before its first one was written; go on with it "
                f"(tflane train --resume --out {self.folder.parent}) or delete it"
            )
        step = steps[-1] if which == "last" else self.best_step() if which == "best" else which
        if step is None:
            wanted = f"the score {self._best_metric} (training.best_metric)" if self._best_metric else "a score"
            raise UserError(f"no checkpoint in {self.folder} has {wanted}, so none is best: ask for `last`")
        if step not in steps:
            raise UserError(f"{self.folder} has no checkpoint of step {step}, only {[*steps, 'last', 'best']}")
        return step

    def restore(self, step: int, template: TrainState) -> TrainState:
        """Return the state saved at `step`, on the default device.

        Args:
            step: which checkpoint.
            template: a state (or the shapes of one) of the same task, optimizer and seeds.

        Raises:
            UserError: the checkpoint is damaged, or belongs to another model or optimizer.
        """
        saved, shapes = _with_current_names(self.arrays(step)), jax.eval_shape(_plain_tree, template)
        expected = serialization.to_state_dict(shapes)
        if (difference := _first_difference(saved, flat(expected))) is not None:
            raise UserError(
                f"checkpoint {self.path(step)} does not fit this configuration: {difference}. It was made by another "
                "model, optimizer or number of seeds: undo the change of config.json (config.txt has the settings "
                "that the run was started with), or train another run"
            )
        # Through the template's own dict, because empty parts of an optimizer's state are not stored.
        leaves = jax.tree_util.tree_map_with_path(
            lambda path, _: saved["/".join(entry.key for entry in path)], expected
        )
        trees: dict[str, Any] = serialization.from_state_dict(shapes, leaves)
        return jax.device_put(state_from(trees | {"key": jax.random.wrap_key_data(trees["key"])}, template))

    def arrays(self, step: int) -> dict[str, np.ndarray]:
        """Return the saved arrays by path ("ema_params/encoder/kernel"); raises UserError like `manifest`."""
        self.check(step)
        try:
            return load_arrays(self.path(step) / "state")
        except Exception as error:  # orbax and tensorstore have many
            raise self._unreadable(step, error) from error

    def check(self, step: int) -> None:
        """Raise UserError like `manifest` if the files of a checkpoint are not those that were written."""
        folder, manifest = self.path(step), self.manifest(step)
        try:
            found = _checksums(folder)
        except Exception as error:
            raise self._unreadable(step, error) from error
        if found != manifest.files:
            wrong = sorted(k for k in found.keys() | manifest.files.keys() if found.get(k) != manifest.files.get(k))
            raise self._damaged(step, f"{wrong[0]} is not what was written")

    def params(self, step: int) -> dict[str, Any]:
        """Return the averaged parameters of a checkpoint (leading seed axis where it has several), numpy."""
        prefix = "ema_params/"
        arrays = self.arrays(step)
        averaged = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
        if not averaged:
            raise self._damaged(step, "it has no averaged parameters")
        return unflatten_dict(averaged, sep="/")

    def digest(self, step: int) -> str:
        """Return a hash of a checkpoint's arrays and of the configuration that it was made with."""
        manifest = self.manifest(step)
        text = json.dumps([manifest.step, manifest.files, manifest.config], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def is_edited(self, step: int) -> bool | None:
        """Return whether a checkpoint's configuration was changed after it was written; None where that is unknown."""
        manifest = self.manifest(step)
        written = manifest.progress.get(_CONFIG_SUM)
        return None if written is None else written != _sum_of(manifest.config)

    def _is_evaluated(self, step: int) -> bool:
        try:
            return bool(self.manifest(step).metrics)
        except _DamagedError:  # to be replaced
            return False

    def _drop_old(self) -> None:
        steps = self.steps()
        kept = {*steps[-self._keep :], self.best_step()}
        for step in steps:
            if step not in kept:
                self._drop(self.path(step))

    def _drop(self, place: Path) -> None:
        """Delete a checkpoint; a process that is killed meanwhile leaves no part of one that looks like a whole."""
        aside = self.folder / f".writing-{os.getpid()}-{place.name}"
        place.rename(aside)
        shutil.rmtree(aside)

    def damaged_progress(self, step: int, error: Exception) -> UserError:
        """Return the error for a checkpoint whose entry "progress" the loop cannot read."""
        return self._damaged(step, f"manifest.json: progress is not what was written: {first_line(error)}")

    def _unreadable(self, step: int, error: Exception, what: str = "") -> UserError:
        """Return the error for a checkpoint whose reading failed; it may be whole, unless its content is the cause."""
        cause = system_error(error)
        if isinstance(cause, _DAMAGE):
            return self._damaged(step, what + first_line(error))
        reason, remedy = first_line(cause), "see to that and read it again"
        if isinstance(cause, MemoryError):
            reason, remedy = "not enough memory", "free some"
        elif isinstance(cause, ImportError):
            remedy = "install that package"
        elif isinstance(cause, OSError):
            reason, remedy = cause.strerror or reason, _REMEDIES.get(cause.errno or 0, remedy)
        return UserError(f"cannot read checkpoint {self.path(step)}: {what}{reason}; {remedy}")

    def _damaged(self, step: int, why: str) -> UserError:
        others = [other for other in self.steps() if other != step and (self.path(other) / "manifest.json").is_file()]
        remedy = f"the run can go on from step {others[-1]}" if others else "there is no other: start the run again"
        return _DamagedError(f"checkpoint {self.path(step)} is damaged ({why}): delete that folder; {remedy}")


def _remove_unfinished(folder: Path) -> None:
    """Delete what a failed write left; its threads may still be writing, and may make the folder anew."""
    gone = 0
    for _ in range(40):
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.05)
        gone = 0 if folder.exists() else gone + 1
        if gone == 3:
            return


def _sum_of(config: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(config, sort_keys=True).encode())


def _checksums(folder: Path) -> dict[str, int]:
    def refuse(error: OSError) -> None:
        raise error

    walked = os.walk(folder / "state", onerror=refuse)
    files = sorted(p for top, _, names in walked for name in names if (p := Path(top, name)).is_file())
    return {p.relative_to(folder).as_posix(): zlib.crc32(p.read_bytes()) for p in files}


# ---------------------------------------------------------------------------------------------------------------------
# A state as named plain arrays. The random key is stored as its raw words.


def _plain_tree(state: TrainState) -> dict[str, Any]:
    trees = tree_of(state)
    return trees | {"key": jax.random.key_data(trees["key"])}


def _plain(state: TrainState) -> dict[str, np.ndarray]:
    words = replace(state, key=jax.random.key_data(state.key))
    return flat(serialization.to_state_dict(tree_of(jax.device_get(words))))


def _with_current_names(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a checkpoint by the names of this version: Muon's state was that of optax's Muon."""
    old = re.compile(r"(.*/inner_states/muon/inner_state/)0/inner_states/(?:muon/inner_state/0/(count|mu/.*)|.*)")
    found = [(name, old.fullmatch(name), array) for name, array in arrays.items()]
    return {match[1] + match[2] if match else name: a for name, match, a in found if match is None or match[2]}


def _first_difference(tree: dict[str, Any], expected: dict[str, Any]) -> str | None:
    for name in sorted(tree.keys() | expected.keys()):
        if name not in tree or name not in expected:
            return f"{name} is {'not expected' if name in tree else 'missing'}"
        here, wanted = tree[name], expected[name]
        if (here.shape, here.dtype) != (wanted.shape, wanted.dtype):
            return f"{name} is {here.dtype}{list(here.shape)}, not {wanted.dtype}{list(wanted.shape)}"
    return None

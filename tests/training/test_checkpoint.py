"""Checkpoints: bit-identical round trips, and a clear message for every fault of a folder."""

import errno
import json
import os
import shutil
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.training.stub import LineTask, line_arrays
from tflane_jax.errors import UserError
from tflane_jax.models.parameters import split_statistics
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.manifest import Manifest
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.state import init_states, of_all_seeds, tree_of
from tflane_jax.training.vectors import ravel

TASK = LineTask()
CONFIG = {"class": "RunConfig", "training": {"steps": 9}}


def state_of(seeds=(0,), task=TASK, **optim):
    example = jax.tree.map(lambda leaf: leaf[0], line_arrays())
    optimizer = make_optimizer(OptimConfig(warmup_steps=0, **optim), 9)
    return of_all_seeds(init_states(task, optimizer, seeds, example))


@pytest.fixture(scope="module")
def state():
    return state_of()


def saved(folder, state, scores, **settings):
    checkpoints = Checkpoints(folder, best_metric="score", **settings)
    for step, score in scores:
        metrics = {} if score is None else {"score": score}
        marked = state.replace(step=jnp.int32(step))
        checkpoints.save(marked, Manifest(step=step, config=CONFIG, metrics=metrics, progress={"seconds": 0.1}))
    return checkpoints


def words(state):
    return jax.tree.map(np.array, state.replace(key=jax.random.key_data(state.key)))


@pytest.mark.parametrize("optimizer", ["adam", "muon"])
@pytest.mark.parametrize("seeds", [(0,), (5, 6)])
def test_round_trip_is_exact(tmp_path, seeds, optimizer):
    state = state_of(seeds, optimizer=optimizer)
    odd = jax.tree.map(lambda leaf: leaf * np.float32(1 / 3), state.params)  # full mantissas
    odd["line"]["bias"] = odd["line"]["bias"].at[..., 0].set(jnp.nan).at[..., 1].set(-0.0)
    odd, statistics = split_statistics(odd)
    means = [jax.tree.map(lambda leaf, x=x: leaf + np.float32(x), statistics) for x in (1 / 3, -0.7)]
    state = state.replace(learned=ravel(odd, state.learned.layout), statistics=means[0], ema_statistics=means[1])
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(state, Manifest(step=3, config=CONFIG))
    restored = Checkpoints(tmp_path).restore(3, state)
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for before, after in zip(jax.tree.leaves(words(state)), jax.tree.leaves(words(restored)), strict=True):
        assert (before.tobytes(), before.dtype, before.shape) == (after.tobytes(), after.dtype, after.shape)
    np.testing.assert_array_equal(
        checkpoints.params(3)["line"]["kernel"], np.asarray(state.ema_params["line"]["kernel"])
    )


def test_the_last_and_best_checkpoints_are_kept(tmp_path, state):
    scores = [(1, 0.5), (2, 0.9), (3, 0.9), (4, 0.1), (5, None), (6, None)]
    checkpoints = saved(tmp_path, state, scores, keep=2)
    assert checkpoints.steps() == [2, 5, 6]
    assert (checkpoints.find("best"), checkpoints.find("last"), checkpoints.find(5)) == (2, 6, 5)
    assert checkpoints.manifest(2).config == CONFIG
    assert checkpoints.manifest(2).progress["seconds"] == 0.1


def test_an_edited_configuration_is_noticed(tmp_path, state):
    checkpoints = saved(tmp_path, state, [(1, None)])
    assert checkpoints.is_edited(1) is False
    path = checkpoints.path(1) / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"config": {"other": 1}}))
    assert checkpoints.is_edited(1) is True
    path.write_text(json.dumps(content | {"progress": {}}))  # of an older version
    assert checkpoints.is_edited(1) is None


def test_saving_a_step_again_replaces_it(tmp_path, state):
    checkpoints = saved(tmp_path, state, [(1, None), (1, 0.7)])
    assert checkpoints.steps() == [1]
    assert checkpoints.manifest(1).metrics == {"score": 0.7}


def test_leftovers_of_a_killed_write_are_no_checkpoint(tmp_path, state):
    leftover = tmp_path / ".writing-123"
    (leftover / "state").mkdir(parents=True)
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.steps() == []
    saved(tmp_path, state, [(1, None)])
    assert not leftover.exists()
    assert checkpoints.steps() == [1]


@pytest.mark.parametrize("scores", [[(1, 0.5), (2, 0.4), (3, 0.6)], [(1, None), (1, 0.7)]], ids=["old", "replaced"])
def test_a_process_killed_while_it_deletes_a_checkpoint_leaves_no_part_of_it(tmp_path, state, monkeypatch, scores):
    def killed(path, *_, **__):
        (path / "manifest.json").unlink()
        raise KeyboardInterrupt

    saved(tmp_path, state, scores[:-1], keep=1)
    with monkeypatch.context() as patch:
        patch.setattr("tflane_jax.training.checkpoint.shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            saved(tmp_path, state, scores[-1:], keep=1)
    checkpoints = Checkpoints(tmp_path, keep=1, best_metric="score")
    assert all(checkpoints.manifest(step) for step in checkpoints.steps())
    checkpoints = saved(tmp_path, state, [(9, 1.0)], keep=1)
    assert (checkpoints.steps(), checkpoints.best_step()) == ([9], 9)
    assert [path.name for path in tmp_path.iterdir()] == ["step_00000009"]


def test_a_checkpoint_that_is_dropped_while_it_is_read_is_not_the_best(tmp_path, state, monkeypatch):
    checkpoints = saved(tmp_path, state, [(1, 0.9), (2, 0.5)])
    steps = checkpoints.steps()
    shutil.rmtree(checkpoints.path(1))
    monkeypatch.setattr(checkpoints, "steps", lambda: steps)
    assert checkpoints.best_step() == 2


@pytest.mark.parametrize(
    ("which", "message"),
    [("best", "ask for `last`"), (7, r"no checkpoint of step 7, only \[4, 'last', 'best'\]")],
)
def test_a_missing_checkpoint_is_an_error(tmp_path, state, which, message):
    with pytest.raises(UserError, match=message):
        saved(tmp_path, state, [(4, None)]).find(which)


def test_a_run_without_checkpoints_is_an_error(tmp_path):
    with pytest.raises(UserError, match="holds no checkpoint"):
        Checkpoints(tmp_path / "nothing").find("last")


@pytest.mark.parametrize(("config", "message"), [(False, "is no run folder"), (True, "ended before its first one")])
def test_only_a_run_is_said_to_have_ended_before_its_first_checkpoint(tmp_path, config, message):
    if config:
        (tmp_path / "config.json").touch()
    with pytest.raises(UserError, match=message):
        Checkpoints(tmp_path / "checkpoints").find("last")


def test_runs_inside_a_folder_that_is_none_are_suggested(tmp_path):
    (tmp_path / "tfm").mkdir()
    (tmp_path / "tfm" / "config.json").touch()
    with pytest.raises(UserError, match=r"is no run folder: .*; did you mean .*tfm\?$"):
        Checkpoints(tmp_path / "checkpoints").find("last")


def largest_file(folder):
    return max((p for p in (folder / "state").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)


@pytest.mark.parametrize("damage", ["flipped bit", "truncated", "file missing", "no manifest", "broken manifest"])
def test_damage_is_named_with_the_remedy(tmp_path, state, damage):
    checkpoints = saved(tmp_path, state, [(1, None), (2, None)])
    folder = checkpoints.path(2)
    file = largest_file(folder)
    content = bytearray(file.read_bytes())
    if damage == "flipped bit":
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    elif damage == "truncated":
        file.write_bytes(content[:-1])
    elif damage == "file missing":
        file.unlink()
    elif damage == "no manifest":
        (folder / "manifest.json").unlink()
    else:
        (folder / "manifest.json").write_text('{"step": 2, "conf')
    with pytest.raises(UserError) as error:
        checkpoints.restore(2, state)
    assert str(folder) in str(error.value)
    assert "delete that folder; the run can go on from step 1" in str(error.value)
    checkpoints.restore(1, state)


@pytest.mark.parametrize("where", ["load_arrays", "zlib.crc32", "json.loads"])
@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), "Permission denied; give yourself the right"),
        (ValueError("RESOURCE_EXHAUSTED: open [os_error_code='24']"), "Too many open files; allow more"),
        (OSError(errno.EIO, "Input/output error"), "Input/output error; see to that"),
        (MemoryError(), "not enough memory; free some"),
        (ModuleNotFoundError("No module named 'orbax'"), "No module named 'orbax'; install that package"),
        (RuntimeError("can't start new thread"), "can't start new thread; see to that"),
    ],
)
def test_a_checkpoint_that_cannot_be_read_now_is_not_called_damaged(tmp_path, state, monkeypatch, where, error, said):
    def fail(*_, **__):
        raise error

    checkpoints = saved(tmp_path, state, [(1, 0.5), (2, None)])
    monkeypatch.setattr(f"tflane_jax.training.checkpoint.{where}", fail)
    with pytest.raises(UserError, match=r"^cannot read checkpoint .*step_00000001: ") as caught:
        checkpoints.arrays(1)
    assert said in str(caught.value)
    assert "delete" not in str(caught.value)
    if where == "json.loads":
        with pytest.raises(UserError, match="cannot read"):  # nor replaced, which would lose its scores
            saved(tmp_path, state, [(1, None)])


def test_a_folder_that_cannot_be_listed_is_not_called_damaged(tmp_path, state, monkeypatch):
    def forbidden(path):
        raise PermissionError(errno.EACCES, "Permission denied", path)

    checkpoints = saved(tmp_path, state, [(1, None)])
    monkeypatch.setattr("os.scandir", forbidden)
    with pytest.raises(UserError, match="Permission denied; give yourself the right"):
        checkpoints.arrays(1)


def test_a_checkpoint_of_another_model_is_refused(tmp_path, state):
    checkpoints = saved(tmp_path, state, [(1, None)])
    with pytest.raises(UserError, match=r"does not fit.*line/bias is float32\[3\], not float32\[4\]"):
        checkpoints.restore(1, state_of(task=LineTask(features=4)))
    with pytest.raises(UserError, match="another model, optimizer or number of seeds"):
        checkpoints.restore(1, state_of(seeds=(0, 1)))
    with pytest.raises(UserError, match="params/second/offset"):
        checkpoints.restore(1, state_of(task=LineTask(second_layer=True)))


def test_files_hold_trees_by_the_names_of_the_first_version(tmp_path, state):
    found = saved(tmp_path, state, [(1, None)]).arrays(1)
    leaves, moments = ("line/kernel", "line/bias"), ("mu", "nu")
    expected = {f"{part}/{leaf}" for part in ("params", "ema_params") for leaf in (*leaves, "batch_stats/mean")}
    expected |= {f"opt_state/1/0/{moment}/{leaf}" for moment in moments for leaf in leaves}
    assert found.keys() == expected | {"step", "key", "opt_state/1/0/count", "opt_state/1/2/count"}
    np.testing.assert_array_equal(found["params/line/kernel"], state.params["line"]["kernel"])


def test_states_of_optaxs_muon_are_read(tmp_path):
    """Earlier versions had optax's Muon, whose state names more."""
    state = state_of(optimizer="muon")
    checkpoints = saved(tmp_path, state, [(1, None)])
    arrays, new = checkpoints.arrays(1), "opt_state/1/0/inner_states/muon/inner_state/"
    arrays = {n.replace(new, f"{new}0/inner_states/muon/inner_state/0/"): a for n, a in arrays.items()}
    mu = f"{new}0/inner_states/muon/inner_state/0/mu/line/kernel"
    arrays[mu] = np.arange(12, dtype=np.float32).reshape(4, 3)
    arrays[f"{new}0/inner_states/muon/inner_state/0/ns_coeffs"] = np.ones(3, np.float32)
    arrays[f"{new}0/inner_states/adam/inner_state/0/count"] = np.int32(0)
    checkpoints.arrays = lambda step: arrays
    restored = checkpoints.restore(1, state)
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    (found,) = (leaf for leaf in jax.tree.leaves(tree_of(restored)["opt_state"]) if np.array_equal(leaf, arrays[mu]))
    assert found.shape == (4, 3)


def test_a_newer_layout_is_refused(tmp_path, state):
    checkpoints = saved(tmp_path, state, [(1, None)])
    manifest = checkpoints.path(1) / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"version": 1', '"version": 2'))
    with pytest.raises(UserError, match="layout version 2"):
        checkpoints.restore(1, state)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda content: content | {"step": 2}, "step"),
        (lambda content: content | {"version": "one"}, "version"),
        (lambda content: content | {"notes": "mine"}, "notes"),
        (lambda content: {name: value for name, value in content.items() if name != "config"}, "config"),
        (lambda content: [content], "it"),
    ],
)
def test_an_entry_that_was_not_written_so_is_named(tmp_path, state, change, named):
    checkpoints = saved(tmp_path, state, [(1, None)])
    path = checkpoints.path(1) / "manifest.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(UserError, match=rf"damaged \(manifest.json: {named} is not what was written\)"):
        checkpoints.manifest(1)


def test_a_full_disk_is_a_message_and_leaves_nothing(tmp_path, state, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tflane_jax.training.checkpoint.save_arrays", full)
    with pytest.raises(UserError, match="No space left on device"):
        saved(tmp_path, state, [(1, None)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("moment", ["flush", "rename"])
@pytest.mark.parametrize("keep", [1, 2])
def test_a_full_disk_takes_no_checkpoint_that_was_to_be_replaced(tmp_path, state, monkeypatch, keep, moment):
    """Regression: it was deleted before the new one was on the disk."""
    saved(tmp_path, state, [(1, None), (2, None)], keep=keep)
    left = Checkpoints(tmp_path).steps()

    def full(*_):
        raise OSError(28, "No space left on device")

    rename = os.replace
    with monkeypatch.context() as patch:
        if moment == "flush":
            patch.setattr("tflane_jax.files.atomic.flush", full)
        else:
            patch.setattr(os, "replace", lambda old, new: full() if ".writing" in str(old) else rename(old, new))
        with pytest.raises(UserError, match="No space left on device"):
            saved(tmp_path, state, [(2, 0.7)], keep=keep)
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.steps() == left
    assert checkpoints.arrays(2)
    assert len(list(tmp_path.iterdir())) == len(left)
    assert saved(tmp_path, state, [(2, 0.7)], keep=keep).manifest(2).metrics == {"score": 0.7}


def test_a_write_that_the_system_refuses_is_one_message(tmp_path, state, capfd, monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr("sys.unraisablehook", lambda found: print(f"thread: {found.exc_value}", file=sys.stderr))
    large = {f"layer_{i}": np.random.default_rng(i).random(50_000, np.float32) for i in range(20)}
    monkeypatch.setattr("tflane_jax.training.checkpoint._plain", lambda _: large)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))  # of a file, bytes
        with pytest.raises(UserError) as caught:
            Checkpoints(tmp_path).save(state, Manifest(step=1, config=CONFIG))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    time.sleep(0.5)  # threads that report late
    assert str(caught.value).startswith(f"cannot write checkpoint {tmp_path / 'step_00000001'}: File too large; make")
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []

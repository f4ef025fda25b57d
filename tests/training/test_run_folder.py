"""Which folders a training takes, and what it replaces there."""

import dataclasses

import pytest

from tests.training.stub_run import CONFIG, RESOLVED, run
from tflane_jax.errors import UserError
from tflane_jax.training import run_folder
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.records import read_records
from tflane_jax.training.run_folder import check_start


def last_step(folder):
    """Return the step of a run's last record."""
    return read_records(folder / "metrics.jsonl")[-1]["step"]


def test_unsuitable_folders_are_refused(tmp_path):
    whole = tmp_path / "whole"
    run(whole, config=dataclasses.replace(CONFIG, steps=4))
    with pytest.raises(UserError, match=r"already holds a run.*--resume.*--overwrite"):
        run(whole)
    with pytest.raises(UserError, match="holds no run to resume"):
        run(tmp_path / "nothing", start="resume")
    with pytest.raises(UserError, match=r"another configuration \(training\.best_metric: score there, other here\)"):
        run(whole, start="resume", resolved=RESOLVED | {"training": RESOLVED["training"] | {"best_metric": "other"}})
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").touch()
    for start in ("new", "overwrite"):
        with pytest.raises(UserError, match=r"cat\.jpg"):
            run(tmp_path / "photos", start=start)
    assert (tmp_path / "photos" / "cat.jpg").exists()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write .*is no folder"):
        run(tmp_path / "file" / "run")


def test_overwriting_starts_again_and_spares_foreign_files(tmp_path):
    folder = tmp_path / "run"
    short = dataclasses.replace(CONFIG, steps=10)
    run(folder)
    (folder / "notes.txt").touch()
    run(folder, start="overwrite", config=short)
    assert Checkpoints(folder / "checkpoints").steps() == [7, 10]
    assert last_step(folder) == 10
    assert (folder / "notes.txt").exists()


def test_a_run_that_cannot_begin_replaces_none(tmp_path):
    """Regression: the old run was deleted before the parameters of the other were found missing."""
    folder, short = tmp_path / "run", dataclasses.replace(CONFIG, steps=4)
    run(folder, config=short)
    with pytest.raises(UserError, match="nothing"):
        run(folder, start="overwrite", config=dataclasses.replace(short, init_from=str(tmp_path / "nothing")))
    assert Checkpoints(folder / "checkpoints").steps() == [4]
    assert last_step(folder) == 4


def test_what_cannot_be_overwritten_is_named_and_stays_a_run(tmp_path, monkeypatch):
    folder, elsewhere, short = tmp_path / "run", tmp_path / "disk", dataclasses.replace(CONFIG, steps=4)
    run(folder, config=short)

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path / "step_00000004"))

    with monkeypatch.context() as patch:
        patch.setattr(run_folder.shutil, "rmtree", refuse)
        with pytest.raises(UserError, match=r"cannot delete .*step_00000004: Permission denied"):
            run(folder, start="overwrite", config=short)
    (folder / "checkpoints").rename(elsewhere)
    (folder / "checkpoints").symlink_to(elsewhere)
    with pytest.raises(UserError, match=r"checkpoints is a link, and what it points to is not deleted"):
        run(folder, start="overwrite", config=short)
    assert Checkpoints(elsewhere).steps() == [4]
    assert (folder / "config.json").exists()


def test_checkpoints_without_a_run_are_no_place_for_a_new_one(tmp_path):
    """Regression: those of the higher steps were kept, and the new run's were deleted."""
    folder = tmp_path / "run"
    run(folder)
    (folder / "config.json").unlink()
    with pytest.raises(UserError, match=r"holds checkpoints \(step_00000030\), but not the config.json"):
        run(folder, config=dataclasses.replace(CONFIG, steps=20))
    assert Checkpoints(folder / "checkpoints").steps()[-1] == 30
    run(folder, config=dataclasses.replace(CONFIG, steps=20), start="overwrite")
    assert Checkpoints(folder / "checkpoints").steps()[-1] == 20


@pytest.mark.parametrize("start", ["new", "resume"])
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("checkpoints", "file"),
        ("checkpoints", "link to itself"),
        ("tensorboard", "file"),
        ("pictures", "file"),
        ("evaluations", "file"),
        ("curves.png", "folder"),
        ("metrics.jsonl", "folder"),
        ("provenance.json", "folder"),
    ],
)
def test_an_entry_of_the_wrong_kind_is_named_before_any_work(tmp_path, name, kind, start):
    if start == "resume":
        (tmp_path / "config.json").touch()
    place = tmp_path / name
    {"file": place.touch, "folder": place.mkdir, "link to itself": lambda: place.symlink_to(place)}[kind]()
    what = "no file" if kind == "folder" else "no folder"
    with pytest.raises(UserError, match=rf"{name} is {what}, as a run has .*: restore it or move it away"):
        check_start(tmp_path, start)


def test_a_folder_named_as_the_configuration_is_no_run(tmp_path):
    (tmp_path / "config.json").mkdir()
    with pytest.raises(UserError, match=r"config\.json is no file, as a run has"):
        check_start(tmp_path, "new")
    run(tmp_path, start="overwrite", config=dataclasses.replace(CONFIG, steps=4))
    assert Checkpoints(tmp_path / "checkpoints").steps() == [4]

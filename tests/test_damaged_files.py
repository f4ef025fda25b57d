"""Damaged files of run folders and comparisons: one message that names the file, or the file is made anew."""

import errno
import json
import shutil
import struct
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from tests.training.stub import LineTask, line_arrays
from tflane_jax.ablations.declaration import Claim, Declaration, declare
from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.scores import _read
from tflane_jax.cli import main
from tflane_jax.config import RunConfig
from tflane_jax.config_io import to_json
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_json
from tflane_jax.runs import open_run, resumable_config
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training import array_files, checkpoint, provenance, run_folder
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.manifest import Manifest
from tflane_jax.training.records import RecordWriter, read_records
from tflane_jax.training.resumption import Latest, carried
from tflane_jax.training.schedule import OptimConfig, make_optimizer
from tflane_jax.training.state import init_states

PROGRESS = {"window": {"steps": 1, "sums": {"loss": [1.0]}}, "seconds": 1.0, "metrics": {}}
CONFIG = RunConfig()
MANIFEST = "checkpoints/step_00000002/manifest.json"
FILES = ("config.json", "metrics.jsonl", "provenance.json", MANIFEST)
# Whole contents of a file; None is a folder in its place, a function changes what was written.
CONTENTS = {
    "empty": b"",
    "binary": bytes(range(256)),
    "null": b"null",
    "number": b"3",
    "text": b'"text"',
    "list": b"[]",
    "nested list": b"[[1, 2], [3]]",
    "object": b"{}",
    "other object": b'{"class": ["RunConfig"], "step": {}}',
    "too deep": b"[" * 100_000,
    "objects too deep": b'{"config":' * 100_000,
    "huge number": b"1" * 5000,
    "cut short": lambda content: content[: len(content) // 2],
    "two values": lambda content: content + content,
    "a folder": None,
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run of two checkpoints, without training."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    example = jax.tree.map(lambda leaf: leaf[0], line_arrays())
    (state,) = init_states(LineTask(), make_optimizer(OptimConfig(warmup_steps=0), 9), (0,), example)
    checkpoints = Checkpoints(folder / "checkpoints")
    for step in (1, 2):
        manifest = Manifest(step=step, config=to_json(CONFIG), metrics={"all/DET_l": 0.5}, progress=PROGRESS)
        checkpoints.save(state.replace(step=jnp.int32(step)), manifest)
    write_json(folder / "config.json", to_json(CONFIG))
    provenance.add_provenance(folder)
    (folder / "metrics.jsonl").write_text('{"step": 1, "split": "train", "loss": 0.5}\n')
    return folder


@pytest.fixture
def run(whole, tmp_path) -> Path:
    """A copy of the run, without the arrays."""
    return Path(shutil.copytree(whole, tmp_path / "run", ignore=shutil.ignore_patterns("state")))


@pytest.fixture(autouse=True)
def no_git(monkeypatch):
    """Nothing here looks at the commit, and asking for it takes longer than the rest."""
    monkeypatch.setattr(provenance, "_git", lambda: None)


def damage(path: Path, content) -> None:
    """Replace a file by a content of `CONTENTS`."""
    written = path.read_bytes()
    path.unlink()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content(written) if callable(content) else content)


def messages_of(run: Path, file: str) -> list[str]:
    """Read a file in every way that a command does, and return the messages; nothing else may be raised."""
    job, found = Job(CONFIG, run, {}, {}, False, "run"), []
    readers = {
        "config.json": (lambda: resumable_config(run), job.difference, job.is_complete),
        "metrics.jsonl": (lambda: RecordWriter(run, 2).__exit__(None, None, None), job.step),
        "provenance.json": (lambda: provenance.add_provenance(run), job.difference),
        MANIFEST: (lambda: open_run(run), lambda: open_run(run, "last"), job.is_complete),
    }
    for reader in readers[file]:
        try:
            reader()
        except UserError as error:
            found.append(str(error))
    return found


def test_a_whole_run_is_read_without_a_message(whole, tmp_path):
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    assert [message for file in FILES for message in messages_of(run, file)] == []


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("file", FILES)
def test_damaged_files_of_a_run_are_named(run, file, content):
    damage(run / file, CONTENTS[content])
    messages = messages_of(run, file)
    name = str(run / file).removesuffix("/manifest.json")
    assert all(name in message for message in messages), messages
    if file in ("config.json", MANIFEST):
        assert messages


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("class"), "should be a RunConfig"),
        (lambda c: c["optim"].update(lr="fast"), "optim.lr cannot be 'fast'"),
        (lambda c: c["optim"].update(lr=-1.0), "optim.lr is -1.0: it must be"),
        (lambda c: c["optim"].update(lr=10**400), "optim.lr cannot be 1000"),
        (lambda c: c["task"].update({"class": ["LaneGraphTask"]}), "task cannot be {'class': ['LaneGraphTask']"),
        (lambda c: c["training"].update(seeds=[2**32]), "training.seeds is (4294967296,)"),
        (lambda c: c["optim"].update(lr=None), "optim.lr cannot be None"),
        (lambda c: c["optim"].update(restarts=[1]), "optim.restarts cannot be"),
        (lambda c: c["optim"].update(lrr=1.0), "optim.lrr is unknown"),
        (lambda c: c["optim"].update({"\x1b[2J\nall good": 1.0}), r"optim.\x1b[2J\nall good is unknown"),
        (lambda c: c["task"].update({"class": "\x1b[2JTask"}), r"class \x1b[2JTask (setting task) is not part"),
        (lambda c: c["training"].update(seeds=0), "training.seeds cannot be 0"),
        (lambda c: c["training"].update(seeds=[]), "training.seeds is ()"),
        (lambda c: c["training"].update(steps=0), "training.steps is 0"),
        (lambda c: c["task"].update(model=3), "task.model"),
        (lambda c: c["task"]["model"].update({"class": ["TopoNetConfig"]}), "task.model"),
        (lambda c: c["task"]["model"]["decoder"].update(heads=7), "task.model.decoder.heads is 7"),
        (lambda c: c["task"]["model"].update(priors="none"), "task.model.priors"),
        (lambda c: c.update(data={"class": "OpenLaneV2Data"}), "data.root is missing"),
        (lambda c: c.update(data=[]), "data cannot be"),
    ],
)
@pytest.mark.parametrize("file", ["config.json", MANIFEST])
def test_wrong_settings_of_a_run_are_named(run, file, change, words):
    content = json.loads((run / file).read_text())
    change(content if file == "config.json" else content["config"])
    (run / file).write_text(json.dumps(content))
    messages = messages_of(run, file)
    assert any(words in message for message in messages), messages


@pytest.mark.parametrize("entry", ["step", "config", "metrics", "progress", "files", "version"])
@pytest.mark.parametrize("value", [None, [], "text"])
def test_wrong_entries_of_a_manifest_are_named(run, entry, value):
    path = run / MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | {entry: value}))
    with pytest.raises(UserError, match=f"{path.parent} is damaged .*{entry}"):
        open_run(run)


def test_a_score_that_no_number_can_hold_is_named(run):
    path = run / MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | {"metrics": {"all/DET_l": 10**400}}))
    with pytest.raises(UserError, match="metrics is not what was written"):
        open_run(run)


@pytest.mark.parametrize(
    "change",
    [
        {"window": None},
        {"window": {"steps": 1}},
        {"seconds": "long"},
        {"seconds": 10**400},
        {"metrics": []},
        {"cycles": [{"x": 1}]},
    ],
)
def test_wrong_progress_names_the_checkpoint(change, tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert carried(checkpoints, Latest(step=3, progress=PROGRESS), []).times.seconds == 1.0
    with pytest.raises(UserError, match=r"step_00000003 is damaged .*progress is not what was written"):
        carried(checkpoints, Latest(step=3, progress=PROGRESS | change), [])


def test_a_damaged_run_ends_the_command_with_a_message(run, capsys):
    damage(run / MANIFEST, b"[]")
    assert main(["eval", str(run)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{run}/checkpoints/step_00000002 is damaged" in error
    assert "the run can go on from step 1" in error


@pytest.mark.parametrize(
    "line", ["", "x", "[]", "3", "{}", '{"step": "1", "split": "train"}', '{"step": 1, "split": "val", "loss": "low"}']
)
def test_only_a_last_line_may_be_no_record(run, line):
    path = run / "metrics.jsonl"
    path.write_text(f"{path.read_text()}{line}\n")
    assert [record["step"] for record in read_records(path)] == [1]
    content = path.read_text() + '{"step": 2, "split": "train", "loss": 1.0}\n'
    path.write_text(content)
    with pytest.raises(UserError, match=r"metrics\.jsonl, line 2 is no record: correct or delete"):
        RecordWriter(run, 2)
    assert path.read_text() == content


@pytest.mark.parametrize("file", ["_file", "_board"])
def test_a_record_that_cannot_be_written_says_how_to_go_on(run, file, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with RecordWriter(run, 2) as writer:
        wrapped = getattr(writer, file)
        broken = SimpleNamespace(write=full, flush=full, close=full)
        monkeypatch.setattr(writer, file, broken)
        with pytest.raises(UserError, match=rf"records in {run}: No space left on device; make room .* --resume"):
            writer.write({"step": 2, "split": "train", "loss": 1.0})
        wrapped.close()


def test_scalars_for_tensorboard_are_written_and_purged(run):
    from tensorboardX.proto.event_pb2 import Event

    with RecordWriter(run, 1) as writer:
        writer.write({"step": 2, "split": "val", "recall": [0.25, 0.5], "loss": 1.0})
    (path,) = (run / "tensorboard").glob("events.*")
    content, events = path.read_bytes(), []
    while content:  # length, checksum, event, checksum
        (size,) = struct.unpack("Q", content[:8])
        events.append(Event.FromString(content[12 : 12 + size]))
        content = content[16 + size :]
    assert [event.step for event in events] == [0, 2, 2, 2, 2, 2]
    values = {v.tag: v.simple_value for event in events for v in event.summary.value}
    assert values == {"val/recall/0": 0.25, "val/recall/1": 0.5, "val/loss": 1.0}


@pytest.mark.parametrize("place", ["tensorboard", "metrics.jsonl/x"])
def test_records_that_have_no_place_are_named(tmp_path, place):
    path = tmp_path / place
    path.parent.mkdir(exist_ok=True)
    path.touch()
    with pytest.raises(UserError, match=str(tmp_path)):
        RecordWriter(tmp_path, 0)


class TensorstoreError(Exception):
    """As those of tensorstore, not an OSError."""


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EROFS, "Read-only file system"),
        TensorstoreError("RESOURCE_EXHAUSTED: No space left on device\nmore"),
    ],
)
def test_a_checkpoint_that_cannot_be_written_leaves_the_earlier_ones(whole, tmp_path, error, monkeypatch):
    run = Path(shutil.copytree(whole, tmp_path / "run"))

    class Full:
        def __enter__(self):
            raise error

        def __exit__(self, *_):
            pass

    checkpoints, example = Checkpoints(run / "checkpoints"), jax.tree.map(lambda leaf: leaf[0], line_arrays())
    (state,) = init_states(LineTask(), make_optimizer(OptimConfig(warmup_steps=0), 9), (0,), example)
    restored = checkpoints.restore(2, state)
    with monkeypatch.context() as patch:
        patch.setattr(array_files, "_checkpointer", Full)
        with pytest.raises(UserError, match=r"step_00000003: .*(space left|Read-only).*--resume"):
            checkpoints.save(restored, Manifest(step=3, config={}))
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["step_00000001", "step_00000002"]
    assert len(checkpoints.arrays(2)) == len(checkpoints.arrays(1))
    checkpoints.save(restored, Manifest(step=3, config={}))  # after room was made
    assert checkpoints.steps() == [2, 3]


def test_files_are_flushed_before_they_get_their_name(tmp_path, monkeypatch):
    done = []
    fsync, replaced = checkpoint.os.fsync, checkpoint.os.replace
    monkeypatch.setattr("os.fsync", lambda handle: (done.append("flush"), fsync(handle)))
    monkeypatch.setattr("os.replace", lambda *paths: (done.append("rename"), replaced(*paths)))
    write_json(tmp_path / "a.json", {})
    assert done == ["flush", "rename", "flush"]


@pytest.mark.parametrize("content", CONTENTS)
def test_damaged_scores_are_measured_again(tmp_path, content):
    path = tmp_path / "scores.json"
    ways = {"": {"all/recall": 0.5}}
    entry = {"code": "", "step": 1, "protocol": "", "ways": ways, "ratios": {"": {"all/recall": [[1], [2]]}}}
    sampled, wrong = ({**entry, "samples": {"": {"all/DET_l": each}}} for each in ([[2], [0.5]], [0.5]))
    entries = {"earlier": entry, "mark": sampled}
    write_json(path, entries | {"wrong": wrong})
    assert dict(_read(path)) == entries
    damage(path, CONTENTS[content])
    assert dict(_read(path)) == {}


@pytest.mark.parametrize("content", CONTENTS)
def test_a_damaged_declaration_is_named(tmp_path, content):
    declaration = Declaration("all/recall", (Claim("a"),))
    declare(declaration, {"a": []}, {}, [0], tmp_path)
    assert declare(declaration, {"a": []}, {}, [0], tmp_path).seeds == (0,)
    damage(tmp_path / "declaration.json", CONTENTS[content])
    with pytest.raises(UserError, match=r"declaration\.json"):
        declare(declaration, {"a": []}, {}, [0], tmp_path)


def test_run_folders_that_cannot_be_used_are_told_before_any_work(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(LaneGraphTask, "load", None)
    for out in (tmp_path / "file", tmp_path / "file" / "run"):
        assert main(["train", "--config", "tf_lane/toponet", "--out", str(out)]) == 2
        assert f"{tmp_path / 'file'} is no folder" in capsys.readouterr().err
    with run_folder.claimed(tmp_path / "used", "new"):
        assert main(["train", "--config", "tf_lane/toponet", "--out", str(tmp_path / "used")]) == 2
    assert f"another process is training into {tmp_path / 'used'}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "wrong", "left"),
    [
        ("[{", "it is no JSON", 0),
        ("{}", "it holds no list of starts", 0),
        ('[3, {"git": null}]', "1 start of 2 cannot be read", 1),
    ],
)
def test_a_damaged_provenance_is_told_and_kept(run, content, wrong, left):
    (run / "provenance.json").write_text(content)
    (notice, *_) = provenance.add_provenance(run)
    assert notice.startswith(f"{run / 'provenance.json'} is damaged: {wrong}; it is kept as provenance.damaged.json")
    assert (run / "provenance.damaged.json").read_text() == content
    assert len(provenance.read_provenance(run)) == left + 1
    assert provenance.add_provenance(run) == []

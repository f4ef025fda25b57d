"""What a command writes replaces neither what it reads nor a part of a run."""

import json

import pytest

from tflane_jax.cli import main
from tflane_jax.commands.outputs import check_output, check_table
from tflane_jax.errors import UserError

OWN = ("config.json", "metrics.jsonl", "checkpoints/step_00000002/manifest.json")


@pytest.fixture
def run(tmp_path):
    """Return a folder with the files of a run, but nothing in them."""
    for name in (*OWN, "evaluations/street-test.json"):
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_text("kept")
    return tmp_path / "run"


@pytest.mark.parametrize("name", OWN)
def test_the_files_of_a_run_are_not_replaced(name, run, tmp_path):
    (tmp_path / "link").symlink_to(run)
    for path in (run / name, run / "checkpoints" / ".." / name, tmp_path / "link" / name):
        with pytest.raises(UserError, match="is a part of a run: choose another name"):
            check_output(path)


def test_tables_and_new_files_in_a_run_are_written(run):
    check_table(run / "evaluations" / "street-test")
    check_output(run / "model.stablehlo")
    check_output(run / "evaluations" / "street-test.json")


def test_commands_ask_before_they_begin(run, tmp_path, capsys):
    for command in (
        ["summary", "--out", str(run / "config")],
        ["eval", str(run), "--out", str(run / "config")],
        ["submit", str(run), "--out", str(run / "checkpoints" / "step_00000002" / "manifest.json")],
        ["export", str(run), "--out", str(run / "config.stablehlo")],  # whose table would be config.json
        ["data", "overlap", "a", "b", "--out", str(run / "config")],
        ["data", "show", "--out", str(run / "config.json")],
        ["markers", "store", "--log", "17", "--out", str(run / "config.json")],
        ["data", "maps", str(tmp_path), "--out", str(run / "config.json")],
    ):
        assert main(command) == 2
        assert "which is a part of a run: choose another name" in capsys.readouterr().err
    assert all((run / name).read_text() == "kept" for name in OWN)


def test_data_that_are_read_are_not_replaced(tmp_path, capsys):
    frame = tmp_path / "openlane" / "val" / "100.json"
    frame.parent.mkdir(parents=True)
    frame.write_text(json.dumps({}))
    (tmp_path / "submission.pkl").write_bytes(b"")
    for root in (tmp_path / "openlane", frame):
        command = ["score", "openlane-v2.1-centerline", str(tmp_path / "submission.pkl"), str(root)]
        assert main([*command, "--out", str(frame.with_suffix(""))]) == 2
        assert f"--out would write over {frame}, a file" in capsys.readouterr().err
    log = str(tmp_path / "openlane")
    for command in (["markers", "store", "--log", log], ["data", "maps", log], ["data", "overlap", log, log]):
        assert main([*command, "--out", str(frame)]) == 2
        assert f"--out would write over {frame}, a file of {log} that is read" in capsys.readouterr().err
    assert frame.read_text() == "{}"
    check_output(frame.with_name("new.json"), [tmp_path / "openlane"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["submit", "run", "--root", ""], "an empty word after --root"),
        (["submit", "run", "--root="], "--root has an empty value"),
        (["eval", ""], "an empty word after eval"),
        (["sweep", "=runs/a", "--setting", "data.test", "--values", "1"], "=runs/a: the name before = is empty"),
        (["compare", "=a.py"], "=a.py: the name before = is empty"),
        (["tables", "#", "lists", "them"], "this shell reads # as a word"),
        (
            ["compare", "a.py", "b.py", "--seeds", "3"],
            "--seeds 3 is seed 3 alone, with which nothing can be tested; for 3 seeds give --seeds 0 1 2",
        ),
        (["score", "tusimple", "a", "b", "--bootstrap", "1" + 23 * "0"], "give a number of draws up to 100,000"),
    ],
)
def test_empty_words_and_endless_work_are_refused(arguments, said, capsys):
    assert main(arguments) == 2
    assert said in capsys.readouterr().err

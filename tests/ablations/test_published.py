"""The page of results, made from the summaries of recorded tables."""

import json
import shutil
import sys

import pytest

from tests.shared import ROOT
from tflane_jax.ablations import published
from tflane_jax.ablations.published import page, record
from tflane_jax.cli import main
from tflane_jax.errors import UserError, install


def test_the_page_leaves_out_best_checkpoints_that_repeat_the_last(tmp_path):
    rows = [
        {"model": model, "checkpoint": which, "seeds": 1, "score": score}
        for which, scores in (("last", ("1.0", "2.0")), ("best", ("1.0", "2.5")))
        for model, score in zip("ab", scores, strict=True)
    ]
    rows[0]["score, geometric"] = "1.5"
    summary = dict.fromkeys(("table", "title", "protocol", "declared"), "x") | {
        "seeds": [0],
        "steps": [1],
        "rows": rows,
    }
    summary |= {"cores of a run": [1], "commits": [], "devices": [], "core minutes of a run": {"a": 1.0}}
    summary |= {"findings": [], "effects": [], "runs begun": 0, "quoted": {"rows": []}}
    (tmp_path / "x.json").write_text(json.dumps(summary))
    written = page(tmp_path)
    lines = [line.split() for line in written.splitlines() if line.startswith(("| a", "| b"))]
    assert [(line[1], line[3]) for line in lines] == [("a", "last"), ("b", "last"), ("b", "best")]
    assert "Best checkpoints that score as the last are left out.\n" in written
    assert "1 seed, 1 updates a run" in written
    assert "Interim" not in written  # of a table of another version, whose seeds are not known
    assert "\ntflane tables x --seeds 1 --jobs 2 --cores 1\n" in written
    (tmp_path / "x.json").write_text(json.dumps(summary | {"declared seeds": 9}))
    assert "**Interim**: 1 of 9 declared seeds." in page(tmp_path).replace("\n", " ")
    (tmp_path / "x.json").write_text(json.dumps(summary | {"seeds": [0, 2]}))
    written = page(tmp_path)
    assert "1 to 2 seeds (0, 2), 1 updates a run" in written
    assert "\ntflane tables x --seeds 0,2 --jobs 2 --cores 1\n" in written
    (tmp_path / "x.json").write_text(json.dumps(summary | {"seeds": [3]}))
    assert "\ntflane tables x --seeds 3-3 --jobs 2 --cores 1\n" in page(tmp_path)
    # Rows that other tables share may be there with more seeds than the others.
    (tmp_path / "x.json").write_text(json.dumps(summary | {"seeds": [0, 1], "declared seeds": 2}))
    assert "**Interim**: 1 to 2 of 2 declared seeds." in page(tmp_path).replace("\n", " ")
    two = {"table": "tf_lane.5", "cores of a run": [1, 2], "seeds": [0, 1]}
    (tmp_path / "tf_lane.5.json").write_text(json.dumps(summary | two))
    written = page(tmp_path)
    assert "**Interim**: 1 to 2 of 5 declared seeds." in written.replace("\n", " ")
    assert "\ntflane tables tf_lane.5 --seeds 2 --jobs 2\n" in written


def test_a_table_of_fewer_runs_is_told_from_the_recorded_one(tmp_path):
    """Regression: one with as many seeds, but fewer rows or fewer seeds of a row, took its place."""

    def summary(**seeds):
        rows = [{"model": name, "checkpoint": "last", "seeds": number} for name, number in seeds.items()]
        return {"table": "x", "seeds": [0, 1], "rows": rows, "models": ["a", "b"], "declared seeds": 2}

    whole = summary(a=2, b=2)
    assert published._lost(whole, whole, tmp_path) == published._lost(summary(a=2, b=1), whole, tmp_path) == ""
    assert published._lost(whole, summary(a=2, b=1), tmp_path) == published._lost(whole, summary(a=2), tmp_path)
    assert published._lost(whole, summary(a=2), tmp_path) == "more runs of b"
    assert published._lost(whole, summary(a=2, b=2) | {"seeds": [0]}, tmp_path) == "seeds 1"
    assert published._lost(summary(a=2, old=2), whole, tmp_path) == ""  # a row that the table no longer has
    assert (published._lacking(whole), published._lacking(summary(a=2))) == ("", "0 to 2 of 2")


def test_a_remark_on_several_tables_stands_on_the_page_once(tmp_path):
    summary = dict.fromkeys(("title", "protocol", "declared"), "x") | {"seeds": [0], "steps": [1], "rows": []}
    summary |= {"cores of a run": [1], "commits": [], "devices": [], "core minutes of a run": {"a": 1.0}}
    summary |= {"findings": [], "effects": [], "runs begun": 0, "quoted": {"rows": []}}
    notes = {"x1": "Of one core.", "x2": "Of one core.", "x3": "Of two.", "x4": None}
    for name, note in notes.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(summary | {"table": name, "note": note}))
    sections = page(tmp_path).split("\n## ")[1:]
    remarks = [[text for text in ("Of one", "on x1 holds here", "Of two") if text in section] for section in sections]
    assert remarks[:4] == [["Of one"], ["on x1 holds here"], ["Of two"], []]


def test_a_remark_on_runs_stays_as_long_as_one_of_them_is_recorded(tmp_path, monkeypatch):
    for name, replaced in (("read_archive", None), ("write_archive", None), ("merged", None), ("can_draw", False)):
        monkeypatch.setattr(published, name, lambda *_, replaced=replaced: replaced)
    summary = dict.fromkeys(("table", "title", "protocol", "declared"), "x") | {"seeds": [0], "steps": [1], "rows": []}
    summary |= {"cores of a run": [1], "devices": [], "core minutes of a run": {"a": 1.0}, "quick": False}
    summary |= {"findings": [], "effects": [], "runs begun": 0, "quoted": {"rows": []}}
    folder = tmp_path / "results"
    folder.mkdir()
    old = summary | {
        "commits": ["old", "older"],
        "remark on runs": {"remark": "trained with an error.", "commits": ["old", "older"]},
    }
    (folder / "x.json").write_text(json.dumps(old))
    for commits, told in ((["old", "older"], True), (["new", "older"], True), (["new"], False), (["new"], False)):
        (tmp_path / "summary.json").write_text(json.dumps(summary | {"commits": commits}))
        written = record([tmp_path / "summary.json"], folder).read_text()
        assert ("x: trained with an error." in written) == told


def test_the_page_names_tables_whose_claims_were_declared_late(tmp_path):
    summary = dict.fromkeys(("title", "protocol"), "x") | {"seeds": [0], "steps": [1], "rows": []}
    summary |= {"cores of a run": [1], "commits": [], "devices": [], "core minutes of a run": {"a": 1.0}}
    effect = dict.fromkeys(("claim", "low", "high")) | {"treatment": "a", "control": "b", "paper": [], "further": []}
    effect |= {"measure": "all/DET_l", "verdict": "shown", "difference": 0.01, "p": 0.01, "better": 3, "seeds": 3}
    summary |= {"findings": ["a is better"], "effects": [effect], "declared": "In any words.", "quoted": {"rows": []}}
    for name, begun in {"x0": None, "x1": 0, "x2": 1, "x3": 12}.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(summary | {"table": name, "runs begun": begun}))
    assert "when some of their runs had begun (how many): x2 (1), x3 (12);" in page(tmp_path).replace("\n", " ")
    for name in ("x2", "x3"):
        (tmp_path / f"{name}.json").unlink()
    assert "had begun" not in page(tmp_path)


def test_the_page_tells_which_rows_made_how_many_updates(tmp_path):
    """Regression: "2000, 4000 updates a run"."""
    summary = dict.fromkeys(("table", "title", "protocol", "declared"), "x") | {"seeds": [0], "rows": []}
    summary |= {"cores of a run": [1], "commits": [], "devices": [], "core minutes of a run": {"a": 1.0}}
    summary |= {"findings": [], "effects": [], "runs begun": 0, "quoted": {"rows": []}}
    hosts = {"a": 20, "A host": 40, "b": 20, "B host": 40, "c": 20, "long": 80}
    told = {
        "1 seed, 20 updates a run, each on 1 core": {"a": 20, "b": 20},
        "1 seed, 20 updates a run (40 of A host and B host; 80 of long), each on 1 core": hosts,
        "1 seed, 20 or 40 updates a run, each on 1 core": [20, 40],  # an earlier summary
    }
    for sentence, steps in told.items():
        (tmp_path / "x.json").write_text(json.dumps(summary | {"steps": steps}))
        assert sentence in page(tmp_path).replace("\n", " ")


def test_no_page_is_made_of_a_folder_without_results(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["tables", "--record", str(tmp_path / "empty")]) == 2
    assert "empty holds no results of tables" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


@pytest.mark.parametrize("content", ["[]", '{"meta": {}}', '{"table": "x", "rows": [], "quoted": {}}'])
def test_another_json_file_is_named_before_anything_is_trained(tmp_path, capsys, content):
    """Regression: a traceback, after the trainings."""
    (tmp_path / "sweep.json").write_text(content)
    for command in (["tables"], ["tables", "markers.3", "--out", str(tmp_path / "out")]):
        assert main([*command, "--record", str(tmp_path)]) == 2
        assert "sweep.json" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.json"]


def test_a_summary_of_an_earlier_version_is_named_before_anything_is_trained(tmp_path, capsys):
    """It has sentences alone, from which nothing is read."""
    summary = json.loads((ROOT / "docs" / "results" / "markers.3.json").read_text())
    del summary["effects"]
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "markers.3.json").write_text(json.dumps(summary))
    for command in (["tables"], ["tables", "markers.4", "--out", str(tmp_path / "out")]):
        assert main([*command, "--record", str(folder)]) == 2
        message = capsys.readouterr().err
        assert "markers.3.json is the summary of an earlier version" in message
        assert "(tflane tables markers.3 --finished --from FOLDER --record FOLDER)" in message
    assert [path.name for path in tmp_path.iterdir()] == ["results"]
    with pytest.raises(UserError, match="summary of an earlier version"):
        record([folder / "markers.3.json"], tmp_path / "others")
    assert not (tmp_path / "others").exists()


def test_the_remark_on_sentences_of_an_earlier_version_stands_below_them(tmp_path):
    content = json.loads((ROOT / "docs" / "results" / "small_host.1.json").read_text())
    for remark in ("No interval over scenes: decided by seeds alone.", ""):
        (tmp_path / "x.json").write_text(json.dumps(content | {"remark on findings": remark}))
        assert ("\n\nNo interval over scenes: decided by seeds alone.\n" in page(tmp_path)) == bool(remark)


def test_without_matplotlib_the_page_has_no_pictures_beside_it(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(ROOT / "docs" / "results" / "markers.3.json", folder)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        record([], folder)
    assert capsys.readouterr().err == f"no pictures, which need matplotlib: {install('plot')}\n"
    assert (tmp_path / "results.md").read_text() == page(folder)
    assert [path.name for path in folder.iterdir()] == ["markers.3.json"]
    record([], folder)
    assert sorted(path.name for path in folder.iterdir()) == ["markers.3.json", "markers.png"]


def test_claims_of_an_interim_table_are_marked():
    text = page(ROOT / "docs" / "results")
    summary = text[text.index("## All claims") : text.index("## tf_lane.1:")]
    for name, seeds in (("markers.5", "4 of 8"), ("gtn_lane.1", ""), ("markers.1", "")):
        marked = [line for line in summary.splitlines() if line.startswith(f"| [{name}](")]
        assert marked
        assert all((f", interim: {seeds} seeds |" in " ".join(line.split())) == bool(seeds) for line in marked)


def test_the_page_is_written_anew_without_a_table(tmp_path, capsys):
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(ROOT / "docs" / "results" / "markers.3.json", folder)
    assert main(["tables", "--record", str(folder)]) == 0
    assert (tmp_path / "results.md").read_text() == page(folder)
    assert f"written: {tmp_path / 'results.md'}" in capsys.readouterr().out


def test_the_page_of_results_is_what_its_summaries_give():
    assert (ROOT / "docs" / "results.md").read_text() == page(ROOT / "docs" / "results")

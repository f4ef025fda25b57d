"""`tflane score` refuses damaged files: one message that names file, place and cause, exit code 2, nothing written."""

import argparse
import json
import pickle
import re
from pathlib import Path

import pytest

from tests.scoring.damaged.binary_files import BINARY_CASES
from tests.scoring.damaged.text_files import TEXT_CASES
from tests.scoring.damaged.valid import FORMATS, KEYS, Case
from tflane_jax.cli import main
from tflane_jax.commands import score
from tflane_jax.errors import UserError

CASES = [*TEXT_CASES, *BINARY_CASES]


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged")


@pytest.fixture
def folder(shared):
    """Return an empty folder: one for all cases, which are too many for a folder each."""
    for path in shared.iterdir():
        path.unlink()
    return shared


def run(arguments, folder, **settings):
    """Run the command without the parser, which takes longer than all the rest."""
    protocol, predictions, truth = arguments
    options = {"by": None, "bootstrap": 0, "scenes": None, "out": folder / "out"} | settings
    return score.run(argparse.Namespace(protocol=protocol, predictions=Path(predictions), truth=Path(truth), **options))


def remarks(arguments, folder, capsys, **settings):
    assert run(arguments, folder, **settings) == 0
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("tflane:")]


@pytest.mark.parametrize("form", FORMATS)
def test_the_undamaged_files_are_scored_without_a_remark(form, folder, capsys):
    assert remarks(Case(form, "truth", "", "").write(folder), folder, capsys) == []
    assert (folder / "out.json").is_file()


def test_every_case_has_a_name_of_its_own():
    titles = [case.title for case in CASES]
    assert len(set(titles)) == len(titles)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.title)
def test_a_damaged_file_is_refused(case, folder):
    with pytest.raises(UserError) as error:
        run(case.write(folder), folder)
    said = str(error.value)
    assert case.file(case.side) in said
    assert re.search(case.message, said), said
    assert len(said) < 600
    assert {path.name for path in folder.iterdir()} == {case.file("predictions"), case.file("truth")}


def test_a_device_is_refused_before_it_is_read(folder, capsys):
    assert main(["score", "tusimple", "/dev/zero", str(folder / "truth.json"), "--out", str(folder / "out")]) == 2
    assert capsys.readouterr().err == "tflane: cannot read /dev/zero: it is a device, expected a file\n"


@pytest.mark.parametrize("case", [TEXT_CASES[0], BINARY_CASES[0]], ids=lambda case: case.title)
def test_the_command_line_shows_one_line_and_returns_2(case, folder, capsys):
    assert main(["score", *case.write(folder), "--out", str(folder / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("settings", "message", "most"),
    [({"bootstrap": 5}, "there is only one: leave --bootstrap out", 0), ({"by": "occlusion"}, "no visibility", 1)],
)
def test_what_cannot_be_reported_is_said_before_all_is_scored(folder, tmp_path, monkeypatch, settings, message, most):
    scenes, begun = tmp_path / "scenes.json", []
    scenes.write_text(json.dumps(dict.fromkeys(["s0", "s1", "s2"], "a")))
    counted = score.score
    monkeypatch.setattr(score, "score", lambda *arguments: begun.append(1) or counted(*arguments))
    with pytest.raises(UserError, match=message):
        run(valid(folder), folder, scenes=scenes, **settings)
    assert len(begun) == most


def valid(folder, form="maptr"):
    return Case(form, "truth", "", "").write(folder)


def test_outputs_that_cannot_be_written_are_named_before_anything_is_read(folder, tmp_path):
    protocol, predictions, truth = valid(tmp_path)
    (tmp_path / "taken.json").mkdir()
    for out, message in (
        (tmp_path / "predictions.json" / "score", "predictions.json is no folder"),
        (tmp_path / "taken", "taken.json: it is a folder"),
        (Path(""), "names no file"),
        (tmp_path / "predictions", "would write over .*predictions.json, a file that is read"),
        (tmp_path / "truth", "would write over .*truth.json, a file that is read"),
    ):
        with pytest.raises(UserError, match=message):
            run([protocol, predictions, truth], folder, out=out)
    with pytest.raises(UserError, match="is given as PREDICTIONS and as GROUND_TRUTH"):
        run([protocol, truth, truth], folder)
    assert {path.name for path in tmp_path.iterdir()} == {"predictions.json", "truth.json", "taken.json"}


def test_a_folder_with_a_frame_twice_or_of_the_other_task_is_named(tmp_path, folder):
    predictions = valid(folder, "centerline")[1]
    for copy in ("data", "backup/data"):
        info = tmp_path / copy / "val" / "10000" / "info"
        info.mkdir(parents=True)
        (info / "100-ls.json").write_text("{}")
        (info / "100.json").write_text(json.dumps({"annotation": {}}))
    with pytest.raises(UserError, match="lacks the entry 'lane_centerline'"):
        run(["openlane-v2.1-centerline", predictions, tmp_path / "data"], folder)
    empty = {"lane_centerline": [], "traffic_element": [], "topology_lclc": [], "topology_lcte": []}
    for file in tmp_path.glob("**/100.json"):
        file.write_text(json.dumps({"annotation": empty}))
    with pytest.raises(UserError, match=r"frame val/10000/100 is there twice: .*backup.* and .*data"):
        run(["openlane-v2.1-centerline", predictions, tmp_path], folder)
    for file in tmp_path.glob("**/100.json"):
        file.unlink()
    with pytest.raises(UserError, match=r"holds no annotations.*it has 2 files of the other task"):
        run(["openlane-v2.1-centerline", predictions, tmp_path], folder)


@pytest.mark.parametrize("form", FORMATS)
def test_scenes_of_a_file_are_drawn_by_the_bootstrap(form, folder, tmp_path, capsys):
    names = {"tusimple": "clips/0313/{}/20.jpg", "maptr": "s{}"}.get(form)
    frames = [names.format(i) for i in range(3)] if names else {"plain": PLAIN, "npz": PLAIN}.get(form, OPENLANE)
    scenes = tmp_path / "scenes.json"
    scenes.write_text(json.dumps(dict(zip(frames, ["a", "a", "b"], strict=True))))
    assert remarks(valid(folder, form), folder, capsys, by="scene", bootstrap=5, scenes=scenes) == []
    rows = json.loads((folder / "out.json").read_text())["rows"]
    assert [row["part"] for row in rows] == ["all", "low, 2.5 %", "high, 97.5 %", "a", "b"]
    assert [row["frames"] for row in rows[3:]] == [2, 1]


PLAIN = ["a at 1 ns", "a at 2 ns", "b at 1 ns"]
OPENLANE = ["/".join(key) for key in KEYS]


def test_nuscenes_samples_name_the_scenes_of_maptr(folder, tmp_path, capsys):
    table = [{"token": f"s{i}", "scene_token": "ab"[i // 2]} for i in range(3)]
    scenes = tmp_path / "sample.json"
    scenes.write_text(json.dumps(table))
    assert remarks(valid(folder), folder, capsys, by="scene", scenes=scenes) == []
    assert [row["part"] for row in json.loads((folder / "out.json").read_text())["rows"]] == ["all", "a", "b"]
    (said,) = remarks(valid(folder), folder, capsys, bootstrap=5)
    assert "the intervals are too narrow (name the drives by --scenes FILE)" in said
    for content, message in (
        (table[:2], "names no scene for s2"),
        ({"s0": 1}, "s0 has the scene 1, expected a text"),
        ({"s0": ""}, "s0 has the scene '', expected a text"),
        ({"s0": "\ud800"}, r"s0 has the scene '\\ud800', expected a text"),
        ([*table, {"token": "s0", "scene_token": "b"}], "row 3 has the scene 'b', another row 'a': name one"),
        ([{"token": "s0"}], "row 0 lacks the entry 'scene_token'"),
        ({"s1\n": 1}, r"'s1\\n' has the scene 1"),
        (7, "is of type int, expected a list"),
    ):
        scenes.write_text(json.dumps(content))
        with pytest.raises(UserError, match=message):
            run(valid(folder), folder, scenes=scenes)


def test_a_scene_with_codes_is_quoted_in_the_table(folder, tmp_path, capsys):
    scenes = tmp_path / "scenes.json"
    scenes.write_text(json.dumps({"s0": "a\x1b[2J", "s1": "b", "s2": "b"}))
    assert run(valid(folder), folder, by="scene", scenes=scenes) == 0
    assert "| 'a\\x1b[2J' |" in capsys.readouterr().out


@pytest.mark.parametrize("content", [{10**5000: "a"}, [{"token": 10**5000, "scene_token": "a"}]])
def test_scenes_of_a_pickle_with_a_huge_number_are_refused(folder, tmp_path, content):
    scenes = tmp_path / "scenes.pkl"
    scenes.write_bytes(pickle.dumps(content))
    with pytest.raises(UserError, match=r"scenes.pkl.*: the frame an integer of many digits is no name"):
        run(valid(folder), folder, scenes=scenes)


@pytest.mark.parametrize("protocol", ["maptr", "maptrv2", "maptr-iou", "maptrv2-iou"])
def test_map_lines_are_reported_by_distance_and_occlusion(protocol, folder):
    if protocol.endswith("iou"):
        pytest.importorskip("shapely")

    def seen(content):
        for sample in content["GTs"]:
            for i, vector in enumerate(sample["vectors"]):
                vector["visibility"] = float(i)

    _, *files = Case("maptr", "truth", "", "", seen).write(folder)
    for by, parts in (("distance", {"0 to 10 m": 6, "from 30 m": 0}), ("occlusion", {"occluded": 3, "clear": 3})):
        run([protocol, *files], folder, by=by)
        rows = {row["part"]: row for row in json.loads((folder / "out.json").read_text())["rows"]}
        assert {part: rows[part]["lines"] for part in parts} == parts
        assert (rows["all"]["AP_divider"], rows["all"]["recall"]) == (1.0, 1.0)
    assert rows["occluded"]["AP_divider"] == rows["occluded"]["mAP"] == 1.0
    assert "AP_divider" not in rows["clear"]  # no true one
    with pytest.raises(UserError, match=r"against .*frame s0: .*no visibility"):
        run([protocol, *valid(folder)[1:]], folder, by="occlusion")

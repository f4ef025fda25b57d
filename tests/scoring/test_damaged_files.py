"""`tflane score` refuses damaged files: one message that names file, place and cause, exit code 2, nothing written."""

import argparse
import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from tests.scoring.damaged.binary_files import BINARY_CASES
from tests.scoring.damaged.text_files import TEXT_CASES
from tests.scoring.damaged.valid import FORMATS, KEYS, Case, put
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


@pytest.mark.parametrize("case", [TEXT_CASES[0], BINARY_CASES[0]], ids=lambda case: case.title)
def test_the_command_line_shows_one_line_and_returns_2(case, folder, capsys):
    assert main(["score", *case.write(folder), "--out", str(folder / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def _resampled(points):
    """Return the change that gives all lanes of a submission another number of points."""

    def change(content):
        for frame in content["results"].values():
            for thing in frame["predictions"].get("lane_centerline", frame["predictions"].get("lane_segment")):
                for field in thing.keys() & {"points", "centerline", "left_laneline"}:
                    thing[field] = np.linspace(thing[field][0], thing[field][-1], points)

    return change


def _scaled(factor):
    def change(content):
        for sample in content["results"]:
            for vector in sample["vectors"]:
                vector["pts"] = (np.array(vector["pts"]) * factor).tolist()

    return change


def _boxed(side, change):
    """Return the change of the boxes of all traffic elements."""

    def changed(content):
        frames = content["results"] if side == "predictions" else content
        for frame in frames.values():
            for element in frame["predictions" if side == "predictions" else "annotation"]["traffic_element"]:
                element["points"] = change(element["points"])

    return changed


REMARKS = {
    "dense centerlines": (
        Case("centerline", "predictions", "", "", _resampled(201)),
        r"6 of 6 predicted centerlines have other than the official 11 points \(frame val/10000/100, number 0: 201,",
    ),
    "true centerlines of another density": (
        Case("centerline", "truth", "", "", put(KEYS[0], "annotation", "lane_centerline", 1, "points", np.eye(3))),
        r"1 of 6 true centerlines have other than .* 11 points \(frame val/10000/100, number 1: 3\)",
    ),
    "dense segments": (
        Case("segment", "predictions", "", "", _resampled(11)),
        r"6 of 6 left lines of predicted segments have other than the official 10 points",
    ),
    "normalised lines": (
        Case("maptr", "predictions", "", "", _scaled(1 / 60)),
        r"predicted lines reach 0.15 from the origin, true ones 9 .*: are the predictions normalised",
    ),
    **{
        f"boxes of {form} {side} that {fault}": (
            Case(form, side, "", "", _boxed(side, change)),
            f"all 3 boxes of {'predicted' if side == 'predictions' else 'true'} traffic elements {fault}: are",
        )
        for form in ("centerline", "segment")
        for side in ("predictions", "truth")
        for fault, change in (
            ("lie between 0 and 1, as if normalised", lambda box: box / 1550),
            ("have no area", lambda box: box[:1] + 0 * box),
            ("lie left of the image or above it", lambda box: box - 20),
        )
    },
    "rows of another camera": (
        Case("tusimple", "truth", "", "", put(0, "h_samples", [245, 255, 265, 275])),
        r"1 of 3 frames are labelled at other rows than TuSimple's.*\(clips/0313/0/20.jpg\)",
    ),
}


@pytest.mark.parametrize("name", REMARKS)
def test_what_is_unusual_is_said_beside_the_score(name, folder, capsys):
    case, message = REMARKS[name]
    said = remarks(case.write(folder), folder, capsys)
    assert re.search(message, "\n".join(said)), said
    written = json.loads((folder / "out.json").read_text())["meta"]["remarks"]
    assert [f"tflane: {remark}" for remark in written] == said


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
        (tmp_path / "predictions", "would write over .*predictions.json, which is read"),
        (tmp_path / "truth", "would write over .*truth.json, which is read"),
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

"""`tflane score` on OpenLane-V2's own files: official numbers, and errors for damaged files."""

import dataclasses
import json
import os
import re

import numpy as np
import pytest

from tests.metrics.cases import hand_frame
from tests.metrics.fixtures import expected_cases, load_frames
from tests.scoring.files import FRAMES, centerline_annotation, write_collection, write_submission
from tflane_jax.cli import main
from tflane_jax.errors import LeftOutWarning
from tflane_jax.scoring.openlane_v2 import read_truth

PROTOCOL = "openlane-v2.1-centerline"
DETECTIONS, TRUTH = hand_frame()


@pytest.fixture
def files(tmp_path):
    """Return a submission and annotations of three frames in two scenes, and where to write."""
    write_submission(tmp_path / "submission.pkl", dict.fromkeys(FRAMES, DETECTIONS))
    write_collection(tmp_path / "annotations.pkl", dict.fromkeys(FRAMES, TRUTH))
    return tmp_path


def run(folder, *more, protocol=PROTOCOL, truth="annotations.pkl"):
    code = main(
        ["score", protocol, str(folder / "submission.pkl"), str(folder / truth), "--out", str(folder / "out"), *more]
    )
    return code, json.loads((folder / "out.json").read_text()) if code == 0 else {}


@pytest.mark.golden
@pytest.mark.parametrize("protocol", ["v2.1", "v1.0"])
def test_files_give_the_official_numbers(tmp_path, protocol):
    cases = expected_cases()
    if not cases:
        pytest.skip("golden/metrics/openlanev2_centerline is absent")
    name = max(cases, key=lambda case: cases[case]["n_frames"])
    frames = {("val", f"1000{i % 3}", str(i)): frame for i, frame in enumerate(load_frames(name))}
    write_submission(tmp_path / "submission.pkl", {key: frame[0] for key, frame in frames.items()})
    write_collection(tmp_path / "annotations.pkl", {key: frame[1] for key, frame in frames.items()})
    code, written = run(tmp_path, protocol=f"openlane-{protocol}-centerline")
    assert code == 0
    official = cases[name][protocol.replace(".", "_")]
    for number in ("DET_l", "DET_t", "TOP_ll", "TOP_lt", "OLS"):
        assert written["rows"][0][number] == pytest.approx(official[number], abs=1e-6), number


def write_info(data, keys, annotated=True):
    for split, segment, timestamp in keys:
        info = data / split / segment / "info"
        info.mkdir(parents=True, exist_ok=True)
        annotation = {"annotation": centerline_annotation(TRUTH)} if annotated else {}
        (info / f"{timestamp}.json").write_text(json.dumps(annotation))


def test_a_folder_of_annotations_gives_the_same(files):
    write_info(files / "data", FRAMES)
    for file in (files / "data").rglob("info/*.json"):
        file.with_name(f"{file.stem}-ls.json").write_text("the other task's file")
    assert run(files)[1]["rows"] == run(files, truth="data")[1]["rows"]
    # A split's own folder will do.
    assert run(files)[1]["rows"] == run(files, truth="data/val")[1]["rows"]


def test_of_a_dataset_the_predicted_splits_alone_are_read(files, capsys):
    for split in ("train", "val", "test"):  # frames of the test have no annotation
        write_info(files / "data", [(split, *frame) for _, *frame in FRAMES], annotated=split != "test")
    assert run(files)[1]["rows"] == run(files, truth="data")[1]["rows"]
    assert run(files, truth="data/train")[0] == 2
    assert "data/train holds no annotations of split val" in capsys.readouterr().err


def data_dict(folder, subset, keys):
    segments = {}
    for _, segment, timestamp in keys:
        segments.setdefault(segment, []).append(f"{timestamp}.json")
    (folder / f"data_dict_subset_{subset}.json").write_text(json.dumps({"train": {}, "val": segments}))


def test_a_split_may_be_a_link_to_a_folder_of_another_name(files):
    """Regression: the link's target gave the split its name, and had no list of frames beside it."""
    other = [("val", "11000", "5")]
    write_info(files / "data", [*FRAMES, *other])
    data_dict(files / "data", "A", FRAMES)
    data_dict(files / "data", "B", other)
    (files / "data" / "val").rename(files / "disk")
    (files / "data" / "val").symlink_to(files / "disk", target_is_directory=True)
    for truth in ("data", "data/val"):
        assert run(files)[1]["rows"] == run(files, truth=truth)[1]["rows"]


def test_a_split_file_that_names_no_annotation_is_blamed(files, capsys):
    """Regression: the annotations counted as the other task's, and the split file was not named."""
    write_info(files / "data", FRAMES)
    data_dict(files / "data", "A", [(split, segment, f"{time}-ls") for split, segment, time in FRAMES])
    assert run(files, truth="data")[0] == 2
    told = capsys.readouterr().err
    assert (
        f"holds {len(FRAMES)} annotations of this task, and its split file (data_dict_subset_*.json) names none" in told
    )


def test_frames_of_the_subset_without_annotation_are_counted(files):
    """Regression: an incomplete copy of the data set was scored without a word."""
    write_info(files / "data", FRAMES)
    data_dict(files / "data", "A", [*FRAMES, ("val", FRAMES[0][1], "77")])
    told = f"1 of {len(FRAMES) + 1} frames that the split file names have no annotation in .*, such as val/.*/77: "
    with pytest.warns(LeftOutWarning, match=told):
        assert run(files, truth="data")[0] == 0


def test_of_a_dataset_the_predicted_subset_alone_is_read(files, capsys):
    """Both subsets may share the folder; a frame that the predictions lack is missed within their own."""
    other = [("val", "11000", "5"), ("val", "11000", "6")]
    write_info(files / "data", [*FRAMES, *other])
    data_dict(files / "data", "A", FRAMES)
    data_dict(files / "data", "B", other)
    for truth in ("data", "data/val"):
        assert run(files)[1]["rows"] == run(files, truth=truth)[1]["rows"]
    write_submission(files / "submission.pkl", dict.fromkeys(FRAMES[:2], DETECTIONS))
    assert run(files, truth="data")[0] == 2
    assert "1 of 3 frames are missing from the predictions" in capsys.readouterr().err
    write_submission(files / "submission.pkl", dict.fromkeys([*FRAMES, *other], DETECTIONS))
    code, written = run(files, "--by", "scene", truth="data")
    assert (code, len(written["rows"])) == (0, 1 + len({key[:2] for key in [*FRAMES, *other]}))


def test_dense_annotations_are_thinned(files):
    # A straight line of 201 points; every 20th is what the detections were measured against.
    dense = dataclasses.replace(TRUTH, points=[np.linspace(line[0], line[-1], 201) for line in TRUTH.points])
    before = run(files)[1]["rows"]
    write_collection(files / "annotations.pkl", dict.fromkeys(FRAMES, dense))
    assert run(files)[1]["rows"] == before
    (found, *_) = read_truth(files / "annotations.pkl", progress=False).values()
    np.testing.assert_allclose(found.points, [line[::20] for line in dense.points])


def test_the_table_names_protocol_and_scenes(files, capsys):
    code, written = run(files, "--by", "scene", "--bootstrap", "20")
    said = capsys.readouterr().out
    assert code == 0
    assert "OpenLane-V2 centerline v2.1" in said
    assert [row["part"] for row in written["rows"]] == ["all", "low, 2.5 %", "high, 97.5 %", "val/10000", "val/10001"]
    whole, low, high = written["rows"][:3]
    # Every frame is the same, and so is every draw.
    assert low["DET_l"] == pytest.approx(whole["DET_l"])
    assert high["DET_l"] == pytest.approx(whole["DET_l"])
    assert (files / "out.md").read_text() in said


def test_intervals_hold_what_varies_between_scenes(files):
    nothing = dataclasses.replace(DETECTIONS, points=[p + 30.0 for p in DETECTIONS.points])
    write_submission(files / "submission.pkl", dict.fromkeys(FRAMES[:2], DETECTIONS) | {FRAMES[2]: nothing})
    whole, low, high = run(files, "--bootstrap", "50")[1]["rows"]
    assert low["DET_l"] == 0.0 < whole["DET_l"] < high["DET_l"]


def first(results, field):
    return results[FRAMES[1]]["predictions"][field]


def drop(results):
    del results[FRAMES[1]]


def rename(results):
    results["val", "99", "7"] = results.pop(FRAMES[0])


def bad_key(results):
    results["100"] = results.pop(FRAMES[0])


DAMAGE = {
    "missing frame": (drop, r"1 of 3 frames are missing from the predictions: val/10000/150 \(predict every frame"),
    "extra frame": (rename, r"missing .*: val/10000/100 .*; 1 of 3 frames are predicted, but not .*: val/99/7"),
    "key": (bad_key, r"'100' is no frame, expected \(split, segment, timestamp\)"),
    "field": (lambda r: r[FRAMES[1]]["predictions"].pop("topology_lclc"), "frame val/10000/150 lacks .*topology_lclc"),
    "no list": (
        lambda r: r[FRAMES[1]]["predictions"].update(lane_centerline=3),
        "frame val/10000/150: lane_centerline is of type int, expected a list",
    ),
    "points": (
        lambda r: first(r, "lane_centerline")[2].update(points=np.zeros((11, 2))),
        r"frame val/10000/150: lane_centerline\[2\].points has shape \(11, 2\), expected \(any, 3\)",
    ),
    "empty line": (lambda r: first(r, "lane_centerline")[2].update(points=[]), r"lane_centerline\[2\].points is empty"),
    "NaN": (
        lambda r: first(r, "lane_centerline")[1]["points"].__setitem__((3, 0), np.nan),
        r"frame val/10000/150: lane_centerline\[1\].points holds nan at \[3, 0\]",
    ),
    "words": (
        lambda r: first(r, "lane_centerline")[1].update(points="a line"),
        r"frame val/10000/150: lane_centerline\[1\].points is of type str",
    ),
    "confidence": (
        lambda r: first(r, "lane_centerline")[3].update(confidence=1.5),
        r"frame val/10000/150: lane_centerline: confidence: number 3 is 1.5, expected 0 to 1",
    ),
    "topology": (
        lambda r: r[FRAMES[1]]["predictions"].update(topology_lclc=np.zeros((4, 3))),
        r"frame val/10000/150: topology_lclc has shape \(4, 3\), expected \(4, 4\)",
    ),
    "attribute": (
        lambda r: first(r, "traffic_element")[0].update(attribute=13),
        r"frame val/10000/150: traffic_element\[0\].attribute is 13, expected .* from 0 to 12",
    ),
    "box": (
        lambda r: first(r, "traffic_element")[0].update(points=np.zeros(4)),
        r"traffic_element\[0\].points has shape \(4,\), expected \(2, 2\)",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_submission_is_named_to_the_frame(files, capsys, damage):
    change, message = DAMAGE[damage]
    write_submission(files / "submission.pkl", dict.fromkeys(FRAMES, DETECTIONS), change)
    code, _ = run(files)
    said = capsys.readouterr()
    assert code == 2
    assert re.search(message, said.err), said.err
    assert not (files / "out.json").exists()


def test_a_pickle_that_runs_code_is_refused(files, capsys):
    class Evil:
        def __reduce__(self):
            return os.system, ("true",)

    write_submission(files / "submission.pkl", {}, lambda results: results.update(bad=Evil()))
    assert run(files)[0] == 2
    assert "is refused" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["openlane-v3", "a.pkl", "b.pkl"], "no protocol 'openlane-v3', only openlane-v2.1-centerline"),
        ([PROTOCOL, "nowhere.pkl", "b.pkl"], "cannot read nowhere.pkl: No such file"),
        ([PROTOCOL, "a.pkl", "nowhere"], "cannot read nowhere: No such file or directory"),
        ([PROTOCOL, "a.pkl", "b.pkl", "--scenes", "nowhere"], "cannot read nowhere: No such file or directory"),
        ([PROTOCOL, "a.txt", "b.pkl"], "a.txt: expected a .pkl, .json or .npz file"),
        ([PROTOCOL, "a.npy", "b.pkl"], "a.npy: expected a .pkl, .json or .npz file; docs/scoring.md says"),
        (["lanesegnet", "a.txt", "b.pkl"], "a.txt: expected a .json or .pkl file"),
        ([PROTOCOL, "a.pkl", "b.pkl", "--bootstrap", "-1"], "--bootstrap -1"),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("a.pkl", "a.txt", "a.npy", "b.pkl"):
        (tmp_path / name).touch()
    assert main(["score", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_one_scene_has_no_interval(files, capsys):
    write_submission(files / "submission.pkl", {FRAMES[0]: DETECTIONS})
    write_collection(files / "annotations.pkl", {FRAMES[0]: TRUTH})
    assert run(files, "--bootstrap", "5")[0] == 2
    assert "there is only one" in capsys.readouterr().err


def test_no_frames_is_an_error(files, capsys):
    write_submission(files / "submission.pkl", {})
    write_collection(files / "annotations.pkl", {})
    assert run(files)[0] == 2
    assert "no frames" in capsys.readouterr().err


def test_an_empty_folder_is_named(files, capsys):
    (files / "empty").mkdir()
    assert run(files, truth="empty")[0] == 2
    assert "holds no annotations" in capsys.readouterr().err

"""`tflane score maptr` on MapTR's own files: official numbers, and errors for damaged files."""

import json
import pickle
import re

import numpy as np
import pytest

from tests.metrics.fixtures import expected_cases, load_maps
from tflane_jax.cli import main
from tflane_jax.errors import UserError
from tflane_jax.metrics import MapDetections, MapTruth
from tflane_jax.metrics.map_matching import CLASSES, LINE_CLASSES
from tflane_jax.scoring.maptr import read_predictions, read_truth, write_predictions

FILES = ("nuscmap_results.json", "anns.json")


def vectors(lines, scores=None):
    return [
        {"pts": np.asarray(points).tolist(), "pts_num": len(points), "cls_name": LINE_CLASSES[c], "type": int(c)}
        | ({} if scores is None else {"confidence_level": float(scores[i])})
        for i, (points, c) in enumerate(zip(lines.points, lines.classes, strict=True))
    ]


def write(folder, samples, change=lambda results: None):
    """Write both files; samples holds (detections, truth)."""
    results = [{"sample_token": f"s{i}", "vectors": vectors(d, d.scores)} for i, (d, _) in enumerate(samples)]
    truth = [{"sample_token": f"s{i}", "vectors": vectors(t)} for i, (_, t) in enumerate(samples)]
    change(results)
    (folder / "nuscmap_results.json").write_text(json.dumps({"meta": {}, "results": results}))
    (folder / "anns.json").write_text(json.dumps({"GTs": truth}))


def run(folder, protocol="maptr", *more):
    """Return the exit code and the first row."""
    code = main(["score", protocol, *(str(folder / n) for n in FILES), "--out", str(folder / "out"), *more])
    return code, json.loads((folder / "out.json").read_text())["rows"][0] if code == 0 else {}


@pytest.fixture
def samples():
    if not expected_cases("maptr"):
        pytest.skip("golden/metrics/maptr is absent")
    return [frame[:2] for frame in load_maps("rand_mid")]


@pytest.mark.golden
def test_files_give_the_official_numbers(tmp_path, samples):
    write(tmp_path, samples)
    official = expected_cases("maptr")["rand_mid"]["chamfer"]
    code, row = run(tmp_path)
    assert code == 0
    assert row["mAP"] == pytest.approx(official["mAP"], abs=1e-6)
    assert [row[f"AP_{name}"] for name in CLASSES] == pytest.approx(official["AP_per_class"], abs=1e-6)


@pytest.mark.golden
def test_overlap_gives_the_official_numbers(tmp_path, samples):
    write(tmp_path, samples)
    official = expected_cases("maptr")["rand_mid"]["iou"]
    code, row = run(tmp_path, "maptr-iou")
    assert code == 0
    assert [row[f"AP_{name}"] for name in CLASSES] == pytest.approx(official["AP_per_class"], abs=1e-6)


def test_centerlines_are_a_fourth_class(tmp_path):
    line = np.array([[0.0, 0.0], [0.0, 9.0]])
    truth = MapTruth([line, line], np.array([0, 3]))
    found = MapDetections([line, line + 0.7], np.array([0, 3]), np.array([0.9, 0.8]))
    write(tmp_path, [(found, truth)])
    code, row = run(tmp_path)
    assert code == 0
    assert (row["AP_divider"], row["AP_centerline"]) == (1.0, pytest.approx(2 / 3))
    assert row["mAP"] == pytest.approx((1 + 2 / 3) / 4)


@pytest.mark.parametrize("protocol", ["maptr", "maptrv2-iou"])
@pytest.mark.parametrize("by", ["occlusion", "distance", "scene"])
def test_parts_of_identical_lines_have_the_full_score(tmp_path, capsys, by, protocol):
    """Each part has one class: a class without true lines counts 0 in the whole alone."""
    if protocol.endswith("iou"):
        pytest.importorskip("shapely")
    parts = {"occlusion": ("occluded", "clear"), "distance": ("0 to 10 m", "20 to 30 m"), "scene": ("s0", "s1")}[by]
    samples = []
    for x, c in ((5.0, 0), (25.0, 2)):
        lines, classes = [np.array([[x, 0.0], [x, 9.0]])], np.array([c])
        samples.append((MapDetections(lines, classes, np.array([0.9])), MapTruth(lines, classes)))
    write(tmp_path, samples)
    truth = json.loads((tmp_path / "anns.json").read_text())
    for sample, visibility in zip(truth["GTs"], (0.1, 0.9), strict=True):
        sample["vectors"][0]["visibility"] = visibility
    (tmp_path / "anns.json").write_text(json.dumps(truth))
    code, whole = run(tmp_path, protocol, "--by", by)
    assert code == 0
    assert (whole["mAP"], whole["AP_ped_crossing"]) == (pytest.approx(2 / 3), 0.0)
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    names = next(cells for cells in table if "mAP" in cells)
    printed = {cells[0]: dict(zip(names, cells, strict=True)) for cells in table if len(cells) == len(names)}
    for part, present in zip(parts, ("AP_divider", "AP_boundary"), strict=True):
        aps = {name: value for name, value in printed[part].items() if name.startswith("AP_")}
        assert printed[part]["mAP"] == aps.pop(present) == "1.0000"
        assert set(aps.values()) == {"-"}
    if by == "distance":
        assert (printed["10 to 20 m"]["mAP"], printed["10 to 20 m"]["lines"]) == ("-", "0")


def test_a_count_of_points_that_is_an_array_is_named(tmp_path):
    vector = {"pts": np.zeros((2, 2)), "cls_name": "divider"}
    for count in (2, np.int64(2), np.array([2, 2])):
        content = {"GTs": [{"sample_token": "s0", "vectors": [vector | {"pts_num": count}]}]}
        (tmp_path / "anns.pkl").write_bytes(pickle.dumps(content))
        if np.ndim(count) == 0:
            assert len(read_truth(tmp_path / "anns.pkl")["s0"].points) == 1
    with pytest.raises(UserError, match=r"vectors\[0\].pts_num is array\(\[2, 2\]\), but pts has 2 points"):
        read_truth(tmp_path / "anns.pkl")


def test_lines_may_be_predicted_twice_and_centerlines_share_a_part(tmp_path):
    line = np.array([[0.0, 0.0], [0.0, 9.0]])
    truth = MapTruth([line, line, line], np.array([0, 3, 3]))
    found = MapDetections([line] * 4, np.array([0, 0, 3, 3]), np.array([0.9, 0.8, 0.7, 0.6]))
    write(tmp_path, [(found, truth)])
    code, row = run(tmp_path)
    assert (code, row["AP_divider"]) == (0, 1.0)


def test_the_title_names_centerlines_that_the_first_sample_lacks(tmp_path, capsys):
    line = [np.array([[0.0, 0.0], [0.0, 9.0]])]
    samples = [(MapDetections(line, np.array([c]), np.array([0.9])), MapTruth(line, np.array([c]))) for c in (0, 3)]
    write(tmp_path, samples)
    code, row = run(tmp_path)
    assert (code, row["AP_divider"], row["AP_centerline"]) == (0, 1.0, 1.0)
    assert "MapTR Chamfer AP v1, with centerlines" in capsys.readouterr().out


def test_heights_count_in_the_protocol_of_argoverse_2(tmp_path, capsys):
    """A line 0.7 m above the true one, at thresholds of 0.5, 1 and 1.5 m."""
    line = np.array([[0.0, 0.0, 0.0], [0.0, 9.0, 0.0]])
    truth = MapTruth([line], np.array([0]))
    found = MapDetections([line + np.array([0.0, 0.0, 0.7])], np.array([0]), np.array([0.9]))
    write(tmp_path, [(found, truth)])
    assert run(tmp_path, "maptrv2-3d")[1]["AP_divider"] == pytest.approx(2 / 3)
    assert run(tmp_path, "maptrv2")[0] == 2
    assert "pts has shape (2, 3), expected (n, 2): such files are scored by maptrv2-3d" in capsys.readouterr().err
    write(tmp_path, [(MapDetections([line[:, :2]], np.array([0]), np.array([0.9])), truth)])
    assert run(tmp_path, "maptrv2-3d")[0] == 2
    assert "pts has shape (2, 2), expected (n, 3): such files are scored by maptr or maptrv2" in capsys.readouterr().err


DAMAGE = {
    "missing": (lambda r: r.pop(1), "frames are missing from the predictions: s1"),
    "twice": (lambda r: r.append(r[0]), "sample s0 is there twice"),
    "class": (lambda r: r[1]["vectors"][0].update(cls_name="kerb"), r"sample s1: vectors\[0\].cls_name is 'kerb'"),
    "NaN": (
        lambda r: r[1]["vectors"][0]["pts"].__setitem__(1, [0.0, float("nan")]),
        r"sample s1: vectors\[0\].pts holds nan at \[1, 1\]",
    ),
    "flat": (lambda r: r[1]["vectors"][0].update(pts=[1, 2, 3]), r"vectors\[0\].pts has shape \(3,\)"),
    "no score": (lambda r: r[1]["vectors"][0].pop("confidence_level"), "lacks the entry 'confidence_level'"),
    "score": (
        lambda r: r[1]["vectors"][2].update(confidence_level=1.2),
        r"sample s1: confidence_level: number 2 is 1.2, expected 0 to 1",
    ),
    "no token": (lambda r: r[1].pop("sample_token"), r"results\[1\] lacks the entry 'sample_token'"),
}


@pytest.mark.golden
@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_results_are_named_to_the_sample(tmp_path, samples, capsys, damage):
    change, message = DAMAGE[damage]
    write(tmp_path, samples, change)
    assert run(tmp_path)[0] == 2
    said = capsys.readouterr().err
    assert re.search(message, said), said


def test_written_predictions_are_read_back(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "nuscmap_results.json"
    frames = {
        f"token-{n}": MapDetections(rng.normal(size=(n, 20, 2)) * 20, rng.integers(0, 4, n), rng.uniform(size=n))
        for n in (0, 1, 5)
    }
    write_predictions(path, frames.items())
    found = read_predictions(path)
    assert list(found) == list(frames)
    for token, wanted in frames.items():
        np.testing.assert_array_equal(np.reshape(found[token].points, wanted.points.shape), wanted.points)
        np.testing.assert_array_equal(found[token].classes, wanted.classes)
        np.testing.assert_array_equal(found[token].scores, wanted.scores)


def test_predictions_that_end_early_leave_no_file(tmp_path):
    def frames():
        yield "token", MapDetections([], np.zeros(0, int), np.zeros(0))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_predictions(tmp_path / "nuscmap_results.json", frames())
    assert not list(tmp_path.iterdir())

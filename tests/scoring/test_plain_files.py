"""`tflane score` on this project's own files, and lanes grouped by distance and occlusion."""

import json
import os
import pickle
import re
import threading

import numpy as np
import pytest

from tests.metrics.cases import hand_frame, random_frame
from tflane_jax.cli import main
from tflane_jax.errors import UserError
from tflane_jax.metrics import CenterlineMetrics, GroupedMetrics
from tflane_jax.metrics.partitions import ByDistance
from tflane_jax.scoring.plain import _time, read_predictions

PROTOCOL = "openlane-v2.1-centerline"
SCENES = [("a", 1), ("a", 2), ("b", 1)]


def json_frames():
    """Return both sides of three random frames as plain records, and the numbers that they must give."""
    predictions, truths, metrics = [], [], CenterlineMetrics()
    for seed, (scene, time) in enumerate(SCENES):
        detections, truth = random_frame(seed)
        metrics.update(detections, truth)
        name = {"scene": scene, "timestamp_ns": time}
        predictions.append(
            name
            | {
                "points": [p.tolist() for p in detections.points],
                "scores": detections.scores.tolist(),
                "successor": detections.successor.tolist(),
            }
        )
        truths.append(
            name
            | {
                "points": [p.tolist() for p in truth.points],
                "visibility": truth.visibility.tolist(),
                "successor": truth.successor.astype(int).tolist(),
            }
        )
    return predictions, truths, metrics.compute()


def write_json(folder, predictions, truths):
    (folder / "p.json").write_text(json.dumps({"frames": predictions}))
    (folder / "t.json").write_text(json.dumps({"frames": truths}))


def write_npz(folder, **changes):
    """Write the hand-made frame three times; the truth has one empty slot that holds NaN."""
    detections, truth = hand_frame()
    name = {"scene": np.array([s for s, _ in SCENES]), "timestamp_ns": np.array([t for _, t in SCENES])}
    three = lambda array: np.stack([np.asarray(array)] * 3)  # noqa: E731
    predictions = name | {
        "points": three(detections.points),
        "scores": three(detections.scores),
        "successor": three(detections.successor),
    }

    def slot(array, axes):
        return np.pad(
            three(array).astype(float),
            [
                (0, 0),
                *[(0, 1)] * axes,
                *[(0, 0)] * (np.ndim(array) - axes),
            ],
            constant_values=np.nan,
        )

    valid = three([True] * len(truth.points) + [False])
    truths = name | {
        "points": slot(truth.points, 1),
        "successor": slot(truth.successor, 2),
        "valid": valid,
        "visibility": slot(truth.visibility, 1),
    }
    np.savez(folder / "p.npz", **(predictions | changes))
    np.savez(folder / "t.npz", **truths)


def run(folder, kind, *more):
    out = folder / "out"
    files = [str(folder / f"p.{kind}"), str(folder / f"t.{kind}")]
    code = main(["score", PROTOCOL, *files, "--out", str(out), *more])
    return code, json.loads(out.with_suffix(".json").read_text())["rows"] if code == 0 else []


def test_json_gives_what_the_metric_gives(tmp_path):
    predictions, truths, expected = json_frames()
    write_json(tmp_path, predictions, truths)
    code, rows = run(tmp_path, "json", "--by", "scene")
    assert code == 0
    assert {name: rows[0][name] for name in expected} == pytest.approx(expected)
    assert [row["part"] for row in rows] == ["all", "a", "b"]


def test_arrays_with_empty_slots_give_the_hand_made_numbers(tmp_path):
    write_npz(tmp_path)
    code, rows = run(tmp_path, "npz", "--by", "occlusion")
    assert code == 0
    assert [row["part"] for row in rows] == ["all", "occluded", "clear"]
    # One frame's numbers by hand: tests/metrics/test_openlane_v2.py.
    single = CenterlineMetrics()
    single.update(*hand_frame())
    assert rows[0]["TOP_ll"] == pytest.approx(single.compute()["TOP_ll"])
    assert [row["lanes"] for row in rows] == [9, 6, 3]


def test_json_leaves_out_what_arrays_leave_out(tmp_path):
    """Regression: `valid` and `category` had no effect there."""
    predictions, truths, expected = json_frames()
    for record in (*predictions, *truths):
        count = len(record["points"])
        record["points"] = [[[90.0, 40.0, 0.0], [95.0, 40.0, 0.0]], *record["points"]]
        record["successor"] = np.pad(record["successor"], ((1, 0), (1, 0)), constant_values=1).tolist()
        for name in record.keys() & {"scores", "visibility"}:
            record[name] = [1.0, *record[name]]
        record |= {"valid": [False] + [True] * count} if "scores" in record else {"category": [1] + [0] * count}
    write_json(tmp_path, predictions, truths)
    code, (row,) = run(tmp_path, "json")
    assert code == 0
    assert {name: row[name] for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(("column", "values"), [("scores", [0.5]), ("scores", [0.5] * 40), ("visibility", [0.5])])
def test_columns_of_another_length_are_named_beside_valid(tmp_path, capsys, column, values):
    """Regression: a traceback, or numbers that were left out without a word."""
    predictions, truths, _ = json_frames()
    for record in predictions if column == "scores" else truths:
        record |= {column: values, "valid": [True] * len(record["points"])}
    write_json(tmp_path, predictions, truths)
    assert run(tmp_path, "json")[0] == 2
    assert f"{column} has {len(values)} numbers for" in capsys.readouterr().err


def test_sums_of_two_confidences_are_edges_as_in_official_files(tmp_path, capsys):
    predictions, truths, expected = json_frames()
    for record in predictions:
        record["successor"] = (2.0 * np.array(record["successor"])).tolist()
    write_json(tmp_path, predictions, truths)
    code, (row,) = run(tmp_path, "json")
    assert (code, row["DET_l"]) == (0, pytest.approx(expected["DET_l"]))
    assert "predicted topology exceeds 1 in 3 of 3 frames" in capsys.readouterr().err


def test_the_plain_form_does_not_pair_with_official_files(tmp_path, capsys):
    predictions, _, _ = json_frames()
    write_json(tmp_path, predictions, [])
    record = {"lane_centerline": [], "traffic_element": [], "topology_lclc": [], "topology_lcte": []}
    (tmp_path / "t.pkl").write_bytes(pickle.dumps({("val", "a", "1"): {"annotation": record}}))
    assert main(["score", PROTOCOL, str(tmp_path / "p.json"), str(tmp_path / "t.pkl")]) == 2
    assert "name their frames in different forms: give both" in capsys.readouterr().err


def test_crossings_among_segments_are_no_lanes(tmp_path):
    write_npz(tmp_path)
    detections, _ = hand_frame()
    every = read_predictions(tmp_path / "p.npz")
    crossing = np.arange(len(detections.scores)) == 1
    write_npz(tmp_path, category=np.stack([crossing.astype(int)] * 3))
    found = read_predictions(tmp_path / "p.npz")
    for name, lanes in found.items():
        np.testing.assert_array_equal(lanes.points, np.asarray(every[name].points)[~crossing])
        np.testing.assert_array_equal(lanes.scores, every[name].scores[~crossing])
        np.testing.assert_array_equal(lanes.successor, every[name].successor[np.ix_(~crossing, ~crossing)])
    write_npz(tmp_path, category=np.full((3, len(crossing)), 2))
    with pytest.raises(UserError, match="category holds 2"):
        read_predictions(tmp_path / "p.npz")


@pytest.mark.parametrize(
    ("points", "remarked"),
    [
        (np.stack([np.linspace(0.0, 30.0, 11), np.full(11, 2.0), np.zeros(11)], -1), False),
        (np.stack([np.full(11, 2.0), np.linspace(0.0, 30.0, 11), np.zeros(11)], -1), True),  # swapped axes
        (np.zeros((0, 3)), False),  # nothing predicted is no question of axes
    ],
)
def test_a_file_of_which_no_line_matches_is_remarked(tmp_path, capsys, points, remarked):
    lines = [points.tolist()] if len(points) else []
    name, successor = {"scene": "a", "timestamp_ns": 1}, [[0] * len(lines)] * len(lines)
    line = np.stack([np.linspace(0.0, 30.0, 11), np.full(11, 2.0), np.zeros(11)], -1).tolist()
    write_json(
        tmp_path,
        [name | {"points": lines, "scores": [0.1] * len(lines), "successor": successor}],
        [name | {"points": [line], "successor": [[0]]}],
    )
    assert run(tmp_path, "json")[0] == 0
    assert ("no predicted line is near a true one" in capsys.readouterr().err) == remarked


def test_every_lane_is_in_one_distance_group(tmp_path, capsys):
    write_npz(tmp_path)
    rows = run(tmp_path, "npz", "--by", "distance")[1]
    table = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    printed = {cells[0].strip(): dict(zip((cell.strip() for cell in table[0]), cells, strict=True)) for cells in table}
    # A part without lanes has no score: by the official convention, DET_l would be 1.
    assert (printed["20 to 30 m"]["DET_l"].strip(), int(printed["20 to 30 m"]["lanes"])) == ("-", 0)
    # A touches the ego, B begins 10 m ahead, C is 4 m aside.
    lanes = {row["part"]: row["lanes"] for row in rows}
    assert lanes == {"all": 9, "0 to 10 m": 6, "10 to 20 m": 3, "20 to 30 m": 0, "from 30 m": 0}


def test_distance_groups_are_a_partition_and_merge():
    frames = [random_frame(seed) for seed in range(4)]
    whole, first, second = (GroupedMetrics(CenterlineMetrics, partition=ByDistance((5.0, 15.0))) for _ in range(3))
    for i, frame in enumerate(frames):
        whole.update(*frame)
        (first if i < 2 else second).update(*frame)
    total = whole.compute()
    assert total["all"]["lanes"] == sum(values["lanes"] for group, values in total.items() if group != "all")
    official = CenterlineMetrics()
    for frame in frames:
        official.update(*frame)
    assert total["all"] == official.compute()
    merged = first.merge(second).compute()
    assert {group: values["DET_l"] for group, values in merged.items()} == pytest.approx(
        {group: values["DET_l"] for group, values in total.items()}
    )


def test_no_visibility_is_named(tmp_path, capsys):
    predictions, truths, _ = json_frames()
    write_json(tmp_path, predictions, [{k: v for k, v in t.items() if k != "visibility"} for t in truths])
    assert run(tmp_path, "json", "--by", "occlusion")[0] == 2
    assert "no visibility" in capsys.readouterr().err


def test_unsupported_groupings_are_named(tmp_path, capsys):
    assert main(["score", "tusimple", "a", "b", "--by", "distance"]) == 2
    assert "tusimple cannot be reported by distance" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scores": np.ones((3, 5))}, r"scores has shape \(3, 5\), expected \(3, 4\)"),
        ({"points": np.ones((3, 4, 11))}, r"points has shape \(3, 4, 11\), expected \(frames"),
        ({"scores": np.full((3, 4), 2.0)}, r"frame a at 1 ns: scores: number 0 is 2"),
        ({"timestamp_ns": np.array([1.0, 2.0, 1.0])}, r"timestamp_ns is 1\.0, expected whole nanoseconds"),
        ({"timestamp_ns": np.array([1, 1, 1])}, r"frame a at 1 ns is there twice"),
        ({"scene": np.array(["a", "a", "c"])}, r"missing from the predictions: b at 1 ns"),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path, capsys, changes, message):
    write_npz(tmp_path, **changes)
    assert run(tmp_path, "npz")[0] == 2
    said = capsys.readouterr().err
    assert re.search(message, said), said


def test_damaged_files_are_named(tmp_path, capsys):
    write_npz(tmp_path)
    whole = (tmp_path / "p.npz").read_bytes()
    for damaged in (b"", b"no archive", whole[:200], whole[: len(whole) // 2]):
        (tmp_path / "p.npz").write_bytes(damaged)
        assert run(tmp_path, "npz")[0] == 2
        assert "p.npz" in capsys.readouterr().err
    np.savez(tmp_path / "p.npz", points=np.array([{"a": 1}], dtype=object))
    assert run(tmp_path, "npz")[0] == 2
    assert "no .npz file of plain arrays" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_damaged_pipe_is_named_and_not_read_again(tmp_path, capsys):
    """Regression: looking at what it might hold waited forever for another writer."""
    pipe, truth = tmp_path / "pipe.json", tmp_path / "truth.json"
    os.mkfifo(pipe)
    truth.write_text("{}")
    writer = threading.Thread(target=pipe.write_text, args=("bad",))
    writer.start()
    assert main(["score", "openlane-v2.1-centerline", str(pipe), str(truth)]) == 2
    writer.join(timeout=5)
    assert not writer.is_alive()
    assert "pipe.json" in capsys.readouterr().err


@pytest.mark.parametrize("unit", ["m8[s]", "M8[ns]"])
def test_times_of_numpy_are_refused_with_the_remedy(unit):
    with pytest.raises(UserError, match=r"timestamp_ns is of type .*expected whole nanoseconds \(\.astype"):
        _time(np.array([5], unit)[0], "frame")

"""`tflane score tusimple` on label files: official numbers, and errors for damaged files."""

import itertools
import json
import re

import numpy as np
import pytest

from tests.metrics.test_tusimple import golden
from tests.shared import shared_root
from tflane_jax.cli import main

ROWS = [240, 250, 260, 270]
TRUTH = [
    {"raw_file": f"clips/0313/{i}/20.jpg", "h_samples": ROWS, "lanes": [[100, 110, 120, 130], [-2, 300, 310, 320]]}
    for i in range(3)
]
GUESS = [{"raw_file": record["raw_file"], "lanes": record["lanes"][:1], "run_time": 10} for record in TRUTH]


def write(path, records):
    path.write_text("\n".join(json.dumps(record) for record in records) + "\n")


def run(folder, guess, truth=TRUTH, protocol="tusimple"):
    write(folder / "pred.json", guess)
    write(folder / "label.json", truth)
    out = folder / "out"
    code = main(["score", protocol, str(folder / "pred.json"), str(folder / "label.json"), "--out", str(out)])
    return code, json.loads(out.with_suffix(".json").read_text())["rows"][0] if code == 0 else {}


def test_by_hand(tmp_path):
    # One of two lanes found in each image; nothing invented.
    code, row = run(tmp_path, GUESS)
    assert code == 0
    assert (row["frames"], row["Accuracy"], row["FP"], row["FN"]) == (3, 0.5, 0.0, 0.5)


def test_the_time_limit_is_the_protocols(tmp_path):
    slow = [GUESS[0] | {"run_time": 300}, *GUESS[1:]]
    assert run(tmp_path, slow)[1]["Accuracy"] == pytest.approx(1 / 3)
    assert run(tmp_path, slow, protocol="tusimple-lstr")[1]["Accuracy"] == 0.5


@pytest.mark.golden
@pytest.mark.parametrize("name", golden())
def test_files_give_the_official_numbers(tmp_path, name):
    case = golden()[name]
    code, row = run(tmp_path, case["pred"], case["gt"])
    assert code == 0
    for number in ("Accuracy", "FP", "FN"):
        assert row[number] == pytest.approx(case["expected"][number], abs=1e-9)


def test_real_labels_against_themselves(tmp_path):
    labels = real_labels()
    code, row = run(tmp_path, [record | {"run_time": 1} for record in labels], labels)
    assert code == 0
    assert (row["frames"], row["FP"], row["FN"]) == (len(labels), 0.0, 0.0)


def test_labels_without_a_point_may_be_there_twice(tmp_path):
    """The official labels have such images."""
    truth = [record | {"lanes": [record["lanes"][0], [-2] * 4, [-2] * 4]} for record in TRUTH]
    assert run(tmp_path, GUESS, truth)[1]["FP"] == 0.0


def test_slow_images_are_remarked(tmp_path, capsys):
    slow = [record | {"run_time": 300} for record in GUESS]
    assert run(tmp_path, slow)[1]["FN"] == 1.0
    said = capsys.readouterr().err
    assert "3 of 3 images took longer than 200 ms and count as without lanes, by TuSimple's rule" in said
    assert "tusimple-lstr allows 20 s" in said
    run(tmp_path, slow, protocol="tusimple-lstr")
    assert "longer than" not in capsys.readouterr().err


@pytest.mark.parametrize("more", [2, 3])
def test_images_with_too_many_lanes_are_remarked(tmp_path, capsys, more):
    lanes = TRUTH[0]["lanes"] + [TRUTH[0]["lanes"][0]] * more
    found = [{"raw_file": TRUTH[0]["raw_file"], "lanes": lanes, "run_time": 1}]
    row = run(tmp_path, found, TRUTH[:1])[1]
    said = "1 of 1 images have over 2 lanes more than their labels and count as without lanes, by TuSimple's rule"
    assert (row["FN"] == 1.0) == (said in capsys.readouterr().err) == (more == 3)


def real_labels():
    path = shared_root() / "data" / "tusimple" / "LaneDetection" / "label_data_0313.json"
    if not path.exists():
        pytest.skip("real TuSimple labels are absent")
    return [json.loads(line) for line in path.read_text().splitlines()]


def moved(records, change):
    """Return predictions whose columns are changed."""
    return [
        {
            "raw_file": record["raw_file"],
            "lanes": [[change(x) if x >= 0 else x for x in lane] for lane in record["lanes"]],
            "run_time": 1,
        }
        for record in records
    ]


@pytest.mark.parametrize("labels", [lambda: TRUTH, real_labels], ids=["hand-made", "real"])
@pytest.mark.parametrize(
    ("change", "formula"),
    [
        (lambda x: x / 2, "2 x"),
        (lambda x: 2 * x, "0.5 x"),
        (lambda x: x / 12.8, "12.8 x"),
        (lambda x: x + 90, "1 x - 90"),
        (lambda x: x + 1e5, "1 x - 100000"),
    ],
)
def test_columns_of_another_image_size_are_remarked(tmp_path, capsys, labels, change, formula):
    assert run(tmp_path, moved(labels(), change), labels())[0] == 0
    said = capsys.readouterr().err
    assert f"% of the predicted lanes are near a true one, but 100% with {formula} in place of x: are they" in said


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda lane: lane[::-1], "with the rows in reverse order: do they ascend"),
        (lambda lane: lane[3:] + [-2] * 3, "3 rows further down: is the first number that of the first of h_samples?"),
        (lambda lane: [-2] * 4 + lane[:-4], "4 rows further up: is the first number"),
        (lambda lane: [1280 - x if x >= 0 else x for x in lane], "mirrored, with 1280 - x in place of x: is x counted"),
    ],
)
def test_other_rows_and_mirrored_columns_are_remarked(tmp_path, capsys, change, cause):
    guess = [{**one, "lanes": [change(lane) for lane in one["lanes"]]} for one in moved(real_labels(), lambda x: x)]
    assert run(tmp_path, guess, real_labels())[0] == 0
    said = capsys.readouterr().err
    assert re.search(r"\d+% of the predicted lanes are near a true one, but \d+% ", said)
    assert cause in said


def test_columns_with_random_errors_have_no_remark(tmp_path, capsys):
    rng = np.random.default_rng(0)
    for error in (3.0, 12.0):
        assert (
            run(
                tmp_path, moved(real_labels(), lambda x, e=error: max(float(x + rng.normal(0, e)), 0.0)), real_labels()
            )[0]
            == 0
        )
        assert "near" not in capsys.readouterr().err


def test_columns_near_no_lane_or_far_outside_are_remarked(tmp_path, capsys):
    zigzag = itertools.cycle([0, 640, 210, 450])
    run(tmp_path, moved(TRUTH, lambda x: next(zigzag)), TRUTH)
    assert "no predicted lane is near a true one: are x pixels of the labelled image" in capsys.readouterr().err
    far = [moved(TRUTH, lambda x: 5000.0 if x == 320 else x)[0], *GUESS[1:]]
    run(tmp_path, far)
    said = "1 predicted points of 1 images reach x 5000, true ones 320 (clips/0313/0/20.jpg): are they outside"
    assert said in capsys.readouterr().err


def test_predictions_and_labels_that_are_swapped_are_guessed(tmp_path, capsys):
    assert run(tmp_path, TRUTH, GUESS)[0] == 2
    assert "It looks like ground truth: are PREDICTIONS and GROUND_TRUTH swapped?" in capsys.readouterr().err


def change(record, **fields):
    return [GUESS[0], {k: v for k, v in (record | fields).items() if v is not ...}, GUESS[2]]


DAMAGE = {
    "missing": (GUESS[:2], r"1 of 3 frames are missing from the predictions: clips/0313/2/20.jpg"),
    "extra": ([*GUESS, GUESS[0] | {"raw_file": "x.jpg"}], r"1 of 4 frames are predicted, but not .*: x.jpg"),
    "twice": ([*GUESS, GUESS[1]], r"line 4: clips/0313/1/20.jpg is there twice, first in line 2"),
    "no lanes": (change(GUESS[1], lanes=...), r"line 2 \(clips/0313/1/20.jpg\) lacks the entry 'lanes'"),
    "ragged": (
        change(GUESS[1], lanes=[[1, 2, 3, 4], [1, 2]]),
        r"line 2 .*: lanes\[1\] has 2 numbers, lanes\[0\] has 4",
    ),
    "rows": (
        change(GUESS[1], lanes=[[1, 2, 3]]),
        r"pred.json, line 2 \(clips/0313/1/20.jpg\): lanes have shape \(1, 3\), expected \(lanes, 4\)",
    ),
    "NaN": (change(GUESS[1], lanes=[[1, 2, float("nan"), 4]]), r"line 2 \(.*\): lanes\[0\] holds nan at \[2\]"),
    "time": (change(GUESS[1], run_time="fast"), r"line 2 \(.*\): run_time is of type str"),
    "no time": (change(GUESS[1], run_time=...), r"lacks the entry 'run_time' \([^()]*\)$"),
    "prefix": (
        [record | {"raw_file": f"/data/tusimple/{record['raw_file']}"} for record in GUESS],
        r"name frames with the prefix /data/tusimple/, the ground truth without: take it off$",
    ),
    "backslashes": (
        [record | {"raw_file": "D:\\" + record["raw_file"].replace("/", "\\")} for record in GUESS],
        r"name frames with the prefix D:/ and backslashes, the ground truth without",
    ),
    "no name": (change(GUESS[1], raw_file=...), r"line 2 lacks the entry 'raw_file'"),
    "a list": ([GUESS[0], [1], GUESS[2]], r"line 2 is of type list, expected a mapping"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_predictions_are_named_to_the_line(tmp_path, capsys, damage):
    guess, message = DAMAGE[damage]
    assert run(tmp_path, guess)[0] == 2
    said = capsys.readouterr().err
    assert re.search(message, said.strip()), said
    assert not (tmp_path / "out.json").exists()


def test_a_broken_line_is_named(tmp_path, capsys):
    write(tmp_path / "label.json", TRUTH)
    (tmp_path / "pred.json").write_text(json.dumps(GUESS[0]) + "\n{'raw_file': 1}\n")
    assert main(["score", "tusimple", str(tmp_path / "pred.json"), str(tmp_path / "label.json")]) == 2
    assert re.search(r"pred.json, line 2 is no JSON record", capsys.readouterr().err)

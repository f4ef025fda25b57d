"""`tflane score` on OpenLane-V2's lane-segment files, in both flavours."""

import json
import pickle
import re

import numpy as np
import pytest

from tests.metrics.fixtures import expected_cases, load_segments
from tests.scoring.files import centerline_annotation, centerline_prediction
from tflane_jax.cli import main
from tflane_jax.geometry.polylines import resample
from tflane_jax.scoring.openlane_v2 import read_segment_truth

NAMES = {"lane_centerline": "lane_segment", "topology_lclc": "topology_lsls", "topology_lcte": "topology_lste"}


def as_segments(record, left, right, areas):
    """Turn a centerline record into one of lane segments."""
    record = {NAMES.get(name, name): value for name, value in record.items()}
    for lane, l_line, r_line in zip(record["lane_segment"], left, right, strict=True):
        lane |= {"centerline": lane.pop("points"), "left_laneline": l_line, "right_laneline": r_line}
    scores = getattr(areas, "scores", np.zeros(len(areas.points)))
    record["area"] = [
        {"category": int(category), "points": points, "confidence": float(score)}
        for category, points, score in zip(areas.categories, areas.points, scores, strict=True)
    ]
    return record


def write(folder, frames, change=lambda results: None):
    results = {
        key: {"predictions": as_segments(centerline_prediction(d.lanes), d.left, d.right, d.areas)}
        for key, (d, _) in frames.items()
    }
    change(results)
    truth = {
        key: {"annotation": as_segments(centerline_annotation(t.lanes), t.left, t.right, t.areas)}
        for key, (_, t) in frames.items()
    }
    (folder / "submission.pkl").write_bytes(pickle.dumps({"results": results}))
    (folder / "annotations.pkl").write_bytes(pickle.dumps(truth))


def run(folder, protocol):
    out = folder / "out"
    code = main(["score", protocol, str(folder / "submission.pkl"), str(folder / "annotations.pkl"), "--out", str(out)])
    return code, json.loads(out.with_suffix(".json").read_text())["rows"][0] if code == 0 else {}


@pytest.fixture
def golden_frames():
    if not expected_cases("lanesegment"):
        pytest.skip("golden/metrics/openlanev2_lanesegment is absent")
    return {("val", "10000", str(i)): frame[:2] for i, frame in enumerate(load_segments("rand_mid"))}


@pytest.mark.golden
def test_files_give_the_official_numbers(tmp_path, golden_frames):
    write(tmp_path, golden_frames)
    expected = expected_cases("lanesegment")["rand_mid"]
    for protocol, official in (("openlane-v2.1-lane-segment", "olus"), ("lanesegnet", "lanesegnet")):
        code, row = run(tmp_path, protocol)
        assert code == 0
        numbers = {name: value for name, value in expected[official].items() if isinstance(value, float)}
        assert len(numbers) >= 4
        for name, value in numbers.items():
            assert row[name] == pytest.approx(value, abs=1e-6), name


@pytest.mark.golden
def test_a_lost_side_line_is_named(tmp_path, golden_frames, capsys):
    def change(results):
        del results["val", "10000", "2"]["predictions"]["lane_segment"][3]["right_laneline"]

    write(tmp_path, golden_frames, change)
    assert run(tmp_path, "lanesegnet")[0] == 2
    assert re.search(r"frame val/10000/2: lane_segment\[3\] lacks the entry 'right_laneline'", capsys.readouterr().err)


def segment_record(crossing, score=None):
    line, side = np.linspace((0, 0, 0), (9, 0, 0), 10), np.array([0, 2, 0])
    lane = {"centerline": line, "left_laneline": line + side, "right_laneline": line - side}
    area = {"category": 1, "points": crossing}
    if score is not None:
        lane["confidence"] = area["confidence"] = score
    empty = {"traffic_element": [], "topology_lsls": [[0]], "topology_lste": np.zeros((1, 0))}
    return {"lane_segment": [lane], "area": [area], **empty}


def test_laneseg_net_measures_the_long_sides_of_a_crossing(tmp_path):
    corners = np.array([[0, 0, 0], [0, 9, 0], [8, 9, 0], [8, 0, 0], [0, 0, 0]], float)
    sides = np.concatenate([np.linspace(corners[0], corners[1], 10), np.linspace(corners[2], corners[3], 10)])
    key = ("val", "1", "1")
    (tmp_path / "annotations.pkl").write_bytes(pickle.dumps({key: {"annotation": segment_record(corners)}}))
    results = {key: {"predictions": segment_record(sides, 0.9)}}
    (tmp_path / "submission.pkl").write_bytes(pickle.dumps({"results": results}))
    own, devkit = run(tmp_path, "lanesegnet")[1], run(tmp_path, "openlane-v2.1-lane-segment")[1]
    assert own["crossing@0.5"] == 1.0
    # The devkit spreads 20 points around the whole outline instead, also along its short sides.
    assert devkit["crossing@0.5"] == 0.0


def test_a_dense_centerline_of_a_segment_is_resampled_along_all_of_its_points(tmp_path):
    """Not along every 20th, as one of the centerline task."""
    record, angle = segment_record(np.eye(3)), np.linspace(0, np.pi, 201)
    record["lane_segment"][0]["centerline"] = arc = np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], -1) * 5
    (tmp_path / "annotations.pkl").write_bytes(pickle.dumps({("val", "1", "1"): {"annotation": record}}))
    (truth,) = read_segment_truth(tmp_path / "annotations.pkl").values()
    np.testing.assert_array_equal(truth.lanes.points[0], resample(arc, 10))


def test_lines_of_the_dataset_are_always_resampled_those_of_a_collected_file_were(tmp_path):
    """However many points an annotator drew: the devkit resamples as it collects."""
    uneven = np.array([[0, 0, 0], *([x, 1, 0] for x in np.linspace(0, 12, 9) ** 1.5)], float)
    record = segment_record(np.concatenate([uneven, uneven[::-1]]))
    record["lane_segment"][0] |= dict.fromkeys(("centerline", "left_laneline", "right_laneline"), uneven.tolist())
    info = tmp_path / "data" / "val" / "1" / "info"
    info.mkdir(parents=True)
    (info / "1-ls.json").write_text(json.dumps({"annotation": record}, default=np.ndarray.tolist))
    (tmp_path / "annotations.pkl").write_bytes(pickle.dumps({("val", "1", "1"): {"annotation": record}}))
    (raw,) = read_segment_truth(tmp_path / "data").values()
    (collected,) = read_segment_truth(tmp_path / "annotations.pkl").values()
    for lines in (raw.lanes.points, raw.left, raw.right):
        np.testing.assert_array_equal(lines[0], resample(uneven, 10))
    for lines in (collected.lanes.points, collected.left, collected.right):
        np.testing.assert_array_equal(lines[0], uneven)
    assert len(raw.areas.points[0]) == len(collected.areas.points[0]) == 20
    assert not np.array_equal(raw.areas.points[0], collected.areas.points[0])


def typed(record, types, visibility=None):
    (lane,) = record["lane_segment"]
    lane |= dict(zip(("left_laneline_type", "right_laneline_type"), types, strict=True))
    return record if visibility is None else record | {"lane_segment": [lane | {"visibility": visibility}]}


@pytest.mark.parametrize("by", ["distance", "occlusion"])
def test_types_and_groups_are_read_from_the_files(tmp_path, by):
    corners = np.array([[0, 0, 0], [0, 9, 0], [8, 9, 0], [8, 0, 0], [0, 0, 0]], float)
    keys = [("val", "1", str(i)) for i in range(2)]
    truth = {key: {"annotation": typed(segment_record(corners), (1, 2), 0.2)} for key in keys}
    found = {key: {"predictions": typed(segment_record(corners, 0.9), (1, i))} for i, key in enumerate(keys)}
    (tmp_path / "annotations.pkl").write_bytes(pickle.dumps(truth))
    (tmp_path / "submission.pkl").write_bytes(pickle.dumps({"results": found}))
    files = [str(tmp_path / name) for name in ("submission.pkl", "annotations.pkl")]
    for protocol in ("lanesegnet", "openlane-v2.1-lane-segment"):
        assert main(["score", protocol, *files, "--by", by, "--out", str(tmp_path / "out")]) == 0
        rows = {row["part"]: row for row in json.loads((tmp_path / "out.json").read_text())["rows"]}
        assert rows["all"]["AE_type"] == 0.5
        assert rows["all"]["AE_dist"] == 0.0
        near, far = ("0 to 10 m", "from 30 m") if by == "distance" else ("occluded", "clear")
        assert (rows[near]["lanes"], rows[far]["lanes"]) == (2, 0)
        assert rows[near]["AE_type"] == 0.5


@pytest.mark.parametrize("side", ["predictions", "annotation"])
def test_types_in_some_frames_alone_are_refused(tmp_path, capsys, side):
    """Regression: AE_type was that of the frames that have them, without a word."""
    corners = np.array([[0, 0, 0], [0, 9, 0], [8, 9, 0], [8, 0, 0], [0, 0, 0]], float)
    keys = [("val", "1", str(i)) for i in range(2)]
    records = {"predictions": {}, "annotation": {}}
    for name, score in (("predictions", 0.9), ("annotation", None)):
        for i, key in enumerate(keys):
            record = segment_record(corners, score)
            records[name][key] = {name: record if name == side and i else typed(record, (1, 2))}
    (tmp_path / "annotations.pkl").write_bytes(pickle.dumps(records["annotation"]))
    (tmp_path / "submission.pkl").write_bytes(pickle.dumps({"results": records["predictions"]}))
    files = [str(tmp_path / name) for name in ("submission.pkl", "annotations.pkl")]
    assert main(["score", "lanesegnet", *files]) == 2
    assert "frame val/1/1: its segments have no left_laneline_type, which those of other" in capsys.readouterr().err


def test_occlusion_needs_visibility(tmp_path, capsys):
    corners = np.array([[0, 0, 0], [0, 9, 0], [8, 9, 0], [8, 0, 0], [0, 0, 0]], float)
    key = ("val", "1", "1")
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({key: {"annotation": segment_record(corners)}}))
    (tmp_path / "s.pkl").write_bytes(pickle.dumps({"results": {key: {"predictions": segment_record(corners, 0.9)}}}))
    assert main(["score", "lanesegnet", str(tmp_path / "s.pkl"), str(tmp_path / "a.pkl"), "--by", "occlusion"]) == 2
    assert "no visibility of its lanes" in capsys.readouterr().err

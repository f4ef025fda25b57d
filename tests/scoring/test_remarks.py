"""`tflane score` says beside the score what is unusual about files that are not wrong."""

import json
import re

import numpy as np
import pytest

from tests.scoring.damaged.valid import KEYS, Case, put
from tests.scoring.damaged.valid import content as valid
from tests.scoring.test_damaged_files import remarks


@pytest.fixture
def folder(tmp_path):
    return tmp_path


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


def _emptied(form):
    """Return the change that leaves a file without a line."""

    def change(content):
        if form == "tusimple":
            for record in content:
                record["lanes"] = []
        elif form == "maptr":
            for sample in content.get("results", content.get("GTs")):
                sample["vectors"] = []
        elif form == "plain":
            for frame in content["frames"]:
                frame |= {name: [] for name in frame.keys() & {"points", "successor", "scores", "visibility"}}
        else:
            for frame in content.get("results", content).values():
                record = frame.get("predictions", frame.get("annotation"))
                for name in record.keys() & {"lane_centerline", "lane_segment"}:
                    record[name] = []
                for name in record:
                    if name.startswith("topology"):
                        record[name] = np.zeros((0, 0 if name in ("topology_lclc", "topology_lsls") else 1), np.int8)

    return change


def _swapped_sides(content):
    for frame in content.get("results", content).values():
        for lane in frame.get("predictions", frame.get("annotation"))["lane_segment"]:
            lane["left_laneline"], lane["right_laneline"] = lane["right_laneline"], lane["left_laneline"]


def _zeros(content):
    for record in content:
        record["lanes"] = [[max(x, 0) for x in lane] for lane in record["lanes"]]


def _first_again(things):
    """Return the change that gives the second of a frame's things the place of the first."""

    def change(content):
        one = content[KEYS[1]]["annotation"][things]
        one[1 % len(one)] |= {name: one[0][name] for name in one[0] if name != "id"}

    return change


def _area_again(content):
    areas = content[KEYS[1]]["annotation"]["area"]
    areas.append(areas[0] | {"id": 31})


def _absent_lanes(content):
    for record in content:
        record["lanes"] = [[-2] * len(lane) for lane in record["lanes"]]


REMARKS = {
    **{
        f"no line in {form} {side}": (
            Case(form, side, "", "", _emptied(form)),
            f"no frame of the {'predictions' if side == 'predictions' else 'ground truth'} has a line: is this",
        )
        for form in ("tusimple", "maptr", "centerline", "segment", "plain")
        for side in ("predictions", "truth")
    },
    "no lane of any image has a point": (
        Case("tusimple", "predictions", "", "", _absent_lanes),
        "no frame of the predictions has a line: is this",
    ),
    "a centerline without length": (
        Case(
            "centerline", "truth", "", "", put(KEYS[0], "annotation", "lane_centerline", 1, "points", np.ones((11, 3)))
        ),
        r"1 true lines have no length, frame val/10000/100, line 1: all points are the same",
    ),
    "an area without length": (
        Case("segment", "truth", "", "", put(KEYS[0], "annotation", "area", 0, "points", np.ones((20, 3)))),
        r"1 true lines have no length, frame val/10000/100, area 0: all points are the same",
    ),
    "a line of a map without length": (
        Case("maptr", "predictions", "", "", put("results", 1, "vectors", 0, "pts", [[0.0, 0.0], [0.0, 0.0]])),
        r"1 predicted lines have no length, frame s1, line 0: all points",
    ),
    "the same lane twice": (
        Case("centerline", "truth", "", "", _first_again("lane_centerline")),
        r"1 true lines or things are there twice, frame val/10000/150, line 1: a prediction finds only one",
    ),
    "the same segment twice": (
        Case("segment", "truth", "", "", _first_again("lane_segment")),
        r"1 true lines or things are there twice, frame val/10000/150, line 1: a prediction finds only one",
    ),
    "the same area twice": (
        Case("segment", "truth", "", "", _area_again),
        r"1 true lines or things are there twice, frame val/10000/150, area 1: a prediction finds only one",
    ),
    "the same plain line twice": (
        Case(
            "plain",
            "truth",
            "",
            "",
            put("frames", 1, "points", [valid("plain", "truth")["frames"][1]["points"][0]] * 2),
        ),
        r"1 true lines or things are there twice, frame a at 2 ns, line 1: a prediction finds only one",
    ),
    **{
        f"swapped sides of segments of the {side}": (
            Case("segment", side, "", "", _swapped_sides),
            f"in 6 of 6 {'predicted' if side == 'predictions' else 'true'} segments left_laneline is on the right of",
        )
        for side in ("predictions", "truth")
    },
    **{
        f"zeros in TuSimple's {side}": (
            Case("tusimple", side, "", "", _zeros),
            f"3 of 24 points of {'predicted' if side == 'predictions' else 'true'} lanes are at x = 0, the image's",
        )
        for side in ("predictions", "truth")
    },
    **{
        f"topology of {form}s above 1": (
            Case(
                form,
                "predictions",
                "",
                "",
                put("results", KEYS[1], "predictions", matrix, np.array([[0.2, 1.5], [0, 0]])),
            ),
            r"predicted topology exceeds 1 in 1 of 3 frames \(frame val/10000/150\), as sums do",
        )
        for form, matrix in (("centerline", "topology_lclc"), ("segment", "topology_lsls"))
    },
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

"""Damage of OpenLane-V2's pickles and of the project's arrays."""

import io
import os
import pickle
import warnings
import zipfile

import numpy as np

from tests.scoring.damaged.valid import KEYS, Case, deep, drop, put

HUGE, LONGEST = 10**400, 10**5000  # Python refuses to write the longer one
_POINTS = {
    "NaN": (np.full((11, 3), np.nan), r"holds nan at \[0, 0\]"),
    "infinite": (np.full((11, 3), np.inf), r"holds inf at \[0, 0\]"),
    "complex": (np.ones((11, 3), complex), "of type ndarray, .*not complex numbers"),
    "truth values": (np.ones((11, 3), bool), "of type ndarray, .*not truth values"),
    "text": (np.full((11, 3), "1"), "of type ndarray, .*not text"),
    "bytes": (np.full((11, 3), b"1"), "of type ndarray, .*not text"),
    "dates": (np.zeros((11, 3), "datetime64[s]"), "of type ndarray, expected numbers"),
    "huge integers": ([[HUGE, 0, 0]] * 11, "holds an integer of hundreds of digits"),
    "a truth value among numbers": ([[True, 0, 0]] * 11, "holds a truth value, expected numbers"),
    "null": (None, "missing"),
    "nulls": ([[None, 0, 0]] * 11, r"missing \(null\)"),
    "a single number": (3.0, r"has shape \(\), expected \(any, 3\)"),
    "an array of nothing": (np.array(None), "expected numbers"),
    "flat": (np.zeros((11, 2)), r"has shape \(11, 2\), expected \(any, 3\)"),
    "transposed": (np.zeros((3, 11)), r"has shape \(3, 11\), expected \(any, 3\)"),
    "nested": (np.zeros((1, 11, 3)), r"has shape \(1, 11, 3\)"),
    "too deep": (deep(80), "expected|shape"),
    "uneven": ([[0, 0, 0], [1, 0]], "rows of one length: row 0 is of 3, row 1 of 2"),
    "empty": (np.zeros((0, 3)), "is empty: a line has at least (one point|2 points)"),
    "records": (np.zeros(11, [("x", "f4")]), "expected numbers"),
    "of a city": (np.full((11, 3), 4e6), "expected metres from the vehicle"),
    "by name": ({"x": 1}, "of type dict"),
}


def _openlane(form, lanes, line, lane_lane, lane_element):
    for side, field in (("predictions", "predictions"), ("truth", "annotation")):
        top = ("results",) if side == "predictions" else ()
        frame = (*top, KEYS[1], field)
        where = rf"{side}.pkl, frame val/10000/150"
        for name, (value, message) in _POINTS.items():
            change = put(*frame, lanes, 1, line, value)
            yield Case(form, side, f"{line} {name}", rf"{where}: {lanes}\[1\].{line}.*({message})", change)
        for name, change, message in (
            ("frame lost", drop(*top, KEYS[1]), "1 of . frames are .*: val/10000/150"),
            ("frame is a list", put(*top, KEYS[1], []), f"{where} is of type list, expected a mapping"),
            ("key is text", _rename(top, "val/10000/150"), "'val/10000/150' is no frame, expected"),
            ("key of two", _rename(top, ("val", "10000")), r"\('val', '10000'\) is no frame"),
            ("key of a path", _rename(top, ("./val", "10000", "150")), r"'150'\) is no frame, expected .* without '/'"),
            ("key with codes", _rename(top, ("val\x1b[31m\n", "10000", "150")), r"'val\\x1b\[31m\\n/10000/150'"),
            ("key of nothing", _rename(top, ("val", "10000", None)), "is no frame, expected .*as texts or numbers"),
            ("key of a huge number", _rename(top, ("val", "10000", LONGEST)), "is no frame, expected"),
            ("key of half a character", _rename(top, ("val", "\ud800", "150")), r"'\\ud800', '150'\) is no frame"),
            ("key of numbers", _again(top, ("val", 10000, 150)), f"{where} is there twice: once with numbers"),
            (f"no {lanes}", drop(*frame, lanes), f"{where} lacks the entry '{lanes}'"),
            ("lanes by number", put(*frame, lanes, {0: {}}), f"{where}: {lanes} is of type dict, expected a list"),
            ("lanes are bytes", put(*frame, lanes, bytearray(2)), f"{where}: {lanes} is of type bytearray"),
            ("lanes are one array", put(*frame, lanes, np.array(2)), f"{where}: {lanes} is of type ndarray"),
            ("a lane is a number", put(*frame, lanes, 1, 3), rf"{where}: {lanes}\[1\] is of type int"),
            (f"no {line}", drop(*frame, lanes, 1, line), rf"{where}: {lanes}\[1\] lacks the entry '{line}'"),
            ("id twice", put(*frame, lanes, 1, "id", 0), rf"{where}: {lanes}\[1\] has the id of {lanes}\[0\], 0"),
            (
                "huge id twice",
                _huge_ids(*frame, lanes),
                rf"{where}: {lanes}\[1\] has the id of {lanes}\[0\], an integer of many digits",
            ),
            ("id is a list", put(*frame, lanes, 1, "id", [0]), rf"{where}: {lanes}\[1\].id is of type list"),
            ("no elements", drop(*frame, "traffic_element"), f"{where} lacks the entry 'traffic_element'"),
            ("elements are null", put(*frame, "traffic_element", None), f"{where}: traffic_element is missing"),
        ):
            yield Case(form, side, name, message, change)
        element = (*frame, "traffic_element", 0)
        for name, value, message in (
            (
                "swapped corners",
                [[10, 10], [0, 0]],
                r"points is \[\[10.0, 10.0\], \[0.0, 0.0\]\]: expected the top-left",
            ),
            ("width and height", [[100, 100], [20, 30]], "width and height in place of the second"),
            ("height", [[100, 100], [120, 30]], "width and height in place of the second"),
            ("flat", [0, 0, 10, 10], r"has shape \(4,\), expected \(2, 2\)"),
            ("NaN", [[0, 0], [10, np.nan]], r"holds nan at \[1, 1\]"),
            ("too wide", [[0, 0], [1e200, 10]], r"holds 1e\+200 at \[1, 0\]: beyond 100000 in size"),
            ("complex", np.ones((2, 2), complex), "complex numbers"),
            ("null", None, "missing"),
        ):
            yield Case(
                form, side, f"box {name}", rf"{where}: traffic_element\[0\].*{message}", put(*element, "points", value)
            )
        for name, value in (
            ("too large", 13), ("negative", -1), ("a fraction", 1.5), ("infinite", np.inf), ("NaN", np.nan),
            ("huge", HUGE), ("true", True), ("text", "2"), ("null", None), ("complex", 2j), ("a list", [2]),
        ):  # fmt: skip
            message = rf"{where}: traffic_element\[0\].attribute is .*, expected a whole number from 0 to 12"
            yield Case(form, side, f"attribute {name}", message, put(*element, "attribute", value))
        for matrix, size in ((lane_lane, r"\(2, 2\)"), (lane_element, r"\(2, 1\)")):
            at = f"{where}: {matrix}"
            for name, value, message in (
                ("above 1", 1.5, "1.5"),
                ("negative", -0.5, "-0.5"),
                ("NaN", np.nan, "nan"),
                ("infinite", np.inf, "inf"),
            ):
                if side == "predictions" and value == 1.5:  # accepted with a remark
                    continue
                wrong = np.zeros((2, 2 if matrix == lane_lane else 1))
                wrong[1, 0] = value
                yield Case(form, side, f"{matrix} {name}", rf"{at}.*{message}", put(*frame, matrix, wrong))
            shape = np.zeros((3, 3))
            yield Case(
                form, side, f"{matrix} shape", rf"{at} has shape \(3, 3\), expected {size}", put(*frame, matrix, shape)
            )
            yield Case(form, side, f"no {matrix}", f"{where} lacks the entry '{matrix}'", drop(*frame, matrix))
            numbers = np.zeros((2, 2), complex)
            yield Case(form, side, f"{matrix} complex", f"{at} .*complex", put(*frame, matrix, numbers))
            yield Case(form, side, f"{matrix} null", f"{at} is missing", put(*frame, matrix, None))
    frame = ("results", KEYS[1], "predictions")
    where = "predictions.pkl, frame val/10000/150"
    for things in (lanes, "traffic_element"):
        for name, value, message in (
            ("above 1", 1.5, "number 0 is 1.5, expected 0 to 1"),
            ("a logit", -4.0, "number 0 is -4, expected 0 to 1"),
            ("NaN", np.nan, "holds nan"),
            ("complex", 0.5 + 0j, "complex"),
            ("true", True, "truth value"),
            ("text", "0.5", "text"),
            ("a list", [0.5], "shape|rows of one length"),
        ):
            change = put(*frame, things, 0, "confidence", value)
            yield Case(form, "predictions", f"{things} {name}", f"{where}: {things}: confidence.*({message})", change)
        lost = rf"{where}: {things}\[0\] lacks the entry 'confidence'"
        yield Case(form, "predictions", f"{things} no confidence", lost, drop(*frame, things, 0, "confidence"))
    seen = put(KEYS[1], "annotation", lanes, 1, "visibility", 0.5)
    yield Case(form, "truth", "visibility of one lane", rf"{lanes}\[0\] lacks the entry 'visibility'", seen)

    def above(content):
        for lane in content[KEYS[1]]["annotation"][lanes]:
            lane["visibility"] = 1.5

    yield Case(form, "truth", "visibility above 1", "visibility: number 0 is 1.5, expected 0 to 1", above)
    one = put(KEYS[1], "annotation", lanes, 1, line, np.zeros((1, 3)))
    single = rf"{lanes}\[1\].{line} has one point: a line has at least 2"
    yield Case(form, "truth", f"{line} of one point", single, one)
    half = put(KEYS[1], "annotation", lane_lane, np.array([[0, 0.7], [0, 0]]))
    yield Case(form, "truth", "probabilities for edges", r"holds 0.7 at \[0, 1\], expected 0 or 1", half)


def _huge_ids(*way):
    def change(content):
        for step in way:
            content = content[step]
        for thing in content:
            thing["id"] = LONGEST

    return change


def _rename(top, key):
    def change(content):
        for step in top:
            content = content[step]
        content[key] = content.pop(KEYS[1])

    return change


def _again(top, key):
    def change(content):
        for step in top:
            content = content[step]
        content[key] = content[KEYS[1]]

    return change


def _segments():
    for side, frame in (("predictions", ("results", KEYS[1], "predictions")), ("truth", (KEYS[1], "annotation"))):
        where = rf"{side}.pkl, frame val/10000/150"
        for line in ("left_laneline", "right_laneline"):
            at = rf"{where}: lane_segment\[1\].{line}"
            lost = rf"{where}: lane_segment\[1\] lacks the entry '{line}'"
            yield Case("segment", side, f"no {line}", lost, drop(*frame, "lane_segment", 1, line))
            if side == "truth":
                one = put(*frame, "lane_segment", 1, line, np.zeros((1, 3)))
                yield Case("segment", side, f"{line} of one point", f"{at} has one point: a line has", one)
            for name in ("NaN", "complex", "flat", "empty", "null"):
                value, message = _POINTS[name]
                yield Case(
                    "segment", side, f"{line} {name}", f"{at}.*{message}", put(*frame, "lane_segment", 1, line, value)
                )
        some = drop(*frame, "lane_segment", 1, "left_laneline_type")
        yield Case("segment", side, "type of one line", r"lane_segment\[1\] lacks the entry 'left_laneline_type'", some)
        kind = put(*frame, "lane_segment", 1, "left_laneline_type", 5)
        yield Case("segment", side, "another type", "left_laneline_type is 5, expected .* from 0 to 2", kind)
        point = put(*frame, "area", 0, "points", np.zeros((1, 3)))
        one_point = ("area of one point", point, r"area\[0\].points has one point: a line has at least 2")
        for name, change, message in (
            ("no areas", drop(*frame, "area"), f"{where} lacks the entry 'area'"),
            ("another category", put(*frame, "area", 0, "category", 3), r"area\[0\].category is 3, expected .* 1 to 2"),
            ("no category", drop(*frame, "area", 0, "category"), r"area\[0\] lacks the entry 'category'"),
            *([one_point] if side == "truth" else []),
            ("flat area", put(*frame, "area", 0, "points", np.zeros((20, 2))), r"area\[0\].points has shape \(20, 2\)"),
        ):
            yield Case("segment", side, name, message, change)
    score = put("results", KEYS[1], "predictions", "area", 0, "confidence", 2.0)
    yield Case("segment", "predictions", "area score", "area: confidence: number 0 is 2, expected 0 to 1", score)


def _pickles():
    class Evil:
        def __reduce__(self):
            return os.system, ("true",)

    deep_pickle = b"\x80\x04" + b"]" * 200_000 + b"a" * 199_999 + b"."
    for side in ("predictions", "truth"):
        for name, after, message in (
            ("empty", lambda b: b"", "no pickle file, or it is damaged"),
            ("cut off", lambda b: b[: len(b) // 2], "no pickle file, or it is damaged"),
            ("not a pickle", lambda b: b"{'results': {}}", "no pickle file, or it is damaged"),
            ("code", lambda b: pickle.dumps(Evil()), "is refused: it is a pickle that names"),
            ("a list", lambda b: pickle.dumps([1, 2]), "is of type list, expected a mapping"),
            ("no frames", lambda b: pickle.dumps({"results": {}}), "frame|looks like|empty: it has no frames"),
            ("nested too deep", lambda b: deep_pickle, "is of type list, expected a mapping"),
        ):
            yield Case("centerline", side, name, message, after=after)
    results = put("results", [1])
    yield Case(
        "centerline", "predictions", "results are a list", "results is of type list, expected a mapping", results
    )


def _npz_of(header, data=b""):
    """Return a file whose array `points` has any header."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        text = header.encode()
        text += b" " * (63 - (len(text) + 10) % 64) + b"\n"
        archive.writestr("points.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data)
    return stream.getvalue()


def _twice(written):
    stream = io.BytesIO(written)
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("points.npy", archive.read("points.npy"))
    return stream.getvalue()


def _arrays():
    claims = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000, 1000, 3), }"
    for side in ("predictions", "truth"):
        for name, after, message in (
            ("empty", lambda b: b"", "no .npz file of plain arrays"),
            ("cut off", lambda b: b[: len(b) // 2], "no .npz file of plain arrays"),
            ("no archive", lambda b: b"points", "no .npz file of plain arrays"),
            (
                "terabytes",
                lambda b: _npz_of(claims, bytes(240)),
                r"points.npy claims 2.4e\+13 bytes, but the file has 240",
            ),
            ("negative size", lambda b: _npz_of(claims.replace("1000000", "-1")), "no .npz file of plain arrays"),
            ("no header", lambda b: _npz_of("{'descr': '<f8'"), "no .npz file of plain arrays"),
            ("a wrong header", lambda b: _npz_of("{'shape': 3}"), "no .npz file of plain arrays"),
            ("an array twice", _twice, "an array is there twice"),
            ("bytes changed", lambda b: b[:300] + bytes(50) + b[350:], "no .npz file of plain arrays"),
        ):
            yield Case("npz", side, name, message, after=after)
        for name, changes, message in (
            ("no points", {"points": ...}, "lacks the entry 'points'"),
            ("no scene", {"scene": ...}, "lacks the entry 'scene'"),
            ("no time", {"timestamp_ns": ...}, "lacks the entry 'timestamp_ns'"),
            ("no successor", {"successor": ...}, "frame a at 1 ns lacks the entry 'successor'"),
            (
                "points of one frame",
                {"points": np.zeros((2, 11, 3))},
                r"points has shape \(2, 11, 3\), expected \(frames",
            ),
            ("points of less frames", {"points": np.zeros((2, 2, 11, 3))}, r"scene has shape \(3,\), expected \(2,\)"),
            ("flat points", {"points": np.zeros((3, 2, 11, 2))}, r"frame a at 1 ns: points\[0\] has shape \(11, 2\)"),
            ("complex points", {"points": np.ones((3, 2, 11, 3), complex)}, r"points\[0\] .*complex numbers"),
            ("text points", {"points": np.full((3, 2, 11, 3), "1")}, r"points\[0\] .*text"),
            ("no numbers", {"points": np.full((3, 2, 11, 3), np.nan)}, r"points\[0\] holds nan"),
            ("objects", {"points": np.array([{}], object)}, "no .npz file of plain arrays"),
            ("no points in lanes", {"points": np.zeros((3, 2, 0, 3))}, r"points\[0\] is empty"),
            ("NaN in valid", {"valid": np.full((3, 2), np.nan)}, r"valid holds nan at \[0, 0\]"),
            ("numbers in valid", {"valid": np.full((3, 2), 0.7)}, r"valid holds 0.7 at \[0, 0\], expected 0 or 1"),
            ("text in valid", {"valid": np.full((3, 2), "yes")}, "valid is .*text"),
            ("valid of lanes", {"valid": np.ones(2, bool)}, r"valid has shape \(2,\), expected \(3, 2\)"),
            ("time is a fraction", {"timestamp_ns": np.arange(3) + 0.5}, "timestamp_ns is .*0.5.*, expected whole"),
            ("times are NaN", {"timestamp_ns": np.full(3, np.nan)}, "timestamp_ns is .*nan.*, expected whole"),
            ("scenes are bytes", {"scene": np.array([b"a", b"a", b"b"])}, "scene is .*, expected a text"),
            ("scenes are fractions", {"scene": np.arange(3) + 0.5}, "scene is .*0.5.*, expected a text"),
            ("negative successor", {"successor": np.full((3, 2, 2), -0.5)}, "frame a at 1 ns: successor.*-0.5"),
            ("successor NaN", {"successor": np.full((3, 2, 2), np.nan)}, "successor holds nan"),
            ("successor complex", {"successor": np.zeros((3, 2, 2), complex)}, "successor .*complex"),
            (
                "successor shape",
                {"successor": np.zeros((3, 2, 3))},
                r"successor has shape \(3, 2, 3\), expected \(3, 2, 2\)",
            ),
        ):
            yield Case("npz", side, name, f"{side}.npz.*{message}", _changed(changes))
    for name, value in (("above 1", 2.0), ("negative", -0.1), ("NaN", np.nan)):
        wrong = _changed({"scores": np.full((3, 2), value)})
        yield Case("npz", "predictions", f"scores {name}", f"frame a at 1 ns: scores.*{value:g}", wrong)
    with_scores = _changed({"scores": np.ones((3, 2))})
    yield Case("npz", "truth", "scores", "is a file of predictions: give the ground truth", with_scores)


def _changed(changes):
    def change(arrays):
        for name, value in changes.items():
            if value is ...:
                del arrays[name]
            else:
                arrays[name] = value

    return change


BINARY_CASES = [
    *_openlane("centerline", "lane_centerline", "points", "topology_lclc", "topology_lcte"),
    *_openlane("segment", "lane_segment", "centerline", "topology_lsls", "topology_lste"),
    *_segments(),
    *_pickles(),
    *_arrays(),
]

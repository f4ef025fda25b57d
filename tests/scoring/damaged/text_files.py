"""Damage of the JSON files: TuSimple's lines, MapTR's samples, the project's plain frames."""

import json

from tests.scoring.damaged.valid import Case, content, deep, drop, encoded, put, repeat, text

HUGE, LONGEST = 10**400, "9" * 5000
_BAD_NUMBERS = {
    "NaN": (float("nan"), "holds nan"),
    "infinity": (float("inf"), "holds inf"),
    "huge integer": (HUGE, "holds an integer of hundreds of digits"),
    "null": (None, "null"),
    "text": ("1.5", "text"),
    "object": ({"x": 1}, "type dict|expected numbers"),
    "truth value": (True, "holds a truth value"),
}


def _broken(form, side, record):
    """Return what can happen to any JSON file; `record` is a text in it."""
    other = encoded("centerline", "truth")
    for name, after, message in (
        ("empty", lambda b: b"", f"{side}.json is (no JSON|empty: it has no frames)"),
        ("cut off", lambda b: b[: len(b) // 2], "no JSON (file|record)"),
        ("not text", lambda b: other, "not text"),
        ("two-byte characters", lambda b: b.decode().encode("utf-16"), "not text"),
        ("nested too deep", lambda b: text(record, "[" * 100_000 + "]" * 100_000)(b), "nested too deep"),
        ("integer of 5000 digits", text(record, LONGEST), "Exceeds the limit"),
        ("single quotes", lambda b: b.replace(b'"', b"'"), "no JSON (file|record): Expecting property name"),
        ("a number alone", lambda b: b"7\n", "is of type int, expected a mapping"),
        ("null alone", lambda b: b"null\n", r"missing \(null\), expected a mapping"),
    ):
        yield Case(form, side, name, message, after=after)


def _tusimple():
    for side in ("predictions", "truth"):
        where = rf"{side}.json, line 2 \(clips/0313/1/20.jpg\)"
        yield from _broken("tusimple", side, "[100, 110, 120, 130]")
        change = {
            "list of records": (None, "is one JSON list: TuSimple's files have one JSON record on each line"),
            "twice": (repeat(1), r"line 4: clips/0313/1/20.jpg is there twice, first in line 2"),
            "no lanes": (drop(1, "lanes"), f"{where} lacks the entry 'lanes'"),
            "no image": (drop(1, "raw_file"), "line 2 lacks the entry 'raw_file'"),
            "image is a number": (put(1, "raw_file", 7), "line 2: raw_file is 7, expected the path"),
            "image is half a character": (put(1, "raw_file", "\ud800"), r"line 2: raw_file is '\\ud800', expected the"),
            "image has no name": (put(1, "raw_file", ""), "line 2: raw_file is '', expected the path"),
            "lanes are text": (put(1, "lanes", "none"), f"{where}: lanes is of type str"),
            "lanes are null": (put(1, "lanes", None), f"{where}: lanes is missing"),
            "lanes by name": (put(1, "lanes", {"0": [1, 2, 3, 4]}), f"{where}: lanes is of type dict"),
            "a lane is a number": (put(1, "lanes", 1, 7), rf"{where}: lanes\[1\] .*\(\), expected \((4|any),\)"),
            "a short lane": (put(1, "lanes", 1, [1, 2, 3]), rf"{where}: lanes\[1\] has"),
            "a lane of points": (put(1, "lanes", 1, [[1, 240]] * 4), rf"{where}: lanes\[1\] has shape \(4, 2\)"),
            "a far column": (put(1, "lanes", 1, 2, 1e30), rf"{where}: lanes\[1\] holds 1e\+30 at \[2\]: beyond"),
            "fractions of the width": (_normalised, rf"{side}.json: every x .* 0 and 1: multiply"),
            "a name with codes": (_escaped, r"line 2 \('a\\x1b\[31m\\n'\): lanes"),
            "other frames": (put(1, "raw_file", "clips/0601/1/20.jpg"), r"1 of 3 frames are .*clips/0601/1/20.jpg"),
        }
        for name, (value, said) in _BAD_NUMBERS.items():
            change[f"a column is {name}"] = put(1, "lanes", 1, 2, value), rf"{where}: lanes\[1\].*({said})"
        for name, (damage, message) in change.items():
            if damage is None:
                yield Case("tusimple", side, name, message, after=_as_list)
                yield Case("tusimple", side, name + " over lines", message, after=_as_lines_of_list)
            else:
                yield Case("tusimple", side, name, message, damage)
        yield Case("tusimple", side, "an entry twice", r"line 1: an object has the entry 'lanes' twice", after=_twice)
    where = r"predictions.json, line 2 \(clips/0313/1/20.jpg\)"
    for name, value, message in (
        ("negative", -1, "run_time is -1, expected milliseconds"),
        ("a word", "fast", "run_time is of type str"),
        ("true", True, "run_time is of type bool"),
        ("a list", [10], r"run_time has shape \(1,\)"),
        ("null", None, "run_time"),
        ("NaN", float("nan"), "run_time holds nan"),
    ):
        yield Case("tusimple", "predictions", f"time is {name}", f"{where}: .*{message}", put(1, "run_time", value))
    yield Case("tusimple", "predictions", "no time", f"{where} lacks the entry 'run_time'", drop(1, "run_time"))
    for name, rows, message in (
        ("reversed", [270, 260, 250, 240], "h_samples holds 260 after 270: expected rows from top to bottom"),
        ("twice", [240, 250, 250, 270], "h_samples holds 250 after 250: .*each once"),
        ("negative", [-10, 250, 260, 270], "h_samples holds -10, expected rows of the image"),
        ("missing", ..., "lacks the entry 'h_samples'"),
        ("text", ["a", "b", "c", "d"], "h_samples is .*text"),
        ("NaN", [240, float("nan"), 260, 270], r"h_samples holds nan at \[1\]"),
        ("a number", 240, "h_samples is of type int, expected a list"),
        ("too few", [240, 250, 260], r"lanes\[0\] has shape \(4,\), expected \(3,\)"),
    ):
        damage = drop(1, "h_samples") if rows is ... else put(1, "h_samples", rows)
        yield Case("tusimple", "truth", f"rows are {name}", f"truth.json, line 2 .*{message}", damage)
    same = r"truth.json, line 2 .*: lanes\[2\] is lanes\[1\] once more: keep one of them"
    yield Case("tusimple", "truth", "a lane twice", same, repeat(1, "lanes", 1))
    shifted = r"line 2 .*: h_samples are 250 to 280, those of the truth 240 to 270"
    yield Case("tusimple", "predictions", "shifted rows", shifted, put(1, "h_samples", [250, 260, 270, 280]))
    none = r"line 2 .*: h_samples are empty, those of the truth 240 to 270"
    yield Case("tusimple", "predictions", "no rows, no lanes", none, _without_rows)


def _escaped(records):
    records[1] |= {"raw_file": "a\x1b[31m\n", "lanes": None}


def _without_rows(records):
    records[1] |= {"h_samples": [], "lanes": []}


def _normalised(records):
    for record in records:
        record["lanes"] = [[x / 1280 if x > 0 else x for x in lane] for lane in record["lanes"]]


def _as_list(written):
    return json.dumps([json.loads(line) for line in written.splitlines()]).encode()


def _as_lines_of_list(written):
    return json.dumps([json.loads(line) for line in written.splitlines()], indent=1).encode()


def _twice(written):
    return text('"lanes":', '"lanes": [], "lanes":')(written)


def _maptr():
    for side, field in (("predictions", "results"), ("truth", "GTs")):
        yield from _broken("maptr", side, "[0.0, 9.0]")
        yield Case(
            "maptr", side, "an entry twice", "has the entry 'pts' twice", after=text('"pts":', '"pts": [], "pts":')
        )
        first, second = (field, 1, "vectors", 0), (field, 0, "vectors", 1)
        where = rf"{side}.json, sample s1: vectors\[0\]"
        for name, change, message in (
            ("no samples", drop(field), f"lacks the entry '{field}'"),
            ("samples by token", put(field, {"s0": []}), f"{field} is of type dict, expected a list"),
            ("a sample is a list", put(field, 1, []), rf"{field}\[1\] is of type list, expected a mapping"),
            ("a sample twice", repeat(field, 1), "sample s1 is there twice"),
            ("a token with codes", put(field, 1, "sample_token", "s1 \n"), r"1 of 3 frames are .*: 's1 \\n'"),
            ("a sample lost", drop(field, 1), "1 of . frames are .*: s1"),
            ("no token", drop(field, 1, "sample_token"), rf"{field}\[1\] lacks the entry 'sample_token'"),
            ("token is null", put(field, 1, "sample_token", None), rf"{field}\[1\].sample_token is None"),
            ("token is a list", put(field, 1, "sample_token", ["s1"]), r"sample_token is \['s1'\], expected a text"),
            ("token is half a character", put(field, 1, "sample_token", "\ud800"), r"is '\\ud800', expected a text"),
            ("no vectors", drop(field, 1, "vectors"), "sample s1 lacks the entry 'vectors'"),
            ("vectors are null", put(field, 1, "vectors", None), "sample s1: vectors is missing"),
            ("a vector is a number", put(*first, 3), f"{where} is of type int, expected a mapping"),
            ("no points", drop(*first, "pts"), f"{where} lacks the entry 'pts'"),
            ("points are flat", put(*first, "pts", [0, 1, 0, 9]), rf"{where}.pts has shape \(4,\)"),
            ("points of one number", put(*first, "pts", [[0], [9]]), rf"{where}.pts has shape \(2, 1\)"),
            ("points of four numbers", put(*first, "pts", [[0] * 4] * 2), rf"{where}.pts has shape \(2, 4\)"),
            ("no point", put(*first, "pts", []), rf"{where}.pts has shape \(0, 0\)"),
            ("uneven points", put(*first, "pts", 1, [1.0]), rf"{where}.pts .*row 0 is of 2, row 1 of 1"),
            (
                "a map's coordinates",
                put(*first, "pts", 1, [4e6, 5e5]),
                rf"{where}.pts holds 4e\+06 at \[1, 0\]: beyond",
            ),
            ("another count", put(*first, "pts_num", 20), f"{where}.pts_num is 20, but pts has 2 points"),
            ("count is text", put(*first, "pts_num", "2"), f"{where}.pts_num is '2', but"),
            ("another class", put(*first, "cls_name", "kerb"), f"{where}.cls_name is 'kerb', expected one of divider"),
            ("another type", put(*first, "type", 5), f"{where}.type is 5, but other lines of the class divider have 0"),
            ("type of another class", put(*second, "type", 0), "is 0, which lines of the class divider have, but"),
            ("type is text", put(*first, "type", "divider"), f"{where}.type is 'divider', expected a whole number"),
            ("class is a number", put(*first, "cls_name", 0), f"{where}.cls_name is 0, expected one of"),
            ("class is a list", put(*first, "cls_name", ["divider"]), f"{where}.cls_name is "),
            ("no class", drop(*first, "cls_name"), f"{where} lacks the entry 'cls_name'"),
            ("points too deep", put(*first, "pts", deep(70)), rf"{where}.pts"),
        ):
            yield Case("maptr", side, name, message, change)
        for name, (value, said) in _BAD_NUMBERS.items():
            yield Case("maptr", side, f"a point is {name}", rf"{where}.pts.*({said})", put(*first, "pts", 1, 0, value))
    level = ("results", 1, "vectors", 1, "confidence_level")
    for name, value, message in (
        ("above 1", 1.5, r"number 1 is 1.5, expected 0 to 1$"),
        ("above 1 by rounding", 1 + 1e-12, r"number 1 is 1.000000000001, expected 0 to 1 \(a rounding error"),
        ("a logit", -3.2, r"number 1 is -3.2, expected 0 to 1 \(apply the sigmoid first\)"),
        ("true", True, "holds a truth value"),
        ("a word", "high", "text"),
        ("null", None, "null"),
        ("a list", [0.9], "rows of one length|shape"),
        ("NaN", float("nan"), r"holds nan at \[1\]"),
    ):
        yield Case(
            "maptr", "predictions", f"score is {name}", f"sample s1: confidence_level.*{message}", put(*level, value)
        )
    yield Case("maptr", "predictions", "no score", r"vectors\[1\] lacks the entry 'confidence_level'", drop(*level))
    one = put("GTs", 1, "vectors", 0, "pts", [[0.0, 0.0]])
    yield Case("maptr", "truth", "a line of one point", r"pts has shape \(1, 2\), expected .* at least 2", one)
    same = r"truth.json, sample s1: vectors\[2\] is vectors\[0\] once more: keep one of them"
    yield Case("maptr", "truth", "a line twice", same, repeat("GTs", 1, "vectors", 0))
    seen = put("GTs", 1, "vectors", 0, "visibility", 0.5)
    yield Case("maptr", "truth", "visibility of one line", r"vectors\[1\] lacks the entry 'visibility'", seen)


def _plain():
    for side in ("predictions", "truth"):
        yield from _broken("plain", side, "[0.0, 0.0, 0.0]")
        frame = ("frames", 1)
        where = rf"{side}.json, frame a at 2 ns"
        for name, change, message in (
            ("no frames", drop("frames"), "lacks the entry 'frames'"),
            ("frames are null", put("frames", None), "frames is missing"),
            ("a frame twice", repeat(*frame), "frame a at 2 ns is there twice"),
            ("a long scene", put(*frame, "scene", "9" * 5000), r"1 of 3 frames are .*: 9{80} "),
            ("a frame lost", drop(*frame), "1 of . frames are .*: a at 2 ns"),
            ("no scene", drop(*frame, "scene"), r"frames\[1\] lacks the entry 'scene'"),
            ("scene is a list", put(*frame, "scene", ["a"]), r"frames\[1\]: scene is \['a'\], expected a text"),
            ("scene is half a character", put(*frame, "scene", "\udfff"), r"scene is '\\udfff', expected a text"),
            (
                "scene of many digits",
                put(*frame, "scene", 10**300),
                "scene is an integer of many digits, expected a text",
            ),
            (
                "scene with codes",
                put(*frame, "scene", "a\x1b[31m\n"),
                r"1 of 3 frames are .*: 'a\\x1b\[31m\\n at 2 ns'",
            ),
            ("scene is null", put(*frame, "scene", None), r"frames\[1\]: scene is None, expected a text"),
            ("time is a fraction", put(*frame, "timestamp_ns", 1.5), "timestamp_ns is 1.5, expected whole nanoseconds"),
            ("time is huge", put(*frame, "timestamp_ns", HUGE), "timestamp_ns is an integer of many digits"),
            ("time of 6000 digits", put(*frame, "timestamp_ns", "9" * 6000), "timestamp_ns is '9+.*, expected whole"),
            ("time is a word", put(*frame, "timestamp_ns", "now"), "timestamp_ns is 'now', expected whole"),
            ("no points", drop(*frame, "points"), f"{where} lacks the entry 'points'"),
            ("points are text", put(*frame, "points", "none"), f"{where}: points is of type str"),
            ("a lane is empty", put(*frame, "points", 1, []), rf"{where}: points\[1\] is empty"),
            (
                "a lane of flat points",
                put(*frame, "points", 1, [[0, 0]] * 11),
                rf"{where}: points\[1\] has shape \(11, 2\)",
            ),
            ("a lane is lost", drop(*frame, "points", 1), rf"{where}: (successor|scores) has"),
            (
                "city coordinates",
                put(*frame, "points", 1, 4, 0, 5e6),
                rf"{where}: points\[1\] .*metres from the vehicle",
            ),
            ("no successor", drop(*frame, "successor"), f"{where} lacks the entry 'successor'"),
            ("successor is flat", put(*frame, "successor", [0, 1]), rf"{where}: successor has shape \(2,\), expected"),
            # Predicted edges above 1 are sums, and only remarked.
            (
                "successor above 1",
                put(*frame, "successor", 0, 1, 1.5 if side == "truth" else float("inf")),
                f"{where}: successor.*(1.5|inf)",
            ),
            ("negative successor", put(*frame, "successor", 0, 1, -1), f"{where}: successor.*-1"),
            ("successor is text", put(*frame, "successor", 0, 1, "yes"), f"{where}: successor"),
        ):
            yield Case("plain", side, name, message, change)
        for name, (value, said) in _BAD_NUMBERS.items():
            bad = put(*frame, "points", 1, 3, 0, value)
            yield Case("plain", side, f"a point is {name}", rf"{where}: points\[1\].*({said})", bad)
        column = "scores" if side == "predictions" else "visibility"
        for name, value, message in (
            ("too few", [0.5], "has 1 numbers for 2 lanes"),
            ("above 1", [0.5, 50.0], "number 1 is 50, expected 0 to 1"),
            ("text", ["a", "b"], "text"),
            ("null", None, "missing"),
            ("truth values", [True, False], "truth value"),
        ):
            yield Case(
                "plain", side, f"{column} are {name}", f"{where}: {column}.*{message}", put(*frame, column, value)
            )
    yield Case("plain", "predictions", "no scores", "lacks the entry 'scores'", drop("frames", 1, "scores"))
    yield Case(
        "plain",
        "truth",
        "probabilities for edges",
        "holds 0.7 at .*expected 0 or 1",
        put(*("frames", 1, "successor", 0, 1), 0.7),
    )


def _swapped():
    """Yield files of the other side, and of other protocols."""
    for form in ("tusimple", "maptr", "plain", "centerline", "segment", "npz"):
        for side, other in (("predictions", "truth"), ("truth", "predictions")):
            yield Case(form, side, "swapped", "looks like .*PREDICTIONS and GROUND_TRUTH swapped", _become(form, other))
    for form, other, suggested in (
        ("maptr", "tusimple", "TuSimple: score it by tusimple or tusimple-lstr"),
        ("tusimple", "maptr", "MapTR: score it by maptr"),
        ("tusimple", "plain", "plain centerlines: score it by openlane-v2.1-centerline"),
        ("plain", "maptr", "MapTR: score it by maptr"),
        ("plain", "tusimple", "TuSimple: score it by"),
        ("centerline", "segment", "OpenLane-V2 lane segments: score it by openlane-v2.1-lane-segment or lanesegnet"),
        ("segment", "centerline", "OpenLane-V2 centerlines: score it by openlane-v2.1-centerline"),
    ):
        for side in ("predictions", "truth"):
            yield Case(form, side, f"of {other}", f"looks like .* of {suggested}", after=_file_of(other, side))
    lanes = {"frames": [{"scene": "a", "timestamp_ns": 1, "lanes": []}]}
    yield Case("plain", "predictions", "best lanes only", "give predictions.npz beside it", lambda _: lanes)
    frame = json.dumps({"annotation": {"lane_centerline": []}}).encode()
    given = "the annotations of one frame: give the folder"
    yield Case("plain", "truth", "one frame of a folder", given, after=lambda _: frame)


def _become(form, side):
    return lambda _: content(form, side)


def _file_of(form, side):
    return lambda _: encoded(form, side)


TEXT_CASES = [*_tusimple(), *_maptr(), *_plain(), *_swapped()]

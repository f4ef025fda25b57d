"""Small valid files of every protocol, and what damages them.

A case names a protocol, the damaged side, and a change of its content before it is written, or of its bytes after.
"""

import copy
import io
import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Side = Literal["predictions", "truth"]
KEYS = [("val", "10000", "100"), ("val", "10000", "150"), ("val", "10001", "100")]
SIDE = np.array([0, 2, 0])
ROWS = [240, 250, 260, 270]


def _line(start, stop, points=11):
    return np.linspace(start, stop, points)


def _tusimple(side):
    records = []
    for i in range(3):
        record = {"raw_file": f"clips/0313/{i}/20.jpg", "lanes": [[100, 110, 120, 130], [-2, 300, 310, 320]]}
        records.append(record | ({"run_time": 10} if side == "predictions" else {"h_samples": ROWS}))
    return records


def _maptr(side):
    lines = [([[0.0, 0.0], [0.0, 9.0]], "divider", 0), ([[5.0, -9.0], [5.0, 0.0], [5.0, 9.0]], "boundary", 2)]
    samples = []
    for i in range(3):
        vectors = [{"pts": p, "pts_num": len(p), "cls_name": name, "type": kind} for p, name, kind in lines]
        for vector in vectors if side == "predictions" else []:
            vector["confidence_level"] = 0.9
        samples.append({"sample_token": f"s{i}", "vectors": copy.deepcopy(vectors)})
    return {"meta": {}, "results": samples} if side == "predictions" else {"GTs": samples}


def _frame(side, lanes, links, fields):
    """Return a frame of OpenLane-V2 with two lanes and one traffic element."""
    predicted = side == "predictions"
    things = [{"id": i, **fields(i, predicted)} for i in range(2)]
    element = {"id": 7, "points": np.array([[0.0, 0.0], [10.0, 10.0]]), "attribute": 2, "category": 1}
    for thing in (*things, element) if predicted else ():
        thing["confidence"] = 0.8 - 0.1 * thing["id"] / 10
    matrices = [[0, 1], [0, 0]], [[1], [0]]
    one = np.float32 if predicted else np.int8
    record = {lanes: things, "traffic_element": [element]}
    return record | {name: np.array(matrix, one) for name, matrix in zip(links, matrices, strict=True)}


def _openlane(side, frame):
    if side == "predictions":
        return {"method": "test", "results": {key: {"predictions": frame("predictions")} for key in KEYS}}
    return {key: {"annotation": frame("truth")} for key in KEYS}


def _centerline(side):
    def fields(i, predicted):
        return {"points": _line((10.0 * i, 0, 0), (10.0 * i + 10, 0, 0), 11 if predicted else 201)}

    return _openlane(side, lambda s: _frame(s, "lane_centerline", ("topology_lclc", "topology_lcte"), fields))


def _segment(side):
    def fields(i, predicted):
        center = _line((10.0 * i, 0, 0), (10.0 * i + 10, 0, 0), 10)
        sides = {"left_laneline": center + SIDE, "right_laneline": center - SIDE}
        return {"centerline": center, **sides, "left_laneline_type": 1, "right_laneline_type": 2}

    def frame(s):
        record = _frame(s, "lane_segment", ("topology_lsls", "topology_lste"), fields)
        area = {"id": 30, "category": 1, "points": _line((0, -4, 0), (0, 4, 0), 20)}
        return record | {"area": [area | ({"confidence": 0.7} if s == "predictions" else {})]}

    return _openlane(side, frame)


def _plain(side):
    frames = []
    for scene, time in (("a", 1), ("a", 2), ("b", 1)):
        lines = [_line((10.0 * i, 0, 0), (10.0 * i + 10, 0, 0)).tolist() for i in range(2)]
        frame = {"scene": scene, "timestamp_ns": time, "points": lines, "successor": [[0, 1], [0, 0]]}
        frames.append(frame | ({"scores": [0.9, 0.8]} if side == "predictions" else {"visibility": [1.0, 0.2]}))
    return {"frames": frames}


def _arrays(side):
    frames = _plain(side)["frames"]
    arrays = {name: np.array([frame[name] for frame in frames]) for name in frames[0]}
    return arrays | {"valid": np.ones((3, 2), bool)}


def _as_lines(records) -> bytes:
    return "".join(json.dumps(record) + "\n" for record in records).encode()


def _as_json(content) -> bytes:
    return json.dumps(content).encode()


def _as_npz(arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


FORMATS: dict[str, tuple[Callable[[Side], Any], Callable[[Any], bytes], str, str]] = {
    "tusimple": (_tusimple, _as_lines, ".json", "tusimple"),
    "maptr": (_maptr, _as_json, ".json", "maptr"),
    "centerline": (_centerline, pickle.dumps, ".pkl", "openlane-v2.1-centerline"),
    "segment": (_segment, pickle.dumps, ".pkl", "lanesegnet"),
    "plain": (_plain, _as_json, ".json", "openlane-v2.1-centerline"),
    "npz": (_arrays, _as_npz, ".npz", "openlane-v2.1-centerline"),
}
"""Of each form of files: content, writer, suffix, and a protocol that reads it."""


def content(form: str, side: Side) -> Any:
    """Return the valid content of a file."""
    return FORMATS[form][0](side)


def encoded(form: str, side: Side) -> bytes:
    """Return a valid file."""
    return FORMATS[form][1](content(form, side))


@dataclass(frozen=True)
class Case:
    """A damaged file.

    Attributes:
        form: of both files, a name of `FORMATS`.
        side: which of them is damaged.
        name: of the damage.
        message: pattern that the message must contain.
        change: damages the content in place, or returns other content.
        after: damages the written file.
    """

    form: str
    side: Side
    name: str
    message: str
    change: Callable[[Any], Any] | None = None
    after: Callable[[bytes], bytes] | None = None

    @property
    def title(self) -> str:
        """Name of the test."""
        return f"{self.form}-{self.side}-{self.name}".replace(" ", "_")

    def file(self, side: Side) -> str:
        """Return the name of a file."""
        return f"{side}{FORMATS[self.form][2]}"

    def write(self, folder: Path) -> list[str]:
        """Write both files and return the arguments of `tflane score`."""
        _, encode, _, protocol = FORMATS[self.form]
        for side in ("predictions", "truth"):
            value = content(self.form, side)
            if side == self.side and self.change is not None:
                changed = self.change(value)
                value = value if changed is None else changed
            written = encode(value)
            if side == self.side and self.after is not None:
                written = self.after(written)
            (folder / self.file(side)).write_bytes(written)
        return [protocol, *(str(folder / self.file(side)) for side in ("predictions", "truth"))]


def put(*path: Any) -> Callable[[Any], None]:
    """Return the change that sets the entry at `path[:-1]` to `path[-1]`."""
    *way, last, value = path

    def change(content: Any) -> None:
        for step in way:
            content = content[step]
        content[last] = value

    return change


def drop(*path: Any) -> Callable[[Any], None]:
    """Return the change that deletes an entry."""
    *way, last = path

    def change(content: Any) -> None:
        for step in way:
            content = content[step]
        del content[last]

    return change


def repeat(*path: Any) -> Callable[[Any], None]:
    """Return the change that appends a list's entry to the list once more."""
    *way, last = path

    def change(content: Any) -> None:
        for step in way:
            content = content[step]
        content.append(copy.deepcopy(content[last]))

    return change


def text(old: str, new: str) -> Callable[[bytes], bytes]:
    """Return the damage that replaces the first occurrence of a text in the file."""

    def after(written: bytes) -> bytes:
        assert old.encode() in written, "the damage would change nothing"
        return written.replace(old.encode(), new.encode(), 1)

    return after


def deep(levels: int) -> list:
    """Return nested lists."""
    value: list = []
    for _ in range(levels):
        value = [value]
    return value

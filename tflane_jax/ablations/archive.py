"""The record of a table's runs: one small compressed file, from which the table can be made without the runs.

Gzipped JSON. What many runs have in common is written once and given by its place in a list:

    format       1
    table        name
    declaration  content of declaration.json, or null
    scores       lists of names of scores
    scenes       lists of denominators, or of true lanes, one number for each scene
    entries      what was measured of a checkpoint (`Measured`)
    configs      configurations
    runs         by key, see `RecordedRun`

The file may come from anywhere: its size is limited, and everything in it is checked as it is read.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from tflane_jax.ablations.recorded import Facts, Measured, RecordedRun
from tflane_jax.errors import UserError
from tflane_jax.evaluation.by_scene import DIGITS
from tflane_jax.evaluation.results import SceneRatio, SceneSamples
from tflane_jax.files.atomic import write_bytes
from tflane_jax.files.fields import items, member, parse_json, whole_number
from tflane_jax.files.wording import shown

FORMAT = 1
LARGEST_FILE, LARGEST_TEXT = 2**23, 2**26
"""Bytes of the file, and of the JSON in it."""
_LARGEST_NUMBER = 2**53
_LONGEST_TEXT, _LONGEST_SETTING = 300, 10_000
_STEPS = 10**DIGITS
"""Files hold scores of samples as integers: the score times this."""
_HASHES = "origins", "gives"
"""Attributes of `Facts` that are left out where they are empty, as in earlier records."""

T = TypeVar("T")


@dataclass(frozen=True)
class Archive:
    """The recorded runs of a table.

    Attributes:
        table: name.
        declaration: content of the file in which the comparison was declared; None for none.
        runs: by key.
        shared: runs that other tables have recorded, by key; not written.
    """

    table: str
    declaration: Mapping[str, Any] | None
    runs: Mapping[str, RecordedRun]
    shared: Mapping[str, RecordedRun] = field(default_factory=dict)


def merged(there: Archive, new: Archive) -> Archive:
    """Return the runs of both; of a run that both have, the one that was recorded last.

    A run whose content is the same keeps its earlier time, so that recording twice changes nothing. So does the
    declaration.
    """
    runs = dict(there.runs)
    for key, run in new.runs.items():
        old = runs.get(key)
        if old is None or (run.time >= old.time and _as_text(replace(run, time=old.time)) != _as_text(old)):
            runs[key] = run
    return Archive(new.table, _earlier(there.declaration, new.declaration), runs)


def _as_text(run: RecordedRun) -> str:
    """Return a run as text, in which a score that is NaN is equal to itself."""
    return json.dumps(asdict(run), sort_keys=True)


def _earlier(there: Mapping[str, Any] | None, new: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return the earlier declaration if both test the same and it covers the new seeds, else the new one."""
    if there is None or new is None:
        return there or new
    same, other = ({k: v for k, v in one.items() if k not in ("time", "git", "begun", "seeds")} for one in (there, new))
    known = there.get("seeds")
    covered = isinstance(known, list) and all(seed in known for seed in new.get("seeds", ()))
    first = str(there.get("time")) <= str(new.get("time"))
    return there if same == other and covered and first else new


# ---------------------------------------------------------------------------------------------------------------------
# Writing
# ---------------------------------------------------------------------------------------------------------------------


class _Shared:
    """Values that are written once, and found by their place."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self._places: dict[str, int] = {}

    def place(self, value: Any) -> int:
        """Return the place of a value; that of an earlier one if there is an equal one."""
        text = json.dumps(value, sort_keys=True)  # NaN is equal to itself here
        if text not in self._places:
            self._places[text] = len(self.values)
            self.values.append(value)
        return self._places[text]


def write_archive(path: Path, archive: Archive) -> Path:
    """Write a record whole or not at all, and return its path; equal records give the same bytes.

    Raises UserError for a record that `read_archive` would refuse.
    """
    scores, scenes, entries, configs = _Shared(), _Shared(), _Shared(), _Shared()

    def entry(measured: Measured | None) -> int | None:
        if measured is None:
            return None
        ways = {}
        for way, values in measured.ways.items():
            ratios = {
                name: [scenes.place(list(ratio.denominator)), list(ratio.numerator)]
                for name, ratio in measured.ratios[way].items()
            }
            ways[way] = {"scores": scores.place(list(values)), "values": list(values.values()), "ratios": ratios}
            if samples := measured.samples.get(way):  # earlier records have none
                ways[way]["samples"] = {
                    name: [scenes.place(list(each.lanes)), [round(_STEPS * value) for value in each.values]]
                    for name, each in samples.items()
                }
        about = {"step": measured.step, "protocol": measured.protocol, "code": measured.code}
        return entries.place(about | {"ways": ways})

    runs = {
        key: {
            "row": run.row,
            "seed": run.seed,
            "config": configs.place(dict(run.config)),
            "threads": dict(run.threads),
            "time": run.time,
            "commits": list(run.facts.commits),
            "devices": list(run.facts.devices),
            "seconds": run.facts.seconds,
            "validation": list(run.facts.validation),
            **{name: list(hashes) for name in _HASHES if (hashes := getattr(run.facts, name))},
            "measured": {name: entry(measured) for name, measured in run.measured.items()},
        }
        for key, run in sorted(archive.runs.items(), key=lambda item: (item[1].row, item[1].seed, item[0]))
    }
    content = {
        "format": FORMAT,
        "table": archive.table,
        "declaration": archive.declaration,
        "scores": scores.values,
        "scenes": scenes.values,
        "entries": entries.values,
        "configs": configs.values,
        "runs": runs,
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    packed = gzip.compress(text, 9, mtime=0)
    if len(packed) > LARGEST_FILE or len(text) > LARGEST_TEXT:
        raise UserError(f"cannot write {path}: it would be too large for a record of scores, {len(text):,} bytes")
    _parsed(json.loads(text), path)  # raises for what `read_archive` would refuse
    return write_bytes(path, packed)


# ---------------------------------------------------------------------------------------------------------------------
# Reading
# ---------------------------------------------------------------------------------------------------------------------


def read_archive(path: Path) -> Archive:
    """Return a record; raises UserError, which names the file and the place in it, for anything that is wrong."""
    try:
        return _parsed(parse_json(_text_of(path), str(path), "record of scores"), path)
    except RecursionError:
        raise UserError(f"{path} is no record of scores: its lists are nested too deep") from None
    except UserError as error:
        raise UserError(f"{error}; restore the file, or delete it and record its runs again") from None


def _text_of(path: Path) -> str:
    """Return the unpacked text of a file; at most `LARGEST_TEXT` bytes are unpacked."""
    try:
        with path.open("rb") as file:
            packed = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    unpacking = zlib.decompressobj(wbits=31)
    try:
        content = b"" if len(packed) > LARGEST_FILE else unpacking.decompress(packed, LARGEST_TEXT + 1)
    except zlib.error as error:
        raise UserError(f"{path} is no gzip file ({error})") from None
    if len(packed) > LARGEST_FILE or len(content) > LARGEST_TEXT:
        raise UserError(f"{path} is too large for a record of scores")
    if not unpacking.eof or unpacking.unused_data:
        raise UserError(f"{path} is {'cut short' if not unpacking.eof else 'followed by something else'}")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise UserError(f"{path} is no record of scores: it is not text") from None


def _parsed(content: Any, path: Path) -> Archive:
    where = str(path)
    if (version := member(content, "format", where)) != FORMAT:
        raise UserError(f"{where} has format {shown(version)}, this version of tflane_jax reads {FORMAT}")
    declaration = member(content, "declaration", where)
    if declaration is not None:
        _mapping(declaration, f"{where}: declaration")
    names = [_each(list_, f"{where}: scores {i}", _text) for i, list_ in enumerate(items(content, "scores", where))]
    scenes = [_each(list_, f"{where}: scenes {i}", _count) for i, list_ in enumerate(items(content, "scenes", where))]
    entries = [
        _entry(entry, names, scenes, f"{where}: entry {i}") for i, entry in enumerate(items(content, "entries", where))
    ]
    configs = items(content, "configs", where)
    runs = {
        _text(key, f"{where}: runs"): _run(key, run, configs, entries, f"{where}: run {key[:_LONGEST_TEXT]}")
        for key, run in _mapping(member(content, "runs", where), f"{where}: runs").items()
    }
    return Archive(_text(member(content, "table", where), f"{where}: table"), declaration, runs)


def _entry(entry: Any, names: Sequence[Sequence[str]], scenes: Sequence[Sequence[int]], where: str) -> Measured:
    ways, ratios, samples = {}, {}, {}
    for way, content in _mapping(member(entry, "ways", where), f"{where}: ways").items():
        place = f"{where}: {_text(way, where)!r}"
        own = _chosen(names, member(content, "scores", place), f"{place}: scores")
        values = _each(items(content, "values", place), f"{place}: values", _number)
        if len(values) != len(own):
            raise UserError(f"{place} has {len(values)} values of {len(own)} scores")
        ways[way] = dict(zip(own, values, strict=True))
        ratios[way] = {
            _text(score, place): _ratio(pair, scenes, f"{place}: {score[:_LONGEST_TEXT]}")
            for score, pair in _mapping(member(content, "ratios", place), f"{place}: ratios").items()
        }
        if "samples" in content:
            samples[way] = {
                _text(score, place): _sampled(pair, scenes, f"{place}: {score[:_LONGEST_TEXT]}")
                for score, pair in _mapping(content["samples"], f"{place}: samples").items()
            }
    if "" not in ways:
        raise UserError(f"{where} lacks the scores of the run as trained")
    step = whole_number(member(entry, "step", where), 0, _LARGEST_NUMBER, f"{where}: step")
    protocol, code = (_text(member(entry, name, where), f"{where}: {name}") for name in ("protocol", "code"))
    return Measured(step, protocol, ways, ratios, code, samples)


def _ratio(pair: Any, scenes: Sequence[Sequence[int]], where: str) -> SceneRatio:
    place, hits = _each(pair, where, lambda value, _: value, length=2)
    denominator = _chosen(scenes, place, where)
    return SceneRatio(_each(hits, where, _number, length=len(denominator)), tuple(denominator))


def _sampled(pair: Any, scenes: Sequence[Sequence[int]], where: str) -> SceneSamples:
    place, steps = _each(pair, where, lambda value, _: value, length=2)
    values = tuple(count / _STEPS for count in _each(steps, where, _count))
    return SceneSamples(tuple(_chosen(scenes, place, where)), values)


def _run(key: str, run: Any, configs: Sequence[Any], entries: Sequence[Measured], where: str) -> RecordedRun:
    def texts(name: str) -> tuple[str, ...]:
        return _each(items(run, name, where), f"{where}: {name}", _text)

    threads = _mapping(member(run, "threads", where), f"{where}: threads")
    for name, value in threads.items():
        place = f"{where}: threads, {_text(name, where)}"
        if name == "cores":
            _count(value, place)
        else:
            _text(value, place, longest=_LONGEST_SETTING)
    member(threads, "cores", f"{where}: threads")
    seconds, measured = member(run, "seconds", where), member(run, "measured", where)
    records = enumerate(items(run, "validation", where))
    return RecordedRun(
        key=key,
        row=_text(member(run, "row", where), f"{where}: row"),
        seed=_count(member(run, "seed", where), f"{where}: seed"),
        config=_mapping(_chosen(configs, member(run, "config", where), f"{where}: config"), f"{where}: config"),
        threads=threads,
        facts=Facts(
            commits=texts("commits"),
            devices=texts("devices"),
            seconds=None if seconds is None else float(_number(seconds, f"{where}: seconds")),
            validation=tuple(_validation(record, f"{where}: validation {i}") for i, record in records),
            **{name: texts(name) for name in _HASHES if name in run},
        ),
        measured={
            _text(name, where): None if place is None else _chosen(entries, place, f"{where}: {name[:_LONGEST_TEXT]}")
            for name, place in _mapping(measured, f"{where}: measured").items()
        },
        time=_text(member(run, "time", where), f"{where}: time"),
    )


def _validation(record: Any, where: str) -> dict[str, Any]:
    """Return a record of the validation split: its step, and one number for each score."""
    step = whole_number(member(record, "step", where), 0, _LARGEST_NUMBER, f"{where}: step")
    if member(record, "split", where) != "val":
        raise UserError(f"{where} is none of the validation split")
    values = {_text(name, where): value for name, value in record.items() if name not in ("step", "split")}
    return {"step": step, "split": "val"} | {name: _number(v, f"{where}: {name}") for name, v in values.items()}


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UserError(f"{where} is {shown(value)}, expected a mapping")
    return value


def _each(value: Any, where: str, check: Callable[[Any, str], T], length: int | None = None) -> tuple[T, ...]:
    """Return the checked items of a list."""
    if not isinstance(value, list) or (length is not None and len(value) != length):
        size = "" if length is None else f" of {length}"
        raise UserError(f"{where} is {shown(value)}, expected a list{size}")
    return tuple(check(item, where) for item in value)


def _chosen(values: Sequence[T], place: Any, where: str) -> T:
    """Return the value at a place of a list; there must be one."""
    if type(place) is not int or not 0 <= place < len(values):
        raise UserError(f"{where} is {shown(place)}, expected a number below {len(values)}")
    return values[place]


def _text(value: Any, where: str, longest: int = _LONGEST_TEXT) -> str:
    if not isinstance(value, str) or len(value) > longest or not value.isprintable():
        raise UserError(f"{where}: {shown(value)} is no short text")
    return value


def _number(value: Any, where: str) -> float:
    """Return a number as it is; NaN and infinity are numbers too."""
    if type(value) not in (int, float) or (type(value) is int and abs(value) > _LARGEST_NUMBER):
        raise UserError(f"{where} is {shown(value)}, expected a number")
    return value


def _count(value: Any, where: str) -> int:
    if type(value) is not int or not 0 <= value <= _LARGEST_NUMBER:
        raise UserError(f"{where} is {shown(value)}, expected a count")
    return value

"""Files of recorded scores: what is written is read, equal parts are written once, and damaged ones are named."""

import copy
import gzip
import json
import math
from dataclasses import replace

import pytest

from tests.test_damaged_files import CONTENTS, damage
from tflane_jax.ablations import archive as module
from tflane_jax.ablations.archive import Archive, merged, read_archive, write_archive
from tflane_jax.ablations.recorded import Facts, Measured, RecordedRun, evaluation_name
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig, SceneRatio, SceneSamples

WAYS = {"": {"all/recall": 0.1 + 0.2, "all/DET_l": 0}, "no traffic": {"all/recall": 1e-300, "all/DET_l": 0.5}}
RATIOS = {"": {"all/recall": SceneRatio((1, 0), (3, 4))}, "no traffic": {"all/recall": SceneRatio((2, 2), (3, 4))}}
SAMPLES = {
    way: {"all/DET_l": SceneSamples((3, 4), (0.12345, value))} for way, value in (("", 1.0), ("no traffic", 0.3))
}
LAST = Measured(4, "a protocol, 2 m", WAYS, RATIOS, "c" * 64, SAMPLES)
FACTS = Facts(("9ea6749b4",), ("cpu: cpu x 1",), 61.5, ({"step": 2, "split": "val", "all/recall": 0.25},), ("c0ffee",))
RUN = RecordedRun(
    key="0123456789abcdef",
    row="TopoNet + TFM",
    seed=1,
    config={"class": "RunConfig", "training": {"seeds": [1], "init_from": None}},
    threads={"cores": 1, "XLA_FLAGS": "--a=b"},
    facts=FACTS,
    measured={"last": LAST, "best": replace(LAST), "last, topology geometric": replace(LAST, step=3)},
    time="2026-01-01T00:00:00+00:00",
)
DECLARATION = {"primary": "all/recall", "seeds": [0, 1], "time": "2026-01-01T00:00:00+00:00", "begun": 0}
ARCHIVE = Archive("paper.9", DECLARATION, {RUN.key: RUN, "other": replace(RUN, key="other", seed=2, row="TopoNet")})


@pytest.fixture
def file(tmp_path):
    return write_archive(tmp_path / "paper.9.json.gz", ARCHIVE)


def content_of(path):
    return json.loads(gzip.decompress(path.read_bytes()))


def put(path, content):
    path.write_bytes(gzip.compress(content if isinstance(content, bytes) else json.dumps(content).encode()))
    return path


def test_a_record_is_read_as_it_was_written_and_equal_parts_are_written_once(file, tmp_path):
    read = read_archive(file)
    assert read == ARCHIVE
    assert type(read.runs[RUN.key].measured["last"].ways[""]["all/DET_l"]) is int
    assert write_archive(tmp_path / "again.gz", read).read_bytes() == file.read_bytes()
    content = content_of(file)
    assert [len(content[name]) for name in ("scores", "scenes", "entries", "configs", "runs")] == [1, 1, 2, 1, 2]


def test_a_record_without_samples_keeps_its_form(tmp_path):
    """Records of an earlier version have none: they are read, and written again as they were."""
    run = replace(RUN, measured={"last": replace(LAST, samples={}), "best": replace(LAST, samples={"": {}})})
    path = write_archive(tmp_path / "a.gz", Archive("a", None, {RUN.key: run}))
    assert b"samples" not in gzip.decompress(path.read_bytes())
    assert read_archive(path).runs[RUN.key].measured["best"].samples == {}


def test_sums_that_are_no_counts_are_kept(tmp_path):
    ratios = {way: {"all/TOP_ll": SceneRatio((0.123456, -1), (3, 4))} for way in WAYS}
    run = replace(RUN, measured={"last": replace(LAST, ratios=ratios)})
    read = read_archive(write_archive(tmp_path / "a.gz", Archive("a", None, {RUN.key: run}))).runs[RUN.key]
    assert read == run


def test_numbers_that_are_none_and_missing_checkpoints_are_kept(tmp_path):
    last = replace(LAST, ways={"": {"all/recall": math.nan, "all/AP": math.inf}}, ratios={"": {}})
    run = replace(RUN, measured={"last": last, "best": None}, facts=Facts((), (), None, ()))
    read = read_archive(write_archive(tmp_path / "a.gz", Archive("a", None, {RUN.key: run}))).runs[RUN.key]
    values = read.measured["last"].ways[""]
    assert math.isnan(values["all/recall"])
    assert values["all/AP"] == math.inf
    assert read.measured["best"] is None
    assert read.facts == run.facts


def test_long_flags_are_read_as_they_were_written_and_nothing_unreadable_is_written(tmp_path):
    path, flags = tmp_path / "a.json.gz", " ".join(f"--xla_gpu_setting_{i}=true" for i in range(40))
    run = replace(RUN, threads={"cores": 1, "XLA_FLAGS": flags})
    assert read_archive(write_archive(path, replace(ARCHIVE, runs={RUN.key: run}))).runs[RUN.key].threads == run.threads
    before = path.read_bytes()
    with pytest.raises(UserError, match="is no short text"):
        write_archive(path, replace(ARCHIVE, runs={RUN.key: replace(RUN, row="x" * 301)}))
    assert path.read_bytes() == before


def test_the_run_that_was_recorded_last_stays():
    def archive(**changes):
        run = replace(RUN, **changes)
        return Archive("paper.9", DECLARATION, {run.key: run})

    late = "2026-02-01T00:00:00+00:00"
    other = {"measured": {"last": LAST, "best": None}}
    assert merged(archive(), archive(time=late)).runs[RUN.key].time == RUN.time  # nothing has changed
    assert merged(archive(), archive(time=late, **other)).runs[RUN.key].measured == other["measured"]
    assert merged(archive(time=late), archive(**other)).runs[RUN.key].measured == RUN.measured
    both = merged(archive(), archive(key="new", seed=7))
    assert {run.seed for run in both.runs.values()} == {1, 7}


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({"time": "2026-02-01T00:00:00+00:00", "begun": 4, "git": None}, True),
        ({"time": "2025-02-01T00:00:00+00:00"}, False),
        ({"time": "2026-02-01T00:00:00+00:00", "primary": "all/DET_l"}, False),
        ({"time": "2026-02-01T00:00:00+00:00", "seeds": [0, 1, 2]}, False),
        ({"time": "2026-02-01T00:00:00+00:00", "seeds": [1]}, True),
    ],
)
def test_the_first_declaration_of_the_same_stays(change, kept):
    new = DECLARATION | change
    found = merged(ARCHIVE, replace(ARCHIVE, declaration=new)).declaration
    assert found == (DECLARATION if kept else new)
    odd = replace(ARCHIVE, declaration={"seeds": 3, "time": []})
    assert merged(odd, ARCHIVE).declaration == DECLARATION


@pytest.mark.parametrize("content", CONTENTS)
def test_damaged_files_are_named(file, content):
    damage(file, CONTENTS[content])
    with pytest.raises(UserError, match=r"paper\.9\.json\.gz.*restore the file"):
        read_archive(file)


@pytest.mark.parametrize("content", [c for c in CONTENTS.values() if c is not None])
def test_damaged_contents_are_named(file, content):
    written = gzip.decompress(file.read_bytes())
    put(file, content(written) if callable(content) else content)
    with pytest.raises(UserError, match=r"paper\.9\.json\.gz.*restore the file"):
        read_archive(file)


def places(content, path=()):
    """Yield the place of every value in a JSON content."""
    yield path
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in inner:
        yield from places(value, (*path, key))


def test_a_wrong_value_anywhere_is_an_error_with_a_message_or_harmless(file, monkeypatch):
    """Whatever stands anywhere in the file, nothing but a record or a UserError comes of it."""
    content, messages = content_of(file), []
    texts = iter([json.dumps(each) for each in _with_wrong_values(content)])
    monkeypatch.setattr(module, "_text_of", lambda _: next(texts))
    while True:
        try:
            read = read_archive(file)
        except UserError as error:
            messages.append(str(error))
        except StopIteration:
            break
        else:
            assert all(isinstance(run, RecordedRun) for run in read.runs.values())
    assert len(messages) > 500
    assert all(str(file) in message and len(message) < 1000 for message in messages)


def _with_wrong_values(content):
    for path in list(places(content)):
        for value in (None, [], {}, -1, 10**400, "x" * 9999, "\x1b[2J", True, [[[]]]):
            whole = {"": copy.deepcopy(content)}
            *above, last = ("", *path)
            target = whole
            for key in above:
                target = target[key]
            target[last] = value
            yield whole[""]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(format=2), "has format 2, this version of tflane_jax reads 1"),
        (lambda c: c.update(format=[]), "has format"),
        (lambda c: c.pop("entries"), "lacks the entry 'entries'"),
        (lambda c: c["runs"]["other"].update(config=1), "run other: config is 1, expected a number below 1"),
        (lambda c: c["runs"]["other"]["measured"].update(last=-1), "run other: last is -1"),
        (lambda c: c["runs"]["other"]["threads"].pop("cores"), "lacks the entry 'cores'"),
        (lambda c: c["runs"]["other"].update(devices=["cpu\x1b[2J"]), "devices"),
        (lambda c: c["entries"][0]["ways"].pop(""), "entry 0 lacks the scores of the run as trained"),
        (lambda c: c["entries"][0]["ways"][""]["values"].pop(), "has 1 values of 2 scores"),
        (lambda c: c["entries"][0]["ways"][""]["values"].append("1"), "expected a number"),
        (lambda c: c["entries"][0]["ways"][""]["ratios"]["all/recall"][1].pop(), "expected a list of 2"),
        (lambda c: c["scenes"][0].append(-1), "scenes 0 is -1, expected a count"),
        (lambda c: c["entries"][0]["ways"][""]["samples"]["all/DET_l"][1].append(0.5), "is 0.5, expected a count"),
        (lambda c: c["entries"][0]["ways"][""]["samples"]["all/DET_l"].pop(), "expected a list of 2"),
        (lambda c: c["entries"][0]["ways"][""].update(samples=[]), "samples is [], expected a mapping"),
    ],
)
def test_wrong_entries_are_named(file, change, words):
    content = content_of(file)
    change(content)
    with pytest.raises(UserError) as error:
        read_archive(put(file, content))
    assert words in str(error.value)


def test_files_that_are_too_large_or_followed_by_something_are_refused(file, monkeypatch):
    whole = file.read_bytes()
    file.write_bytes(whole + b"x")
    with pytest.raises(UserError, match="followed by something else"):
        read_archive(file)
    file.write_bytes(whole)
    monkeypatch.setattr(module, "LARGEST_TEXT", 100)
    with pytest.raises(UserError, match="too large"):
        read_archive(file)
    monkeypatch.setattr(module, "LARGEST_TEXT", 2**20)
    read_archive(file)
    monkeypatch.setattr(module, "LARGEST_FILE", len(whole) - 1)
    with pytest.raises(UserError, match="too large"):
        read_archive(file)


def test_evaluations_are_named_by_what_differs():
    own = EvaluationConfig(batch_size=4)
    assert evaluation_name("best", own, own) == "best"
    assert evaluation_name("last", EvaluationConfig(4, topology="geometric"), own) == "last, topology geometric"

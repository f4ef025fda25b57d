"""The file of the on-board store: what was written is read, and anything else is refused with one message."""

import contextlib
import datetime
import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.datasets.small_logs import lane_map, segment
from tests.markers.test_store import DAY, fork, placed
from tflane_jax.errors import UserError
from tflane_jax.markers.store import MarkerStore, store_of
from tflane_jax.markers.store_files import load_store, save_store


@pytest.mark.parametrize("frame", ["marker", "survey"])
def test_a_file_holds_what_was_stored(tmp_path, frame):
    far = placed((2000.25, -3000.5, 17), (2040, -3000, 17), (9000, 0, 0), ids=[7, 2, 5])
    lanes = lane_map(segment(1, [(1990, -3010), (2030, -3000)], [2]), segment(2, [(2030, -3000), (2060, -2950)]))
    store = store_of(lanes.segments, far, surveyed=DAY, expires=DAY + datetime.timedelta(30))
    path = save_store(store, tmp_path / "deep" / "store.json", frame=frame)
    assert os.listdir(path.parent) == ["store.json"]
    read = load_store(path)
    assert list(read.markers) == [2, 5, 7]
    for number, marker in store.markers.items():
        again = read.markers[number]
        np.testing.assert_array_equal(again.global_from_marker, marker.global_from_marker)
        np.testing.assert_array_equal(again.successor, marker.successor)
        assert (again.size, again.surveyed, again.expires) == (1.0, DAY, DAY + datetime.timedelta(30))
        assert len(again.lanes) == len(marker.lanes)
        np.testing.assert_allclose(again.lanes, marker.lanes.reshape(again.lanes.shape), atol=1e-3)


def test_a_file_may_be_in_other_units(tmp_path):
    record = saved(tmp_path)
    record["unit"] = "foot"
    (tmp_path / "feet.json").write_text(json.dumps(record))
    metres, feet = load_store(tmp_path / "store.json").markers[0], load_store(tmp_path / "feet.json").markers[0]
    np.testing.assert_allclose(feet.lanes, 0.3048 * metres.lanes)
    np.testing.assert_allclose(feet.global_from_marker[:3, 3], 0.3048 * metres.global_from_marker[:3, 3])
    np.testing.assert_array_equal(feet.global_from_marker[:3, :3], metres.global_from_marker[:3, :3])
    assert feet.size == pytest.approx(0.3048)


def saved(tmp_path):
    path = save_store(store_of(fork(), placed((0, 0, 3), (10, 0, 3))), tmp_path / "store.json")
    return json.loads(path.read_text())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.pop("format"), "lacks the entry 'format'"),
        (lambda r: r.update(format="other"), "this is no marker store"),
        (lambda r: r.update(version=2), "version is 2, this program reads 1"),
        (lambda r: r.update(version=True), "version is True, this program reads 1"),
        (lambda r: r.update(version=[1]), "version is [1], this program reads 1"),
        (lambda r: r.update(unit="mile"), "unit is 'mile', expected one of metre"),
        (lambda r: r.update(unit=["metre"]), "unit is ['metre'], expected one of metre"),
        (lambda r: r.update(frame="ego"), "frame is 'ego'"),
        (lambda r: r.update(markers={}), "markers is of type dict"),
        (lambda r: r["markers"][1].pop("id"), "markers[1] lacks the entry 'id'"),
        (lambda r: r["markers"][1].update(lanes=[[[0, 0, 0], [1, 0, 0]]] * 1001), "marker 1 has 1001 lanes"),
        (lambda r: r["markers"][1].update(id=1.5), "markers[1]: id is 1.5"),
        (lambda r: r["markers"][1].update(id=float("inf")), "markers[1]: id is inf"),
        (lambda r: r["markers"][1].update(id=float("nan")), "markers[1]: id is nan"),
        (lambda r: r["markers"][1].update(id=True), "markers[1]: id is True"),
        (lambda r: r["markers"][1].update(id=-1), "markers[1]: id is -1"),
        (lambda r: r["markers"][1].update(id=2**31), "markers[1]: id is 2147483648"),
        (lambda r: r["markers"][1].update(id="7"), "markers[1]: id is '7'"),
        (lambda r: r["markers"][1].update(id=0), "marker 0: id occurs twice"),
        (lambda r: r["markers"][1].update(size=0), "marker 1: size is 0"),
        (lambda r: r["markers"][1].update(size=True), "marker 1: size is True"),
        (lambda r: r["markers"][1].update(size=10**400), "marker 1: size holds an integer"),
        (lambda r: r["markers"][1].update(size=1e300), "marker 1: size is 1e+300 m"),
        (lambda r: r["markers"][1].update(size="1"), "marker 1: size is of type str"),
        (lambda r: r["markers"][1].update(size=[]), "marker 1: size has shape (0,)"),
        (lambda r: r["markers"][1].update(lanes=None), "marker 1: lanes is missing (null)"),
        (lambda r: r["markers"][1].update(lanes="far"), "marker 1: lanes is of type str"),
        (lambda r: r["markers"][1].update(lanes=[[[0, 0, 0], [1e300, 0, 0]]]), "marker 1: lanes holds 1e+300 m"),
        (
            lambda r: r["markers"][1].update(lanes=[[[0, 0, None], [1, 0, 0]]]),
            "marker 1: lanes holds a value missing (null)",
        ),
        (lambda r: r["markers"][1].update(lanes=[[[0, 0, 0]]]), "marker 1: lanes have 1 points"),
        (lambda r: r["markers"][1].update(lanes=[[[2, 0, 1]] * 3]), "marker 1: lanes[0] has no length"),
        (lambda r: r["markers"][1].update(lanes=[[[0, 0], [1, 1]]]), "marker 1: lanes has shape (1, 2, 2)"),
        (lambda r: r["markers"][1]["lanes"][0].pop(), "marker 1: lanes is of type list"),
        (lambda r: r["markers"][1]["lanes"][0][3].__setitem__(1, float("nan")), "lanes holds nan at [0, 3, 1]"),
        (lambda r: r["markers"][1].update(successors=[[0, 5]]), "marker 1: successors holds 5, which is no lane"),
        (lambda r: r["markers"][1].update(successors=[[0, -1]]), "marker 1: successors holds -1"),
        (lambda r: r["markers"][1].update(successors=[[0.5, 1]]), "marker 1: successors holds 0.5"),
        (lambda r: r["markers"][1].update(successors=[[1e300, 0]]), "marker 1: successors holds 1e+300"),
        (lambda r: r["markers"][1].update(successors=[[[0, 1]]]), "marker 1: successors has shape (1, 1, 2)"),
        (lambda r: r["markers"][1].update(surveyed="July"), "marker 1: surveyed is 'July', expected a day"),
        (lambda r: r["markers"][1].update(expires=20250711), "marker 1: expires is 20250711"),
        (
            lambda r: r["markers"][1].update(surveyed="2025-07-11", expires="2025-07-11"),
            "marker 1: expires is 2025-07-11, which must be after surveyed",
        ),
        (lambda r: r["markers"][1]["global_from_marker"][0].__setitem__(0, 2.0), "1: global_from_marker is no pose"),
        (
            lambda r: r["markers"][1]["global_from_marker"][0].__setitem__(0, 1e200),
            "marker 1: global_from_marker is no pose",
        ),
        (
            lambda r: r["markers"][1]["global_from_marker"][0].__setitem__(3, 1e200),
            "marker 1: global_from_marker holds 1e+200 m",
        ),
        (lambda r: r["markers"][1].update(global_from_marker=7), "marker 1: global_from_marker has shape ()"),
        (lambda r: r["markers"][1]["global_from_marker"].reverse(), "marker 1: global_from_marker is no pose"),
        (lambda r: r["markers"].append(3), "markers[2] is of type int"),
    ],
)
def test_faults_in_a_file_are_named(tmp_path, change, message):
    record = saved(tmp_path)
    change(record)
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(record))
    with pytest.raises(UserError, match=re.escape(message)) as error:
        load_store(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"id":1,', '"id":1e400,', "markers[1]: id is inf"),
        ('"id":1,', f'"id":{"9" * 5000},', "Exceeds the limit (4300 digits)"),
        ('"id":1,', f'"id":{"[" * 100_000}{"]" * 100_000},', "nested too deep"),
        ('"id":1,', f'"id":{"[" * 800}{"]" * 800},', "markers[1]: id is"),
        ('"version": 1', f'"version": {"[" * 800}{"]" * 800}', "version is"),
        ('"unit": "metre"', f'"unit": {"[" * 800}{"]" * 800}', "unit is"),
        ('"size":1.0', f'"size":{"[" * 300}{"]" * 300}', "size"),
        ('"size":1.0', '"size":{"a":1}', "size holds a value of type dict"),
        ('"size":1.0', '"size":"\\ud800"', "size is of type str"),
        ('"markers": [', '"markers": 3, "rest": [', "markers is of type int"),
        ('"id":1,', '"id":1,"id":2,', "has the entry 'id' twice"),
    ],
)
def test_damaged_text_is_one_message(tmp_path, old, new, message):
    """Damage that no JSON writer makes."""
    saved(tmp_path)
    text = (tmp_path / "store.json").read_text()
    assert old in text
    path = tmp_path / "damaged.json"
    path.write_text(text.replace(old, new, 1), encoding="utf-8", errors="surrogatepass")
    with pytest.raises(UserError, match=re.escape(message)) as error:
        load_store(path)
    assert str(path) in str(error.value)
    assert len(str(error.value)) < 400


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)


@given(data=st.data())
@settings(max_examples=60)
def test_any_value_at_any_place_gives_a_store_or_one_message(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("store")
    record = saved(folder)
    owner = data.draw(st.sampled_from([record, record["markers"][0], record["markers"][1]]))
    owner[data.draw(st.sampled_from(sorted(owner)))] = data.draw(JSON_VALUES)
    (folder / "changed.json").write_text(json.dumps(record))
    with contextlib.suppress(UserError):  # any other exception fails
        for marker in load_store(folder / "changed.json").markers.values():
            assert np.isfinite(marker.lanes).all()
            assert np.isfinite(marker.global_from_marker).all()
            assert marker.size > 0.0


def test_other_files_are_refused(tmp_path):
    with pytest.raises(UserError, match="cannot read"):
        load_store(tmp_path / "absent.json")
    (tmp_path / "half.json").write_text(json.dumps(saved(tmp_path))[:400])
    with pytest.raises(UserError, match="is no JSON file"):
        load_store(tmp_path / "half.json")
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(UserError, match="expected a mapping"):
        load_store(tmp_path / "list.json")


def test_a_store_that_could_not_be_read_is_not_written(tmp_path):
    many = lane_map(*(segment(i, [(i, 0), (i, 5)]) for i in range(1001))).segments
    crowded, tiny = store_of(many, placed((500, 0, 3), ids=[3]), radius=2000.0), store_of(fork(), placed((0, 0, 3)))
    with pytest.raises(UserError, match="marker 3 has 1001 lanes, expected at most 1000: take those of a smaller"):
        save_store(crowded, tmp_path / "store.json")
    too_small = replace(tiny, markers={0: replace(tiny.markers[0], size=0.001)})
    with pytest.raises(UserError, match=r"marker 0: size is 0\.001 m, expected 0\.01 to 100 m"):
        save_store(too_small, tmp_path / "store.json")
    assert not (tmp_path / "store.json").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"marker_id": 5}, "marker 5 stands under the id 0"),
        ({"global_from_marker": np.full((4, 4), np.nan)}, "global_from_marker holds nan"),
        ({"global_from_marker": np.diag([2.0, 1.0, 1.0, 1.0])}, "global_from_marker is no pose"),
        ({"lanes": np.full((1, 2, 3), 1e-5), "successor": np.zeros((1, 1), bool)}, "lanes[0] has no length"),
        ({"surveyed": datetime.date(2026, 1, 2), "expires": datetime.date(2026, 1, 1)}, "must be after surveyed"),
    ],
)
def test_a_marker_that_could_not_be_read_is_not_written(tmp_path, change, message):
    store = store_of(fork(), placed((0, 0, 3)))
    wrong = MarkerStore({0: replace(store.markers[0], **change)})
    with pytest.raises(UserError, match=re.escape(message)):
        save_store(wrong, tmp_path / "store.json")
    assert list(tmp_path.iterdir()) == []


def test_numbers_of_numpy_are_written(tmp_path):
    store = store_of(fork(), placed((0, 0, 3)))
    marker = replace(store.markers[0], size=np.float32(0.5), marker_id=np.int64(0))
    assert load_store(save_store(MarkerStore({0: marker}), tmp_path / "store.json")).markers[0].size == 0.5


def test_a_store_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    saved(tmp_path)
    before = (tmp_path / "store.json").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match=r"store\.json: No space left"):
        save_store(store_of({}, placed()), tmp_path / "store.json")
    assert [p.name for p in tmp_path.iterdir()] == ["store.json"]
    assert (tmp_path / "store.json").read_bytes() == before

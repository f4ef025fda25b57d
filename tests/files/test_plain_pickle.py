"""Plain data survive pickling; everything else is refused, and nothing is executed."""

import collections
import os
import pickle

import numpy as np
import pytest

from tflane_jax.errors import UserError
from tflane_jax.files.plain_pickle import load_plain_pickle

PLAIN = {
    "results": {("val", "10073", "315"): [{"id": 3, "points": np.arange(6.0).reshape(2, 3), "confidence": 0.5}]},
    "arrays": [np.zeros((0, 3), np.float32), np.array([True, False]), np.array(7), np.asfortranarray(np.eye(3)[:2])],
    "scalars": [np.float32(0.25), np.int64(-3), np.bool_(True), 1j, None, b"raw", "text", 2**70],
    "containers": [{1, 2}, frozenset({"a"}), (1, (2,)), collections.OrderedDict(a=1), bytearray(b"x")],
    "text arrays": np.array(["a", "bc"]),
    "objects": np.array([[1, 2], None], dtype=object),
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_survives(tmp_path, protocol):
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(PLAIN, protocol))
    got = load_plain_pickle(path)
    assert got.keys() == PLAIN.keys()
    assert got["scalars"] == PLAIN["scalars"]
    assert got["containers"] == PLAIN["containers"]
    for a, b in zip(got["arrays"], PLAIN["arrays"], strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(got["text arrays"], PLAIN["text arrays"])
    assert got["objects"].tolist() == [[1, 2], None]
    (detection,) = got["results"]["val", "10073", "315"]
    np.testing.assert_array_equal(detection["points"], [[0, 1, 2], [3, 4, 5]])
    again = pickle.loads(pickle.dumps(got, protocol))
    assert all(type(array) is np.ndarray for array in again["arrays"])
    np.testing.assert_array_equal(again["text arrays"], PLAIN["text arrays"])


class Evil:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


class ArrayOfMine(np.ndarray):
    pass


@pytest.mark.parametrize(
    ("thing", "named"),
    [
        (Evil(os.system, "touch SHOULD_NOT_EXIST"), "system"),
        (Evil(eval, "1 + 1"), "eval"),
        (Evil(getattr, "x", "upper"), "getattr"),
        (Evil(np.load, "x.npy"), "load"),
        (ArrayOfMine((2,)), "ArrayOfMine"),
        (UserError("an exception"), "UserError"),
        (np.random.default_rng(0), "numpy.random"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_anything_else_is_refused_and_not_run(tmp_path, monkeypatch, thing, named, protocol):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps({"results": [1, thing]}, protocol))
    with pytest.raises(UserError, match=rf"evil\.pkl is refused.*{named}"):
        load_plain_pickle(tmp_path / "evil.pkl")
    assert os.listdir(tmp_path) == ["evil.pkl"]


def test_the_size_that_an_array_claims_is_ignored(tmp_path):
    class Huge:
        def __reduce__(self):
            return np.zeros(0).__reduce__()[0], (np.ndarray, (10**15,), b"b")

    (tmp_path / "huge.pkl").write_bytes(pickle.dumps(Huge()))
    assert load_plain_pickle(tmp_path / "huge.pkl").size == 0


@pytest.mark.parametrize(
    "state", [(1, (0, 10**12), np.dtype("f8"), False, b""), (1, (10**12,), np.dtype("U0"), False, b"")]
)
def test_an_array_of_no_bytes_claims_no_length(tmp_path, state):
    class Long:
        def __reduce__(self):
            return np.zeros(0).__reduce__()[0], (np.ndarray, (0,), b"b"), state

    (tmp_path / "long.pkl").write_bytes(pickle.dumps(Long()))
    with pytest.raises(UserError, match="places in 0 bytes"):
        load_plain_pickle(tmp_path / "long.pkl")


def tower(levels, memo):
    """Return instructions for F(k + 1) = frozenset({(F(k), 0), (F(k), 1)}), by protocol 4."""
    code = b"(K\x00\x91"
    for level in range(levels):
        pairs = (b"h" + bytes([memo + level, ord("K"), part]) + b"\x86" for part in (0, 1))
        code += b"\x940(" + b"".join(pairs) + b"\x91"
    return code


def test_sets_that_hold_each_other_twice_are_refused(tmp_path):
    """Regression: two equal ones of 60 levels were compared for ever, and no signal ended it."""
    for levels, most in ((3, True), (60, False)):
        code = b"\x80\x04}(" + tower(levels, 0) + b"K\x01" + tower(levels, levels) + b"K\x02u."
        (tmp_path / "key.pkl").write_bytes(code)
        if most:
            assert list(load_plain_pickle(tmp_path / "key.pkl").values()) == [2]
        else:
            with pytest.raises(UserError, match="hold each other too many times"):
                load_plain_pickle(tmp_path / "key.pkl")


@pytest.mark.parametrize("protocol", [0, 3])
def test_older_protocols_have_no_sets_of_sets(tmp_path, protocol):
    for within in (frozenset({1}), (1, 2)):
        (tmp_path / "key.pkl").write_bytes(pickle.dumps({frozenset({within}): 1}, protocol))
        with pytest.raises(UserError, match="its sets hold tuples or sets"):
            load_plain_pickle(tmp_path / "key.pkl")


@pytest.mark.parametrize(
    "twice",
    [lambda _: b"2\x86", lambda i: b"q" + bytes([i]) + b"h" + bytes([i]) + b"\x86"],
    ids=["copied", "by number"],
)
def test_tuples_that_hold_each_other_twice_are_refused(tmp_path, twice):
    """Hashing the last of fifty, the key of a mapping, would take years."""
    file = tmp_path / "key.pkl"
    file.write_bytes(b"\x80\x04})" + b"".join(map(twice, range(50))) + b"K\x01s.")
    with pytest.raises(UserError, match=r"key\.pkl is .* damaged .*its tuples or sets hold each other too many times"):
        load_plain_pickle(file)
    file.write_bytes(b"\x80\x04})" + b"".join(map(twice, range(10))) + b"K\x01s.")
    assert list(load_plain_pickle(file).values()) == [1]


def test_keys_that_stand_in_a_file_many_times_are_read(tmp_path):
    key = ("val", ("10000", ("315", 7)))
    content = [{(key, i): (key, [key, i])} for i in range(2000)]
    (tmp_path / "keys.pkl").write_bytes(pickle.dumps(content))
    assert load_plain_pickle(tmp_path / "keys.pkl") == content


def test_the_number_that_an_object_claims_takes_no_memory(tmp_path):
    """PROTO 4, BININT1 1, LONG_BINPUT 100,000,000, STOP: Python would make a table of 1.6 GB for it."""
    (tmp_path / "memo.pkl").write_bytes(b"\x80\x04K\x01r" + (100_000_000).to_bytes(4, "little") + b".")
    with pytest.raises(UserError, match=r"memo\.pkl is .* damaged .*it numbers its objects in an unknown way"):
        load_plain_pickle(tmp_path / "memo.pkl")


@pytest.mark.parametrize("data", [b"", b"{}", b"\x80\x04", b"PK\x03\x04 not a pickle", pickle.dumps(PLAIN)[:-40]])
def test_a_damaged_file_is_named(tmp_path, data):
    (tmp_path / "broken.pkl").write_bytes(data)
    with pytest.raises(UserError, match=r"broken\.pkl is no pickle file, or it is damaged"):
        load_plain_pickle(tmp_path / "broken.pkl")


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_file_with_a_second_object_is_refused(tmp_path, protocol):
    """A program that appends to its file leaves the old results in front."""
    (tmp_path / "twice.pkl").write_bytes(pickle.dumps(PLAIN, protocol) + pickle.dumps(1))
    with pytest.raises(UserError, match=r"twice\.pkl goes on for 5 bytes after its content: was it written twice"):
        load_plain_pickle(tmp_path / "twice.pkl")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"cannot read .*nowhere\.pkl"):
        load_plain_pickle(tmp_path / "nowhere.pkl")


class Forged:
    """A numpy type with a state of the file's choice, or what a file calls with one."""

    def __init__(self, function, arguments, *state):
        self.call = (function, arguments, *state)

    def __reduce__(self):
        return self.call


def forged_type(code, names=None, fields=None, size=-1, flags=0):
    return Forged(np.dtype, (code, False, True), (3, "|", None, names, fields, size, -1, flags))


def forged_scalar(kind, data=b"A" * 16):
    return Forged(np._core.multiarray.scalar, (kind, data))


def forged_array(kind, shape, data):
    function, arguments, _ = np.zeros(1).__reduce__()
    return Forged(function, arguments, (1, shape, kind, False, data))


FORGED = {
    "an address as object": forged_scalar(forged_type("O8")),
    "an address as counted object": forged_scalar(forged_type("O8", flags=63)),
    "addresses in an array": forged_array(forged_type("O8"), (2,), b"A" * 16),
    "too few objects": forged_array(forged_type("O8", flags=63), (3,), [1, 2]),
    "too few bytes": forged_array(forged_type("f8"), (2**40,), b"A" * 16),
    "objects in place of bytes": forged_array(forged_type("f8"), (2,), [1.0, 2.0]),
    "a negative shape": forged_array(np.dtype("f8"), (2, -1), b"A" * 16),
    "a number larger than its type": forged_scalar(forged_type("f8", size=2**20)),
    "an array as type": forged_scalar(forged_type("(100000,)f8")),
    "a number with fields": forged_scalar(forged_type("f8", ("a",), {"a": (np.dtype("O"), 0)})),
}


@pytest.mark.parametrize("name", FORGED)
def test_numpy_types_are_not_completed_by_the_file(tmp_path, name):
    """Such states make numpy read beyond the data, or take them for addresses of objects."""
    path = tmp_path / "data.pkl"
    for protocol in (2, 4):
        path.write_bytes(pickle.dumps([FORGED[name]], protocol))
        with pytest.raises(UserError, match=r"data\.pkl is (refused|no pickle file)"):
            load_plain_pickle(path)


@pytest.mark.parametrize("fields", [{"a": (np.dtype("O"), 0)}, {"a": (np.dtype("f8"), -4096)}])
def test_records_are_read_without_their_fields(tmp_path, fields):
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(forged_scalar(forged_type("V16", ("a",), fields, 16)), 2))
    assert load_plain_pickle(path).dtype == np.dtype("V16")

"""Values that are kept until others are asked for."""

import gc
import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from tflane_jax.recent import KeptWith, Recent


def counted(most):
    made = []

    def make(key):
        made.append(key)
        return [key]

    return Recent(make, most), made


@pytest.mark.parametrize(("most", "expected"), [(1, "abacab"), (2, "abcb"), (3, "abc")])
def test_the_values_asked_for_last_are_kept(most, expected):
    recent, made = counted(most)
    for key in "aabbacab":
        assert recent(key) == [key]
    assert "".join(made) == expected


def test_a_value_that_cannot_be_made_is_tried_again():
    recent = Recent({1: "one"}.__getitem__, 1)
    for _ in range(2):
        with pytest.raises(KeyError):
            recent(2)
    assert recent(1) == "one"


def test_threads_share_one_value():
    recent, made = counted(8)
    threads = [threading.Thread(target=recent, args=(i % 4,)) for i in range(32)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(made) == [0, 1, 2, 3]


class Owner:
    """What values are kept with."""


def test_a_value_is_made_once_for_an_object_and_goes_with_it():
    """Regression: two threads drew one stage, and the end of its log then printed a KeyError."""
    kept, made, owner, other = KeptWith(), [], Owner(), Owner()

    def make():
        made.append(threading.get_ident())
        time.sleep(0.05)
        return len(made)

    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(lambda _: kept(owner, "key", make), range(4))) == {1}
    assert kept(owner, "another", make) == 2
    assert kept(other, "key", make) == 3
    del owner
    gc.collect()
    assert len(kept._kept) == 1
    assert kept(other, "key", make) == 3


def test_what_cannot_be_made_for_an_object_is_tried_again():
    kept, owner = KeptWith(), Owner()
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            kept(owner, 0, lambda: 1 // 0)
    assert kept(owner, 0, lambda: 1) == 1


@pytest.fixture
def waiting():
    """A `Recent` whose value of "slow" is made only when the event is set, by a thread that has begun it."""
    begun, go_on, made = threading.Event(), threading.Event(), []

    def make(key):
        made.append(key)
        if key == "slow":
            begun.set()
            assert go_on.wait(20)
        return [key]

    recent = Recent(make, 8)
    with ThreadPoolExecutor(3) as pool:
        slow = pool.submit(recent, "slow")
        assert begun.wait(20)
        yield recent, pool, slow, go_on, made
        go_on.set()


def test_while_one_is_made_others_are_made_and_kept_ones_are_returned(waiting):
    recent, pool, slow, *_ = waiting
    for _ in range(2):  # made, then kept
        assert pool.submit(recent, "other").result(20) == ["other"]
    assert not slow.done()


def test_who_asks_for_what_is_being_made_waits_for_it(waiting):
    recent, pool, slow, go_on, made = waiting
    second = pool.submit(recent, "slow")
    with pytest.raises(TimeoutError):
        second.result(0.1)
    go_on.set()
    assert second.result(20) is slow.result(20)
    assert made == ["slow"]
    assert not recent._making._used


def test_after_an_error_the_next_one_that_waits_tries_again():
    begun, go_on, tries = threading.Event(), threading.Event(), iter([1, 0, 0])

    def make(key):
        begun.set()
        assert go_on.wait(20)
        return 1 // (1 - next(tries))

    recent = Recent(make, 8)
    with ThreadPoolExecutor(3) as pool:
        first = pool.submit(recent, "key")
        assert begun.wait(20)
        later = [pool.submit(recent, "key") for _ in range(2)]
        go_on.set()
        assert isinstance(first.exception(20), ZeroDivisionError)
        assert [each.result(20) for each in later] == [1, 1]
    assert list(tries) == [0]


def test_a_pickled_copy_is_empty():
    recent = Recent(str, 2)
    kept = recent(5)
    assert recent(5) is kept
    assert pickle.loads(pickle.dumps(recent))(5) == "5"
    assert len(pickle.dumps(recent)) == len(pickle.dumps(Recent(str, 2)))

"""Values that are kept until others are asked for."""

import pickle
import threading

import pytest

from tflane_jax.datasets.recent import Recent


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


def test_a_pickled_copy_is_empty():
    recent = Recent(str, 2)
    kept = recent(5)
    assert recent(5) is kept
    assert pickle.loads(pickle.dumps(recent))(5) == "5"
    assert len(pickle.dumps(recent)) == len(pickle.dumps(Recent(str, 2)))

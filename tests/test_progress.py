"""Progress in a log: few whole lines, with rate and time left."""

import sys

import pytest

from tflane_jax import progress
from tflane_jax.progress import progress_bar


@pytest.fixture(autouse=True)
def no_notebook(monkeypatch):
    """Whatever this process ran before, as the tests of notebooks, standard error is that of no notebook."""
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)


@pytest.fixture
def clock(monkeypatch):
    """Return a list whose only item is the time, seconds."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def lines_of(capsys) -> list[str]:
    """Return what was written on standard error, which must be whole lines."""
    text = capsys.readouterr().err
    assert "\r" not in text
    assert text[-1:] in ("", "\n")
    return text.splitlines()


def test_quick_work_leaves_one_line(capsys, clock):
    assert list(progress_bar(range(1000), "reading", unit="frame")) == list(range(1000))
    (line,) = lines_of(capsys)
    assert line.startswith("reading: 100% 1000/1000 ")


def test_long_work_leaves_a_line_every_half_minute(capsys, clock):
    with progress_bar(desc="train", unit="step", total=100, initial=40) as bar:
        for _ in range(10):
            clock[0] += 10.0
            bar.set_postfix(loss="1.5", refresh=False)
            bar.update(2)
    lines = lines_of(capsys)
    assert [line.split("[")[0] for line in lines] == [
        "train:  46% 46/100 ",
        "train:  52% 52/100 ",
        "train:  58% 58/100 ",
        "train:  60% 60/100 ",
    ]
    # Two steps in 10 s; what was done before the start does not count.
    assert lines[1].endswith("[01:00<04:00,  5.00s/step, loss=1.5]")


def test_the_time_left_does_not_count_what_compiling_took(capsys, clock):
    with progress_bar(desc="train", unit="step", total=100) as bar:
        for seconds in (60.0, *[10.0] * 9):
            clock[0] += seconds
            bar.update(10)
            bar.update(0)
    first, second, *_, last = lines_of(capsys)
    assert first.endswith(" 10/100 [01:00<?, ?step/s]")
    assert second.endswith(" 40/100 [01:30<01:00,  1.00step/s]")
    assert last.endswith(" 100/100 [02:30<00:00,  1.50s/step]")  # of the whole


def test_unknown_number_of_items(capsys, clock):
    with progress_bar(desc="video", unit="frame") as bar:
        clock[0] += 2.0
        bar.update(8)
    assert lines_of(capsys) == ["video: 8frame [00:02,  4.00frame/s]"]


def test_work_that_fails_tells_how_far_it_came(capsys, clock):
    def files():
        yield from "abc"
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        list(progress_bar(files(), "read", unit="file", total=4))
    assert lines_of(capsys)[0].startswith("read:  75% 3/4 ")


def test_silent(capsys):
    assert list(progress_bar(range(3), "reading", unit="frame", disable=True)) == [0, 1, 2]
    assert lines_of(capsys) == []


def test_a_terminal_gets_a_bar(capsys, monkeypatch):
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    assert list(progress_bar(range(3), "reading", unit="frame")) == [0, 1, 2]
    assert "\rreading: 100%|" in capsys.readouterr().err

"""Warnings of the command line."""

from tflane_jax.cli import OneLineWarnings
from tflane_jax.datasets.base import TruncationWarning


def test_warnings_are_one_line_each_and_told_once(capsys):
    others = []
    show = OneLineWarnings(lambda message, category, *place: others.append(str(message)))
    for text in ("more lanes", "more lanes", "more tracks"):
        show(TruncationWarning(text), TruncationWarning, "file.py", 7)
    show(UserWarning("of another package"), UserWarning, "file.py", 7)
    assert capsys.readouterr().err == "tflane: warning: more lanes\ntflane: warning: more tracks\n"
    assert others == ["of another package"]

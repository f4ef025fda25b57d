"""The hash of the code that makes examples."""

import pytest

from tests.shared import ROOT
from tests.slow import with_slow
from tflane_jax.datasets import source_digest

SOURCE = '"""Doc."""\ndef f(x):\n    """Doc."""\n    return x + 1\n'


@pytest.mark.parametrize("library", with_slow(["numpy", "scipy", "shapely", "opencv"], quick=["numpy"]))
def test_another_version_of_a_library_makes_other_examples(monkeypatch, library):
    """Images are drawn by OpenCV, road edges merged by shapely."""
    pytest.importorskip("cv2" if library == "opencv" else library)
    there, before = source_digest.importlib.metadata.version, source_digest.source_digest.__wrapped__()
    monkeypatch.setattr(
        source_digest.importlib.metadata,
        "version",
        lambda name: there(name) + (".1" if name.startswith(library) else ""),
    )
    assert source_digest.source_digest.__wrapped__() != before


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (
            '"""Other words.\n\nAnd more."""\ndef f(x):\n    """In two.\n\n    Lines."""\n    return x + 1  # why\n',
            True,
        ),
        ('"""Doc."""\n\n\ndef f(x):\n    """Doc."""\n    return (x +\n            1)\n', True),
        (SOURCE.replace("return x + 1", "return x + 2"), False),
        (SOURCE.replace("return x + 1", "return x + 1.0"), False),
        (SOURCE.replace("return x + 1", "return x - 1"), False),
        (SOURCE.replace("return x + 1", "return (lambda: x + 1)()"), False),
        (SOURCE.replace("(x)", "(x, y=0)"), False),
    ],
)
def test_the_digest_ignores_comments_and_docstrings(other, same):
    assert (source_digest._code(SOURCE) == source_digest._code(other)) is same


def test_the_order_in_sets_is_no_part_of_the_digest():
    """It is another one in every process."""
    words = [f"word {i}" for i in range(50)]
    one, other = (f"def f(x):\n    return x in {{{', '.join(map(repr, each))}}}\n" for each in (words, words[::-1]))
    assert source_digest._code(one) == source_digest._code(other)
    assert source_digest._code(one) != source_digest._code(one.replace("word 7'", "word'"))


def test_digest_covers_the_world_its_imports_and_the_readers_of_files(monkeypatch):
    read = []
    digest = source_digest._code

    def spy(source):
        read.append(source)
        return digest(source)

    monkeypatch.setattr(source_digest, "_code", spy)
    source_digest.source_digest.__wrapped__()
    package = ROOT / "tflane_jax"
    files = (
        "scene/truth.py",
        "scene/logs.py",
        "geometry/poses.py",
        "files/feather_table.py",
        "datasets/procedural.py",
        "world/bev/line_of_sight.py",
    )
    for file in files:
        assert (package / file).read_text() in read, file

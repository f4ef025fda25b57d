"""`tflane train --config FILE --help`: every setting with its value and its meaning."""

import dataclasses
from typing import Literal, get_args, get_origin, get_type_hints

from tests.test_config import configurations
from tflane_jax.cli import main
from tflane_jax.config_help import explained, meanings
from tflane_jax.config_io import settings, to_text


def test_every_setting_of_the_shipped_configurations_is_explained():
    lacking = set()
    for config in configurations().values():
        parts = {"": config}
        for name, value in settings(config):
            if dataclasses.is_dataclass(value):
                parts[name] = value
            part, _, last = name.rpartition(".")
            if not meanings(type(parts[part])).get(last):
                lacking.add(f"{type(parts[part]).__name__}.{last}")
    assert lacking == set()


def test_every_word_that_a_setting_allows_is_named():
    lacking = set()
    for config in configurations().values():
        for part in (config, *(value for _, value in settings(config) if dataclasses.is_dataclass(value))):
            told, hints = meanings(type(part)), get_type_hints(type(part))
            for name in (field.name for field in dataclasses.fields(part)):
                hint = hints[name]
                literals = [kind for kind in (hint, *get_args(hint)) if get_origin(kind) is Literal]
                words = [word for kind in literals for word in get_args(kind)]
                lacking |= {(type(part).__name__, name, word) for word in words if f'"{word}"' not in told[name]}
    assert lacking == set()


@dataclasses.dataclass(frozen=True)
class Base:
    """A base.

    Attributes:
        size: of the base, metres.
        low, high: ends.
    """

    size: float = 1.0
    low: int = 0
    high: int = 1


@dataclasses.dataclass(frozen=True)
class Part(Base):
    """A part.

    Attributes:
        size, low: see `Base`.
        way: "one", as in Fig. 4 (Li et al. 2020), which is a long text of more than a hundred and sixty characters so
            that of its two sentences only the first one is shown; this, too. "other" is not seen.
        named: "near" is a word, "far" is another one.

    Raises:
        ValueError: never.
    """

    way: Literal["one", "other"] | None = "one"
    named: Literal["near", "far"] = "near"


def test_meanings_are_those_of_docstrings_and_of_their_bases():
    found = meanings(Part)
    assert found["size"] == "of the base, metres"
    assert found["low"] == found["high"] == "ends"
    assert found["way"].startswith('"one", as in Fig. 4 (Li et al. 2020), which is')
    assert found["way"].endswith('only the first one is shown; this, too (allowed: "one", "other")')
    assert found["named"] == '"near" is a word, "far" is another one'
    assert set(found) == {"size", "low", "high", "way", "named"}


def test_settings_stand_beside_their_meanings():
    lines = explained(Part()).splitlines()
    assert [line.partition(" #")[0].rstrip() for line in lines if not line.startswith(" ")] == to_text(
        Part()
    ).splitlines()
    assert max(map(len, lines)) <= 120


def test_the_help_of_a_configuration_explains_it(capsys):
    assert main(["train", "--config", "tf_lane/toponet_tfm", "--help"]) == 0
    told = capsys.readouterr().out
    assert "training.steps = 9000" in told
    assert any(line.startswith("training.steps = ") and line.endswith("# updates") for line in told.splitlines())
